/* The second unit of a model: the functions that curvature_code generates, under the names that the solver calls. */

#include "model.h"
#include "code.h"

void model_expand(const V *x, const V *u, const V *parameters, const double *w, const V *y, V *f, V *H) {
#ifdef TGCO_TOGETHER /* with networks: both need their values */
    tgco_together(x, u, parameters, w, y, f, H);
#else
    model_jacobian(x, u, parameters, w, f);
    tgco_curve(x, u, parameters, w, y, H);
#endif
}

void model_push(const V *f, const V *z, V *out) { tgco_push(f, z, out); }

void model_bend_rows(
    int i, const V *x, const V *u, const V *p, const double *w, const V *by, const V *cc, const V *lam, V *const *g, V *H) {
    tgco_model_rows(i, x, u, p, w, by, cc, lam, g, H);
}

void model_along_rows(int i, const V *x, const V *u, const V *p, const double *w, const V *z, V *out) {
    tgco_along_rows(i, x, u, p, w, z, out);
}
