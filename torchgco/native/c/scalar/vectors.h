/* vectors.h for a single lane in plain C99: V is a number, and I is 0 where false. */
#pragma once
#include "standard.h"
#include "real.h"

#define TGCO_MATH(name) TGCO_JOIN(name, TGCO_JOIN(TGCO_SUFFIX_, REAL))

typedef REAL V;
typedef int I;
#define LANE(a, l) (a)
#define NOT(where) (!(where))

#define TGCO_INLINE static inline
#ifndef TGCO_APART
#define TGCO_APART static
#define TGCO_BETWEEN_UNITS static
#define TGCO_LARGE static
#endif

static inline V tgco_set(double c) { return (V)c; }

/* a b + c, rounded once where the processor can, or where TGCO_FUSED is defined: compile with -ffp-contract=off, and no
   bit depends on the level of optimisation or on the compiler. */
static inline V tgco_fused(V a, V b, V c) {
#if defined(TGCO_FUSED) || defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__FP_FAST_FMA)
    return TGCO_MATH(fma)(a, b, c);
#else
    return a * b + c;
#endif
}

static inline V tgco_choose(I where, V a, V b) { return where ? a : b; }
static inline V tgco_if(I where, V a) { return where ? a : (V)0; }
static inline V tgco_permuted(V a, I index) { (void)index; return a; }
static inline int tgco_any(I where) { return where != 0; }
static inline V tgco_fabs(V a) { return TGCO_MATH(fabs)(a); }
static inline V tgco_copysign(V a, V b) { return TGCO_MATH(copysign)(a, b); }

/* Bits of numbers, as of vectors.h. */
#if TGCO_IS_DOUBLE
typedef long long Whole; /* of 64 bits, whatever counters have */
typedef unsigned long long Bits;
#else
typedef int32_t Whole;
typedef uint32_t Bits;
#endif
static inline Bits tgco_bits(V a) { Bits b; memcpy(&b, &a, sizeof b); return b; }
static inline V tgco_of_bits(Bits b) { V a; memcpy(&a, &b, sizeof a); return a; }
#define TGCO_WHOLE_OF(t) ((I)(tgco_bits(t) & 3)) /* of a quarter the two lowest bits count */
static inline V tgco_power_of_two(V t) { return tgco_of_bits((tgco_bits(t) + TGCO_BIAS) << TGCO_EXPONENT); }
static inline V tgco_turned(V a, I quarter) { return quarter & 2 ? -a : a; }
static inline V tgco_mantissa(V x) {
    return tgco_of_bits((tgco_bits(x) & ~tgco_bits(-(V)INFINITY)) | tgco_bits((V)1));
}
static inline V tgco_exponent(V x) {
    return (V)((Whole)((tgco_bits(x) >> TGCO_EXPONENT) & (2 * TGCO_BIAS + 1)) - TGCO_BIAS);
}
static inline V tgco_middle(V x, V *power) {
    /* floor of the difference over 2^TGCO_EXPONENT: shifts of negative numbers are the compiler's */
    Whole less = (Whole)(tgco_bits(x) - tgco_bits((V)0x1.6a09e667f3bcdp-1));
    Whole e = less >= 0 ? less >> TGCO_EXPONENT : -1 - (Whole)((Bits)(-1 - less) >> TGCO_EXPONENT);
    *power = (V)e;
    return tgco_of_bits(tgco_bits(x) - ((Bits)e << TGCO_EXPONENT));
}
