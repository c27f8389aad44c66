/* Exponentials, logarithms and the tangent of all lanes at once, each within 3 units in the last place. Where a lane's
   argument is out of the range that a formula is made for, or not finite, the C library is called for that lane. */
#pragma once
#include "lanes.h"

#if TGCO_IS_DOUBLE
#define TGCO_LN2_1 0x1.62e42fefa38p-1 /* short enough for its products with exponents to be exact */
#define TGCO_LN2_2 0x1.ef35793c7673p-45
#define TGCO_FARTHEST 700.0 /* exp of it, and of its negative, are normal numbers */
#define TGCO_NORMAL 0x1p-1022
#define TGCO_LARGEST 0x1.fffffffffffffp+1023
#define TGCO_SATURATED 20.0 /* tanh of it is 1 */
#else
#define TGCO_LN2_1 0x1.62e4p-1
#define TGCO_LN2_2 0x1.7f7d1cf7ap-20
#define TGCO_FARTHEST 80.0
#define TGCO_NORMAL 0x1p-126
#define TGCO_LARGEST 0x1.fffffep+127
#define TGCO_SATURATED 10.0
#endif

/* `near`, and where `far` is true what the C library makes of x. */
#define TGCO_FROM_LIBRARY(name) \
    TGCO_APART V tgco_distant_##name(V x, V near, I far) { \
        for (int i = 0; i < LANES; i++) if (LANE(far, i)) LANE(near, i) = TGCO_MATH(name)(LANE(x, i)); \
        return near; \
    }

/* exp(x) - 1 = 2^k (1 + rest) - 1 for x = k ln 2 + r, |r| <= ln 2 / 2: the series of exp(r) - 1. Returns 2^k. */
static inline V tgco_split(V x, V *rest) {
    V t = tgco_fused(x, SET(0x1.71547652b82fep+0), SET(TGCO_WHOLE)), k = t - SET(TGCO_WHOLE);
    V r = tgco_fused(-k, SET(TGCO_LN2_2), tgco_fused(-k, SET(TGCO_LN2_1), x));
#if TGCO_IS_DOUBLE
    V p = SET(1.0 / 6227020800.0);
    p = tgco_fused(p, r, SET(1.0 / 479001600.0)); p = tgco_fused(p, r, SET(1.0 / 39916800.0));
    p = tgco_fused(p, r, SET(1.0 / 3628800.0)); p = tgco_fused(p, r, SET(1.0 / 362880.0));
    p = tgco_fused(p, r, SET(1.0 / 40320.0)); p = tgco_fused(p, r, SET(1.0 / 5040.0));
#else
    V p = SET(1.0 / 5040.0);
#endif
    p = tgco_fused(p, r, SET(1.0 / 720.0)); p = tgco_fused(p, r, SET(1.0 / 120.0)); p = tgco_fused(p, r, SET(1.0 / 24.0));
    p = tgco_fused(p, r, SET(1.0 / 6.0)); p = tgco_fused(p, r, SET(0.5));
    *rest = tgco_fused(p * r, r, r);
    return tgco_power_of_two(t); /* the lowest bits of t are those of k */
}

TGCO_FROM_LIBRARY(exp)
static inline V tgco_exp(V x) {
    V rest, power = tgco_split(x, &rest), value = tgco_fused(power, rest, power);
    I far = NOT(tgco_fabs(x) <= SET(TGCO_FARTHEST));
    return tgco_any(far) ? tgco_distant_exp(x, value, far) : value;
}

TGCO_FROM_LIBRARY(expm1)
static inline V tgco_expm1(V x) {
    V rest, power = tgco_split(x, &rest), value = tgco_fused(power, rest, power - SET(1.0));
    I far = NOT(tgco_fabs(x) <= SET(TGCO_FARTHEST));
    return tgco_any(far) ? tgco_distant_expm1(x, value, far) : value;
}

/* (e - 1) / (e + 1) for e = exp(2 |x|). */
static inline V tgco_tanh(V x) {
    V size = tgco_fabs(x), rest;
    size = tgco_choose(size > SET(TGCO_SATURATED), SET(TGCO_SATURATED), size);
    V power = tgco_split(size + size, &rest), less = tgco_fused(power, rest, power - SET(1.0));
    return tgco_copysign(less / (less + SET(2.0)), x);
}

/* The logarithm of a normal number and a small `more`: with m 2^e = x, m about 1, f = m - 1 and s = f / (2 + f), it is
   e ln 2 + f - s (f - 2 s^2/3 - 2 s^4/5 - ...) + more. */
static inline V tgco_logarithm(V x, V more) {
    V power, f = tgco_middle(x, &power) - SET(1.0), s = f / (SET(2.0) + f), z = s * s;
#if TGCO_IS_DOUBLE
    V p = SET(2.0 / 21.0);
    p = tgco_fused(p, z, SET(2.0 / 19.0)); p = tgco_fused(p, z, SET(2.0 / 17.0)); p = tgco_fused(p, z, SET(2.0 / 15.0));
    p = tgco_fused(p, z, SET(2.0 / 13.0)); p = tgco_fused(p, z, SET(2.0 / 11.0));
#else
    V p = SET(2.0 / 11.0);
#endif
    p = tgco_fused(p, z, SET(2.0 / 9.0)); p = tgco_fused(p, z, SET(2.0 / 7.0)); p = tgco_fused(p, z, SET(2.0 / 5.0));
    p = tgco_fused(p, z, SET(2.0 / 3.0));
    V low = tgco_fused(power, SET(TGCO_LN2_2), more), bend = tgco_fused(-p, z, f);
    return tgco_fused(power, SET(TGCO_LN2_1), f + tgco_fused(-s, bend, low));
}

TGCO_FROM_LIBRARY(log)
static inline V tgco_log(V x) {
    V value = tgco_logarithm(x, SET(0.0));
    I far = NOT((x >= SET(TGCO_NORMAL)) & (x <= SET(TGCO_LARGEST)));
    return tgco_any(far) ? tgco_distant_log(x, value, far) : value;
}

/* What 1 + x loses by rounding comes to its logarithm. */
TGCO_FROM_LIBRARY(log1p)
static inline V tgco_log1p(V x) {
    V one = SET(1.0), u = one + x, lost = tgco_choose(x > one, one - (u - x), x - (u - one));
    V value = tgco_logarithm(u, lost / u);
    I far = NOT((x > -one) & (x <= SET(TGCO_LARGEST)));
    return tgco_any(far) ? tgco_distant_log1p(x, value, far) : value;
}

TGCO_FROM_LIBRARY(tan)
static inline V tgco_tan(V x) {
    V sine, cosine;
    I quarter = tgco_series(x, &sine, &cosine), odd = (quarter & 1) != 0;
    V value = tgco_choose(odd, -cosine, sine) / tgco_choose(odd, sine, cosine);
    I far = NOT(tgco_fabs(x) <= SET(TGCO_FAR));
    return tgco_any(far) ? tgco_distant_tan(x, value, far) : value;
}
