/* A cost that Python has computed (called.c): of a stage, or of the last knot, its value, slopes (S) and curvature (S, S). */
#include "dense.h"

V cost_value(const Lanes *s, int64_t k, const V *x, const V *u) { return *cost_at(s, u ? STAGE : LAST, k); }

void cost_expand(const Lanes *s, int64_t k, const V *x, const V *u, V *g, V *H) {
    const V *p = cost_at(s, u ? STAGE : LAST, k);
    for (int v = 0; v < S; v++) g[v] += p[1 + v];
    add_upper(p + 1 + S, H);
}
