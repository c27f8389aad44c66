/* What the unit of a model (model.c) offers the others: its functions and its cost, at one knot. w are numbers that all
   problems share.

   F = [fx fu] is sparse: f are the entries that are computed, the others constants of the model. H are upper triangles. */
#pragma once
#include "problem.h"

TGCO_BETWEEN_UNITS void model_step(IN x, IN u, IN parameters, const double *w, OUT next);
TGCO_BETWEEN_UNITS void model_jacobian(IN x, IN u, IN parameters, const double *w, OUT f);
TGCO_BETWEEN_UNITS void model_pull_back(IN p, IN f, OUT g); /* g = F' p */
/* Traced constraint i with a knot's own numbers p: its rows c; g += c_z' by_c, H += c_z' diag(by_cc) c_z. */
TGCO_BETWEEN_UNITS void model_rows(int i, IN x, IN u, IN p, const double *w, OUT c);
TGCO_BETWEEN_UNITS void model_add_rows(
    int i, IN x, IN u, IN p, const double *w, IN by_c, IN by_cc, OUT g, OUT H);
/* Of the places of a body's balls, c (balls DIM): their slopes e (balls DIM, count) by the `columns` of z, whose count is
   returned. */
TGCO_BETWEEN_UNITS int model_slopes(int i, IN x, IN u, IN p, const double *w, OUT e, const int **columns);
/* The cost of stage k at x, u, of the last knot where u is NULL; adds its gradient g (S) and Hessian H (S, S). */
TGCO_BETWEEN_UNITS V cost_value(const Lanes *s, int64_t k, IN x, IN u);
TGCO_BETWEEN_UNITS void cost_expand(const Lanes *s, int64_t k, IN x, IN u, OUT g, OUT H);
/* In a unit of its own (riccati.c), which the interior point's library has alone. f, and H += second derivatives of y' step;
   out = F z; traced rows: g[a] += c_z' by[a], H += c_z' diag(cc) c_z + lam' c_zz; out = c_z z. */
TGCO_BETWEEN_UNITS void model_expand(IN x, IN u, IN parameters, const double *w, IN y, OUT f, OUT H);
TGCO_BETWEEN_UNITS void model_push(IN f, IN z, OUT out);
TGCO_BETWEEN_UNITS void model_bend_rows(
    int i, IN x, IN u, IN p, const double *w, IN by, IN cc, IN lam, OUTS g, OUT H);
TGCO_BETWEEN_UNITS void model_along_rows(int i, IN x, IN u, IN p, const double *w, IN z, OUT out);
