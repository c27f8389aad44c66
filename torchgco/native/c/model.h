/* What the unit of a model (model.c) offers the others: its functions and its cost, at one knot. w are numbers that all
   problems share.

   F = [fx fu] is sparse: f are the entries that are computed, the others constants of the model. H are upper triangles. */
#pragma once
#include "problem.h"

TGCO_BETWEEN_UNITS void model_step(const V *x, const V *u, const V *parameters, const double *w, V *next);
TGCO_BETWEEN_UNITS void model_jacobian(const V *x, const V *u, const V *parameters, const double *w, V *f);
TGCO_BETWEEN_UNITS void model_pull_back(const V *p, const V *f, V *g); /* g = F' p */
/* Traced constraint i with a knot's own numbers p: its rows c; g += c_z' by_c, H += c_z' diag(by_cc) c_z. */
TGCO_BETWEEN_UNITS void model_rows(int i, const V *x, const V *u, const V *p, const double *w, V *c);
TGCO_BETWEEN_UNITS void model_add_rows(
    int i, const V *x, const V *u, const V *p, const double *w, const V *by_c, const V *by_cc, V *g, V *H);
/* Of the places of a body's balls, c (balls DIM): their slopes e (balls DIM, count) by the `columns` of z, whose count is
   returned. */
TGCO_BETWEEN_UNITS int model_slopes(int i, const V *x, const V *u, const V *p, const double *w, V *e, const int **columns);
/* The cost of stage k at x, u, of the last knot where u is NULL; adds its gradient g (S) and Hessian H (S, S). */
TGCO_BETWEEN_UNITS V cost_value(const Lanes *s, int64_t k, const V *x, const V *u);
TGCO_BETWEEN_UNITS void cost_expand(const Lanes *s, int64_t k, const V *x, const V *u, V *g, V *H);
/* In a unit of its own (riccati.c), which the interior point's library has alone. f, and H += second derivatives of y' step;
   out = F z; traced rows: g[a] += c_z' by[a], H += c_z' diag(cc) c_z + lam' c_zz; out = c_z z. */
TGCO_BETWEEN_UNITS void model_expand(const V *x, const V *u, const V *parameters, const double *w, const V *y, V *f, V *H);
TGCO_BETWEEN_UNITS void model_push(const V *f, const V *z, V *out);
TGCO_BETWEEN_UNITS void model_bend_rows(
    int i, const V *x, const V *u, const V *p, const double *w, const V *by, const V *cc, const V *lam, V *const *g, V *H);
TGCO_BETWEEN_UNITS void model_along_rows(int i, const V *x, const V *u, const V *p, const double *w, const V *z, V *out);
