/* Vectors V of LANES numbers of type REAL (double or float), one problem or sample per lane; lanes are never mixed. */
#pragma once
#include <math.h>
#include <stdint.h>

/* The function of the C library for REAL: sin or sinf. */
#define TGCO_SUFFIX_double
#define TGCO_SUFFIX_float f
#define TGCO_IS_DOUBLE_double 1
#define TGCO_IS_DOUBLE_float 0
#define TGCO_JOIN_(a, b) a##b
#define TGCO_JOIN(a, b) TGCO_JOIN_(a, b)
#define TGCO_MATH(name) TGCO_JOIN(__builtin_##name, TGCO_JOIN(TGCO_SUFFIX_, REAL))
#define TGCO_IS_DOUBLE TGCO_JOIN(TGCO_IS_DOUBLE_, REAL)

typedef REAL V __attribute__((vector_size(LANES * sizeof(REAL))));
typedef __typeof__((V){0} == (V){0}) I; /* all bits of a lane set where true */
/* As many numbers of 32 bits, and numbers of other types that have the same values. */
typedef uint32_t W __attribute__((vector_size(LANES * 4)));
typedef int32_t Z __attribute__((vector_size(LANES * 4)));
typedef float F __attribute__((vector_size(LANES * 4)));
#define TGCO_CONVERTED(a, type) __builtin_convertvector(a, type)

#define TGCO_INLINE static inline __attribute__((always_inline))
#define TGCO_APART static __attribute__((noinline))

static inline V tgco_set(double c) { return (REAL)c - (V){0}; } /* minus, so that -0.0 keeps its sign */
#define SET(c) tgco_set(c)

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
#define ADD(sum, a, b) ((sum) = tgco_fused((a), (b), (sum))) /* sum += a b */
#define SUBTRACT(sum, a, b) ((sum) = tgco_fused(-(a), (b), (sum))) /* sum -= a b */

static inline V tgco_choose(I where, V a, V b) { return (V)((where & (I)a) | (~where & (I)b)); }
static inline V tgco_if(I where, V a) { return (V)(where & (I)a); }
static inline V tgco_truth(I where) { return tgco_if(where, SET(1.0)); }
static inline I tgco_is(V a) { return a != SET(0.0); } /* NaN is true, as in C */

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

static inline V tgco_fabs(V a) { return (V)(~(I)SET(-0.0) & (I)a); }
static inline V tgco_copysign(V a, V b) { return (V)((I)tgco_fabs(a) | ((I)SET(-0.0) & (I)b)); }
static inline V tgco_sign(V a) { return tgco_choose(tgco_is(a) & (a == a), tgco_copysign(SET(1.0), a), a); }
/* Of a number and a NaN these return the number, like C's fmin and fmax. */
static inline V tgco_fmin(V a, V b) { return tgco_choose((a < b) | (b != b), a, b); }
static inline V tgco_fmax(V a, V b) { return tgco_choose((a > b) | (b != b), a, b); }
/* These return NaN, like PyTorch's minimum and maximum. */
static inline V tgco_minimum(V a, V b) { return tgco_choose((a < b) | (a != a), a, b); }
static inline V tgco_maximum(V a, V b) { return tgco_choose((a > b) | (a != a), a, b); }
static inline V tgco_single(V a) { /* rounded to single precision */
    V r;
    for (int i = 0; i < LANES; i++) r[i] = (REAL)(float)a[i];
    return r;
}

#define TGCO_BY_LANE_1(name) \
    static inline V tgco_##name(V a) { \
        V r; \
        for (int i = 0; i < LANES; i++) r[i] = TGCO_MATH(name)(a[i]); \
        return r; \
    }
#define TGCO_BY_LANE_2(name) \
    static inline V tgco_##name(V a, V b) { \
        V r; \
        for (int i = 0; i < LANES; i++) r[i] = TGCO_MATH(name)(a[i], b[i]); \
        return r; \
    }
