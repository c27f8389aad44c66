/* Normal draws in single precision that are a function of a key and of their number, as `draws.standard_normal` makes
   them: a counter per sample and row is hashed by MurmurHash3's finaliser (Appleby), two words to a Box-Muller pair. */
#pragma once
#include "constants.h"
#include "lanes.h"
#include "words.h" /* or scalar/words.h */

static inline W mixed(W z) {
    z ^= z >> 16;
    z *= MURMUR_1;
    z ^= z >> 13;
    z *= MURMUR_2;
    return z ^ (z >> 16);
}

/* 24 bits of each word as a number in (0, 1]. */
static inline F uniform(W word) {
    return (TGCO_CONVERTED((Z)(word >> 8), F) + single(0.5f)) * single(0x1p-24f);
}

/* sqrt(-2 log a) for a in (0, 1]: a = m 2^e with m in [sqrt(1/2), sqrt(2)), log m = 2 atanh((m - 1) / (m + 1)). */
static inline F radius(F a) {
    Z bits = BITS_OF(a) - 0x3f3504f3, e = bits >> 23;
    F m = OF_BITS((bits & 0x7fffff) + 0x3f3504f3), f = (m - single(1.0f)) / (m + single(1.0f)), s = f * f;
    F series = single(1.0f / 9);
    for (int i = 7; i > 0; i -= 2) series = series * s + single(1.0f / i);
    F square = single(-2.0f) * (TGCO_CONVERTED(e, F) * single(0x1.62e43p-1f) + single(2.0f) * f * series),
      root;
    for (int l = 0; l < LANES; l++) LANE(root, l) = sqrtf(LANE(square, l) > 0 ? LANE(square, l) : 0);
    return root;
}

/* Cosine and sine of 2 pi a for a in (0, 1]: a quarter turn is taken off exactly, Taylor's series give the rest. */
static inline void turn(F a, F *cosine, F *sine) {
    Z quarter = TGCO_CONVERTED(single(4.0f) * a + single(0.5f), Z);
    F r = single(6.283185307f) * (a - single(0.25f) * TGCO_CONVERTED(quarter, F)), s = r * r;
    F even = single(1.0f), odd = single(1.0f);
    for (int i = 4; i > 0; i--) {
        even = single(1.0f) - s * single(1.0f / ((2 * i - 1) * (2 * i))) * even;
        odd = single(1.0f) - s * single(1.0f / (2 * i * (2 * i + 1))) * odd;
    }
    odd *= r;
    Z swapped = -(quarter & 1);
    Z c = (swapped & BITS_OF(odd)) | (~swapped & BITS_OF(even)), d = (swapped & BITS_OF(even)) | (~swapped & BITS_OF(odd));
    *cosine = OF_BITS(c ^ (((quarter + 1) & 2) << 30));
    *sine = OF_BITS(d ^ ((quarter & 2) << 30));
}

/* The pair of draws of a number of each lane. */
static inline void pair(uint64_t key, W number, F *cosine, F *sine) {
    W word = mixed((number * WEYL) ^ (uint32_t)key);
    F length = radius(uniform(word)), c, s;
    turn(uniform(mixed(word ^ (uint32_t)(key >> 32))), &c, &s);
    *cosine = length * c;
    *sine = length * s;
}

/* Draws z (rows) of the samples first, first + 1, ..., one to a lane. */
static void normal(uint64_t key, int64_t first, int64_t rows, V *z) {
    int64_t half = (rows + 1) / 2;
    W number;
    for (int l = 0; l < LANES; l++) LANE(number, l) = (uint32_t)(first + l) * (uint32_t)half;
    for (int64_t i = 0; i < half; i++) {
        F cosine, sine;
        pair(key, number + (uint32_t)i, &cosine, &sine);
        z[i] = TGCO_CONVERTED(cosine, V);
        if (i + half < rows) z[i + half] = TGCO_CONVERTED(sine, V);
    }
}
