/* The second unit of a model: the functions that curvature_code generates, under the names that the solver calls. */

void model_curve(const V *x, const V *u, const V *parameters, const V *y, V *H) { tgco_curve(x, u, parameters, y, H); }

void model_push(const V *f, const V *z, V *out) { tgco_push(f, z, out); }

void model_bend_rows(int i, const V *x, const V *u, const V *p, const V *by, const V *cc, const V *lam, V *const *g, V *H) {
    tgco_model_rows(i, x, u, p, by, cc, lam, g, H);
}

void model_along_rows(int i, const V *x, const V *u, const V *p, const V *z, V *out) {
    tgco_along_rows(i, x, u, p, z, out);
}
