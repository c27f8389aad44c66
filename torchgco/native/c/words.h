/* As many numbers of 32 bits as there are lanes, and numbers of other types that have the same values, or the same bits. */
#pragma once
#include "standard.h"

typedef uint32_t W __attribute__((vector_size(LANES * 4)));
typedef int32_t Z __attribute__((vector_size(LANES * 4)));
typedef float F __attribute__((vector_size(LANES * 4)));
#define TGCO_CONVERTED(a, type) __builtin_convertvector(a, type)
#define BITS_OF(a) ((Z)(a))
#define OF_BITS(bits) ((F)(bits))

static inline F single(float c) { return c - (F){0}; }
