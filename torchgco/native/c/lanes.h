/* Vectors V of LANES numbers of type REAL (double or float), one problem or sample per lane; lanes are never mixed. */
#pragma once

#include "vectors.h" /* or scalar/vectors.h */
#include "pointers.h" /* or cuda/c/strided.h */

#define SET(c) tgco_set(c)
#define ADD(sum, a, b) ((sum) = tgco_fused((a), (b), (sum))) /* sum += a b */
#define SUBTRACT(sum, a, b) ((sum) = tgco_fused(-(a), (b), (sum))) /* sum -= a b */

static inline V tgco_truth(I where) { return tgco_if(where, SET(1.0)); }
static inline I tgco_is(V a) { return a != SET(0.0); } /* NaN is true, as in C */
static inline V tgco_sign(V a) { return tgco_choose(tgco_is(a) & (a == a), tgco_copysign(SET(1.0), a), a); }
/* Of a number and a NaN these return the number, like C's fmin and fmax. */
static inline V tgco_fmin(V a, V b) { return tgco_choose((a < b) | (b != b), a, b); }
static inline V tgco_fmax(V a, V b) { return tgco_choose((a > b) | (b != b), a, b); }
/* These return NaN, like PyTorch's minimum and maximum. */
static inline V tgco_minimum(V a, V b) { return tgco_choose((a < b) | (a != a), a, b); }
static inline V tgco_maximum(V a, V b) { return tgco_choose((a > b) | (a != a), a, b); }
static inline V tgco_single(V a) { /* rounded to single precision */
    V r;
    for (int i = 0; i < LANES; i++) LANE(r, i) = (REAL)(float)LANE(a, i);
    return r;
}

#define TGCO_BY_LANE_1(name) \
    static inline V tgco_##name(V a) { \
        V r; \
        for (int i = 0; i < LANES; i++) LANE(r, i) = TGCO_MATH(name)(LANE(a, i)); \
        return r; \
    }
#define TGCO_BY_LANE_2(name) \
    static inline V tgco_##name(V a, V b) { \
        V r; \
        for (int i = 0; i < LANES; i++) LANE(r, i) = TGCO_MATH(name)(LANE(a, i), LANE(b, i)); \
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
#define TGCO_FAR 1e5
#define TGCO_QUARTER_1 0x1.921fb544p+0
#define TGCO_QUARTER_2 0x1.0b4611a6p-34
#define TGCO_QUARTER_3 0x1.3198a2e037073p-69
#else
#define TGCO_FAR 1e4
#define TGCO_QUARTER_1 0x1.92p+0
#define TGCO_QUARTER_2 0x1.fb4p-12
#define TGCO_QUARTER_3 0x1.4442dp-24
#endif

/* Term i of both series, written out: in a loop that isn't unrolled its factors are quotients computed at run time. */
#define TGCO_TERM(i) \
    sine = tgco_fused(s * SET(-1.0 / (2 * (i) * (2 * (i) + 1))), sine, SET(1.0)); \
    cosine = tgco_fused(s * SET(-1.0 / ((2 * (i)-1) * (2 * (i)))), cosine, SET(1.0));

/* sin r and cos r; returns k, or its lowest bits. */
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
    return TGCO_WHOLE_OF(t);
}
static inline V tgco_wave(V x, int shift) {
    V sine, cosine;
    I quarter = tgco_series(x, &sine, &cosine) + shift;
    return tgco_turned(tgco_choose((quarter & 1) != 0, cosine, sine), quarter);
}
#define TGCO_WAVE(name, shift) \
    TGCO_APART V tgco_far_##name(V x, V near) { \
        for (int i = 0; i < LANES; i++) \
            if (!(TGCO_MATH(fabs)(LANE(x, i)) <= (REAL)TGCO_FAR)) LANE(near, i) = TGCO_MATH(name)(LANE(x, i)); \
        return near; \
    } \
    static inline V tgco_##name(V x) { \
        V value = tgco_wave(x, shift); \
        return tgco_any(NOT(tgco_fabs(x) <= SET(TGCO_FAR))) ? tgco_far_##name(x, value) : value; \
    }
TGCO_WAVE(sin, 0)
TGCO_WAVE(cos, 1)
