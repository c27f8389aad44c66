/* The unit of a model: generated functions that are inlined here, under the names that other units call. */
#include "model.h"
#include "code.h"

TGCO_BETWEEN_UNITS void model_step(IN x, IN u, IN parameters, const double *w, OUT next) {
    tgco_step(x, u, parameters, w, next);
}

TGCO_BETWEEN_UNITS void model_jacobian(IN x, IN u, IN parameters, const double *w, OUT f) {
    tgco_jacobian(x, u, parameters, w, f);
}

TGCO_BETWEEN_UNITS void model_pull_back(IN p, IN f, OUT g) { tgco_pull_back(p, f, g); }
