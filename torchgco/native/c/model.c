/* The unit of a model: generated functions that are inlined here, under the names that other units call. */
#include "model.h"
#include "code.h"

void model_step(const V *x, const V *u, const V *parameters, const double *w, V *next) {
    tgco_step(x, u, parameters, w, next);
}

void model_jacobian(const V *x, const V *u, const V *parameters, const double *w, V *f) {
    tgco_jacobian(x, u, parameters, w, f);
}

void model_pull_back(const V *p, const V *f, V *g) { tgco_pull_back(p, f, g); }
