/* Vectors of NET_WIDTH neurons of one problem; scalar/wide.h has the same in plain C. */
#pragma once
#include "lanes.h"

#ifdef __AVX512F__
#define NET_WIDTH 8
#else
#define NET_WIDTH 4
#endif
typedef REAL Wide __attribute__((vector_size(NET_WIDTH * sizeof(REAL))));
#define NET_ZERO ((Wide){0})
#define NET_ENTRY(a, l) ((a)[l])

/* a b + c, rounded once where the processor can, whatever the compiler makes of sums and products. */
#if defined(__FMA__) && !defined(__clang__)
#if defined(__AVX512F__)
#define NET_FMA_double(a, b, c) __builtin_ia32_vfmaddpd512_mask(a, b, c, -1, 4)
#define NET_FMA_float(a, b, c) __builtin_ia32_vfmaddps256(a, b, c)
#else
#define NET_FMA_double(a, b, c) __builtin_ia32_vfmaddpd256(a, b, c)
#define NET_FMA_float(a, b, c) __builtin_ia32_vfmaddps(a, b, c)
#endif
#endif
TGCO_INLINE REAL net_fused_1(REAL a, REAL b, REAL c) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
    return TGCO_MATH(fma)(a, b, c);
#else
    return a * b + c;
#endif
}
TGCO_INLINE Wide net_fused(Wide a, Wide b, Wide c) {
#ifdef NET_FMA_double
    return TGCO_JOIN(NET_FMA_, REAL)(a, b, c);
#else
    for (int i = 0; i < NET_WIDTH; i++) c[i] = net_fused_1(a[i], b[i], c[i]);
    return c;
#endif
}
/* Over the columns and vectors of a block, whose sums are in registers only where the loop is unrolled. */
#define NET_EACH(i, n) _Pragma("GCC unroll 8") for (int i = 0; i < n; i++)

TGCO_INLINE Wide net_set(REAL a) { return a - (Wide){0}; }

static inline Wide net_times(Wide a, Wide b) { return a * b; }

static inline Wide net_load(const double *from) {
    Wide r;
#if TGCO_IS_DOUBLE
    memcpy(&r, from, sizeof r);
#else
    for (int i = 0; i < NET_WIDTH; i++) r[i] = (REAL)from[i];
#endif
    return r;
}
static inline Wide net_wide(const REAL *from) { Wide r; memcpy(&r, from, sizeof r); return r; }

/* Lanes whose numbers have the same bits as those of lane l. */
static inline I net_alike(V a, int l) { return (I)a == ((I)a)[l]; }
