/* The quadratic cost: value, gradient and Hessian at a knot. Weights are diagonals, or matrices (QUADRATIC_FULL). */
#include "model.h"

/* w' e + e' W e / 2 in e = z - reference, for z = x or z = u at a knot; w may be NULL. */
typedef struct { ConstNumbers W, w, reference; } Quadratic;

static inline Quadratic quadratic_at(const Lanes *s, int W, int w, int reference, int64_t k) {
    IN linear = s->of->cost_data[w].data ? cost_at(s, w, k) : NONE;
    Quadratic of = {cost_at(s, W, k), linear, cost_at(s, reference, k)};
    return of;
}

static inline Quadratic quadratic_of_x(const Lanes *s, int64_t k, int last) {
    return last ? quadratic_at(s, Q_LAST, Q_LINEAR_LAST, X_REF_LAST, k)
                : quadratic_at(s, Q, Q_LINEAR, X_REF, k);
}

static inline Quadratic quadratic_of_u(const Lanes *s, int64_t k) {
    return quadratic_at(s, R, R_LINEAR, U_REF, k);
}

/* Writes e, and adds the value to `total`. */
static inline void quadratic_value(Quadratic of, int size, IN z, OUT e, V *total) {
    V half = SET(0.5);
    for (int i = 0; i < size; i++) e[i] = z[i] - of.reference[i];
#if QUADRATIC_FULL
    for (int i = 0; i < size; i++) {
        V row = SET(0.0);
        for (int j = 0; j < size; j++) ADD(row, of.W[i * size + j], e[j]);
        ADD(*total, half * e[i], row);
    }
#else
    for (int i = 0; i < size; i++) ADD(*total, half * of.W[i] * e[i], e[i]);
#endif
    if (of.w) for (int i = 0; i < size; i++) ADD(*total, of.w[i], e[i]);
}

/* Writes e, and adds gradient and upper triangle for z, which is [x, u] from `first` on. */
static inline void quadratic_expand(Quadratic of, int size, int first, IN z, OUT e, OUT g, OUT H) {
    for (int i = 0; i < size; i++) e[i] = z[i] - of.reference[i];
#if QUADRATIC_FULL
    for (int i = 0; i < size; i++) for (int j = 0; j < size; j++) {
        ADD(g[first + i], of.W[i * size + j], e[j]);
        if (j >= i) H[(first + i) * S + first + j] += of.W[i * size + j];
    }
#else
    for (int i = 0; i < size; i++) { ADD(g[first + i], of.W[i], e[i]); H[(first + i) * S + first + i] += of.W[i]; }
#endif
    if (of.w) for (int i = 0; i < size; i++) g[first + i] += of.w[i];
}

/* The cost of stage k at x, u; of the last knot where u is NULL. */
TGCO_BETWEEN_UNITS V cost_value(const Lanes *s, int64_t k, IN x, IN u) {
    V total = SET(0.0), ex[NX], eu[NU];
    quadratic_value(quadratic_of_x(s, k, !u), NX, x, ex, &total);
    if (!u) return total;
    quadratic_value(quadratic_of_u(s, k), NU, u, eu, &total);
    if (s->of->cost_data[CROSS].data) {
        IN C = cost_at(s, CROSS, k);
        for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) ADD(total, eu[i] * C[i * NX + j], ex[j]);
    }
    return total;
}

/* Adds gradient g (S) and upper triangle H (S, S) of `cost_value`. */
TGCO_BETWEEN_UNITS void cost_expand(const Lanes *s, int64_t k, IN x, IN u, OUT g, OUT H) {
    V ex[NX], eu[NU];
    quadratic_expand(quadratic_of_x(s, k, !u), NX, 0, x, ex, g, H);
    if (!u) return;
    quadratic_expand(quadratic_of_u(s, k), NU, NX, u, eu, g, H);
    if (s->of->cost_data[CROSS].data) {
        IN C = cost_at(s, CROSS, k);
        for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) {
            ADD(g[NX + i], C[i * NX + j], ex[j]);
            ADD(g[j], C[i * NX + j], eu[i]);
            H[j * S + NX + i] += C[i * NX + j];
        }
    }
}