TGCO_BY_LANE_1(asin) TGCO_BY_LANE_1(acos) TGCO_BY_LANE_1(atan)
TGCO_BY_LANE_1(sinh) TGCO_BY_LANE_1(cosh)
TGCO_BY_LANE_1(asinh) TGCO_BY_LANE_1(acosh) TGCO_BY_LANE_1(atanh)
TGCO_BY_LANE_1(erf) TGCO_BY_LANE_1(sqrt) TGCO_BY_LANE_1(floor) TGCO_BY_LANE_1(ceil)
TGCO_BY_LANE_2(pow) TGCO_BY_LANE_2(fmod) TGCO_BY_LANE_2(atan2) TGCO_BY_LANE_2(hypot)

/* Sine and cosine of all lanes at once: x = k pi/2 + r with |r| <= pi/4, and the Taylor series of both in r up to the
   first term that no longer counts. pi/2 comes in three parts, of which the first two are short enough for their
   products with k to be exact. Where |x| is too large for that, or not finite, the C library is called lane by lane. */
#if TGCO_IS_DOUBLE
#define TGCO_WHOLE 0x1.8p52 /* adding it leaves the nearest whole number in the lowest bits */
#define TGCO_FAR 1e5
#define TGCO_QUARTER_1 0x1.921fb544p+0
#define TGCO_QUARTER_2 0x1.0b4611a6p-34
#define TGCO_QUARTER_3 0x1.3198a2e037073p-69
#else
#define TGCO_WHOLE 0x1.8p23
#define TGCO_FAR 1e4
#define TGCO_QUARTER_1 0x1.92p+0
#define TGCO_QUARTER_2 0x1.fb4p-12
#define TGCO_QUARTER_3 0x1.4442dp-24
#endif

/* Term i of both series, written out: in a loop that isn't unrolled its factors are quotients computed at run time. */
#define TGCO_TERM(i) \
    sine = tgco_fused(s * SET(-1.0 / (2 * (i) * (2 * (i) + 1))), sine, SET(1.0)); \
    cosine = tgco_fused(s * SET(-1.0 / ((2 * (i)-1) * (2 * (i)))), cosine, SET(1.0));

/* sin r and cos r; returns k. */
static inline I tgco_series(V x, V *of_sine, V *of_cosine) {
    V t = tgco_fused(x, SET(0x1.45f306dc9c883p-1), SET(TGCO_WHOLE)), k = t - SET(TGCO_WHOLE), r = x;
    SUBTRACT(r, k, SET(TGCO_QUARTER_1));
    SUBTRACT(r, k, SET(TGCO_QUARTER_2));
    SUBTRACT(r, k, SET(TGCO_QUARTER_3));
    /* sin r = r (1 - s/(2 3) (1 - s/(4 5) (...))), cos r = 1 - s/(1 2) (1 - s/(3 4) (...)), s = r^2 */
    V s = r * r, sine = SET(1.0), cosine = SET(1.0);
#if TGCO_IS_DOUBLE
    TGCO_TERM(8) TGCO_TERM(7) TGCO_TERM(6) TGCO_TERM(5)
#endif
    TGCO_TERM(4) TGCO_TERM(3) TGCO_TERM(2) TGCO_TERM(1)
    *of_sine = r * sine;
    *of_cosine = cosine;
    return (I)t;
}
static inline V tgco_wave(V x, int shift) {
    V sine, cosine;
    I quarter = tgco_series(x, &sine, &cosine) + shift;
    V value = tgco_choose((quarter & 1) != 0, cosine, sine);
    I sign = (quarter & 2) << (8 * (int)sizeof(REAL) - 2);
    return (V)((I)value ^ sign);
}
#define TGCO_WAVE(name, shift) \
    TGCO_APART V tgco_far_##name(V x, V near) { \
        for (int i = 0; i < LANES; i++) \
            if (!(TGCO_MATH(fabs)(x[i]) <= (REAL)TGCO_FAR)) near[i] = TGCO_MATH(name)(x[i]); \
        return near; \
    } \
    static inline V tgco_##name(V x) { \
        V value = tgco_wave(x, shift); \
        return tgco_any(~(tgco_fabs(x) <= SET(TGCO_FAR))) ? tgco_far_##name(x, value) : value; \
    }
TGCO_WAVE(sin, 0)
TGCO_WAVE(cos, 1)
