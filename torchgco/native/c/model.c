/* The unit of a model: the generated functions before this file, under the names that the solvers call.

   They are tgco_step, tgco_jacobian (the model), tgco_gather, tgco_product, tgco_pull_back (its sparse Jacobian), tgco_rows,
   tgco_add_rows and tgco_slopes (traced constraints). */

#include "model.h"
#include "code.h"

const int tgco_nx = NX, tgco_nu = NU, tgco_np = NP, tgco_nj = NJ, tgco_max_rows = MAX_ROWS;

void model_step(const V *x, const V *u, const V *parameters, const double *w, V *next) {
    tgco_step(x, u, parameters, w, next);
}

void model_jacobian(const V *x, const V *u, const V *parameters, const double *w, V *f) {
    tgco_jacobian(x, u, parameters, w, f);
}

void model_pull_back(const V *p, const V *f, V *g) { tgco_pull_back(p, f, g); }

void model_rows(int i, const V *x, const V *u, const V *p, const double *w, V *c) { tgco_rows(i, x, u, p, w, c); }

void model_add_rows(
    int i, const V *x, const V *u, const V *p, const double *w, const V *by_c, const V *by_cc, V *g, V *H) {
    tgco_add_rows(i, x, u, p, w, by_c, by_cc, g, H);
}

int model_slopes(int i, const V *x, const V *u, const V *p, const double *w, V *e, const int **columns) {
    return tgco_slopes(i, x, u, p, w, e, columns);
}
