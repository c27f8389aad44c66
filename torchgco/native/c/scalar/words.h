/* words.h of a single lane. */
#pragma once
#include "standard.h"

typedef uint32_t W;
typedef int32_t Z;
typedef float F;
#define TGCO_CONVERTED(a, type) ((type)(a))

static inline Z BITS_OF(F a) { Z bits; memcpy(&bits, &a, sizeof bits); return bits; }
static inline F OF_BITS(Z bits) { F a; memcpy(&a, &bits, sizeof a); return a; }
static inline F single(float c) { return c; }
