/* wide.h in plain C: the same sums, in the same order, of as many neurons. NET_WIDTH is given. */
#pragma once
#include "lanes.h"

typedef struct { REAL of[NET_WIDTH]; } Wide;
static const Wide net_nothing = {{0}};
#define NET_ZERO net_nothing
#define NET_ENTRY(a, l) ((a).of[l])
#define NET_EACH(i, n) for (int i = 0; i < n; i++)

static inline REAL net_fused_1(REAL a, REAL b, REAL c) { return tgco_fused(a, b, c); }
static inline Wide net_fused(Wide a, Wide b, Wide c) {
    for (int i = 0; i < NET_WIDTH; i++) c.of[i] = tgco_fused(a.of[i], b.of[i], c.of[i]);
    return c;
}
static inline Wide net_set(REAL a) { Wide r; for (int i = 0; i < NET_WIDTH; i++) r.of[i] = a; return r; }
static inline Wide net_times(Wide a, Wide b) {
    for (int i = 0; i < NET_WIDTH; i++) a.of[i] *= b.of[i];
    return a;
}
static inline Wide net_load(const double *from) {
    Wide r;
    for (int i = 0; i < NET_WIDTH; i++) r.of[i] = (REAL)from[i];
    return r;
}
static inline Wide net_wide(const REAL *from) { Wide r; memcpy(&r, from, sizeof r); return r; }
static inline I net_alike(V a, int l) { (void)a; (void)l; return 1; }
