/* Vectors V of LANES numbers of type REAL, and what truth of their lanes is, I. scalar/vectors.h has
   the same for a single lane. */
#pragma once
#include "standard.h"
#include "real.h"

/* The function of the C library for REAL: sin or sinf. */
#define TGCO_MATH(name) TGCO_JOIN(__builtin_##name, TGCO_JOIN(TGCO_SUFFIX_, REAL))

typedef REAL V __attribute__((vector_size(LANES * sizeof(REAL))));
typedef __typeof__((V){0} == (V){0}) I; /* all bits of a lane set where true */
#define LANE(a, l) ((a)[l])
#define NOT(where) (~(where))

#define TGCO_INLINE static inline __attribute__((always_inline))
#define TGCO_APART static __attribute__((noinline))
#define TGCO_BETWEEN_UNITS __attribute__((visibility("hidden"))) /* of what one unit offers the others */
#define TGCO_LARGE static /* of functions that a GPU's compiler leaves whole */

static inline V tgco_set(double c) { return (REAL)c - (V){0}; } /* minus, so that -0.0 keeps its sign */

/* a b + c of all lanes, rounded once where the processor can. Products and sums are fused here alone, and compiled with
   -ffp-contract=off: so no bit depends on what is inlined, on the level of optimisation or on the compiler. */
#define TGCO_BYTES (LANES * (TGCO_IS_DOUBLE ? 8 : 4))
#if defined(__FMA__) && !defined(__clang__)
#if TGCO_BYTES >= 64 && defined(__AVX512F__)
#define TGCO_PART 64
#define TGCO_FMA_double(a, b, c) __builtin_ia32_vfmaddpd512_mask(a, b, c, -1, 4)
#define TGCO_FMA_float(a, b, c) __builtin_ia32_vfmaddps512_mask(a, b, c, -1, 4)
#elif TGCO_BYTES >= 32
#define TGCO_PART 32
#define TGCO_FMA_double(a, b, c) __builtin_ia32_vfmaddpd256(a, b, c)
#define TGCO_FMA_float(a, b, c) __builtin_ia32_vfmaddps256(a, b, c)
#elif TGCO_BYTES == 16
#define TGCO_PART 16
#define TGCO_FMA_double(a, b, c) __builtin_ia32_vfmaddpd(a, b, c)
#define TGCO_FMA_float(a, b, c) __builtin_ia32_vfmaddps(a, b, c)
#endif
#endif
TGCO_INLINE V tgco_fused(V a, V b, V c) {
#if defined(TGCO_PART) && TGCO_PART == TGCO_BYTES
    return TGCO_JOIN(TGCO_FMA_, REAL)(a, b, c);
#elif defined(TGCO_PART)
    typedef REAL Part __attribute__((vector_size(TGCO_PART)));
    typedef union { V whole; Part part[TGCO_BYTES / TGCO_PART]; } Parts;
    Parts x = {a}, y = {b}, z = {c};
    for (int i = 0; i < TGCO_BYTES / TGCO_PART; i++)
        z.part[i] = TGCO_JOIN(TGCO_FMA_, REAL)(x.part[i], y.part[i], z.part[i]);
    return z.whole;
#elif defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__FP_FAST_FMA)
    for (int i = 0; i < LANES; i++) c[i] = TGCO_MATH(fma)(a[i], b[i], c[i]);
    return c;
#else
    return a * b + c;
#endif
}

static inline V tgco_choose(I where, V a, V b) { return (V)((where & (I)a) | (~where & (I)b)); }
static inline V tgco_if(I where, V a) { return (V)(where & (I)a); }

/* The lanes of a in another order: lane i gets lane index[i], 0 to LANES - 1. Clang, and so zig, has no builtin for it. */
static inline V tgco_permuted(V a, I index) {
#ifdef __clang__
    V r;
    for (int i = 0; i < LANES; i++) r[i] = a[index[i]];
    return r;
#else
    return __builtin_shuffle(a, index);
#endif
}

/* Whether a lane is true. */
static inline int tgco_any(I where) {
    typedef long long Word __attribute__((vector_size(sizeof(I))));
    Word words = (Word)where;
    long long all = 0;
    for (int i = 0; i < (int)(sizeof(I) / sizeof(long long)); i++) all |= words[i];
    return all != 0;
}

static inline V tgco_fabs(V a) { return (V)(~(I)tgco_set(-0.0) & (I)a); }
static inline V tgco_copysign(V a, V b) { return (V)((I)tgco_fabs(a) | ((I)tgco_set(-0.0) & (I)b)); }

/* The lowest bits of t as a whole number, and what functions.h makes of bits: 2^k for k in the lowest bits of t; a with
   its sign changed where `quarter` has the bit 2; m in [1, 2) and e of a normal number m 2^e; the same with m from the root
   of a half on. */
#define TGCO_WHOLE_OF(t) ((I)(t))
static inline V tgco_power_of_two(V t) { return (V)(((I)t + TGCO_BIAS) << TGCO_EXPONENT); }
static inline V tgco_turned(V a, I quarter) { return (V)((I)a ^ ((quarter & 2) << (8 * (int)sizeof(REAL) - 2))); }
static inline V tgco_number(I whole) { return (V)(whole + (I)tgco_set(TGCO_WHOLE)) - tgco_set(TGCO_WHOLE); }
static inline V tgco_mantissa(V x) { return (V)(((I)x & ~(I)tgco_set(-INFINITY)) | (I)tgco_set(1.0)); }
static inline V tgco_exponent(V x) {
    return tgco_number((((I)x >> TGCO_EXPONENT) & (2 * TGCO_BIAS + 1)) - TGCO_BIAS);
}
static inline V tgco_middle(V x, V *power) {
    I bits = (I)x, e = (bits - (I)tgco_set(0x1.6a09e667f3bcdp-1)) >> TGCO_EXPONENT;
    *power = tgco_number(e);
    return (V)(bits - (e << TGCO_EXPONENT));
}
