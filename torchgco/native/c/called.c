/* The unit of a model whose functions C can't call. Python has computed them for all lanes and knots at once (`ask`), and
   what it found is the numbers p of a knot:

       of a step                the next state (NX), its slopes (NX, S), and the curvature of y' step (S, S)
       of rows, w[0] of them    their values, their slopes (w[0], S), and the curvature of lam' c (S, S) */
#include "dense.h"

void model_step(const V *x, const V *u, const V *p, const double *w, V *next) { memcpy(next, p, NX * sizeof(V)); }

void model_jacobian(const V *x, const V *u, const V *p, const double *w, V *f) { memcpy(f, p + NX, NJ * sizeof(V)); }

void model_pull_back(const V *p, const V *f, V *g) { tgco_pull_back(p, f, g); }

void model_push(const V *f, const V *z, V *out) {
    for (int i = 0; i < NX; i++) {
        out[i] = SET(0.0);
        for (int v = 0; v < S; v++) ADD(out[i], f[i * S + v], z[v]);
    }
}

void model_expand(const V *x, const V *u, const V *p, const double *w, const V *y, V *f, V *H) {
    model_jacobian(x, u, p, w, f);
    add_upper(p + NX + NJ, H);
}

void model_rows(int i, const V *x, const V *u, const V *p, const double *w, V *c) { memcpy(c, p, (size_t)w[0] * sizeof(V)); }

void model_bend_rows(
    int i, const V *x, const V *u, const V *p, const double *w, const V *by, const V *cc, const V *lam, V *const *g, V *H) {
    int rows = (int)w[0], size = u ? S : NX, bends = 0;
    for (int j = 0; j < rows; j++) {
        const V *e = p + rows + j * S;
        bends |= any(lam[j] != SET(0.0)); /* else their curvature isn't asked for */
        for (int v = 0; v < size; v++) {
            for (int part = 0; part < PARTS; part++) ADD(g[part][v], e[v], by[part * MAX_ROWS + j]);
            for (int l = v; l < size; l++) ADD(H[v * S + l], cc[j] * e[v], e[l]);
        }
    }
    if (bends) add_upper(p + rows + rows * S, H);
}

void model_along_rows(int i, const V *x, const V *u, const V *p, const double *w, const V *z, V *out) {
    int rows = (int)w[0];
    for (int j = 0; j < rows; j++) {
        out[j] = SET(0.0);
        for (int v = 0; v < (u ? S : NX); v++) ADD(out[j], p[rows + j * S + v], z[v]);
    }
}

/* Rows of bodies are all Python's. */
int model_slopes(int i, const V *x, const V *u, const V *p, const double *w, V *e, const int **columns) { return 0; }
