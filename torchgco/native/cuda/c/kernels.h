/* Kernels by the names of functions that serve the problems first, ..., last - 1. Their threads take one problem after the other
   from a counter; what they can't do without memory they count in `lacks`. */
#pragma once
#include "clock.h"
#include "allocation.h"

#define KERNEL(Kind, name) \
    extern "C" __global__ void kernel_##name( \
        const Kind *of, int64_t first, int64_t last, V *numbers, char *others, int64_t count, int64_t bytes, \
        unsigned long long *next, unsigned long long *lacks) { \
        Arenas arenas = {numbers, others, count, bytes}; \
        tgco_begun = tgco_now(); \
        for (int64_t e; (e = first + (int64_t)atomicAdd(next, 1)) < last;) { \
            begin_arena(arenas); \
            if (!name(of, e, e + 1)) atomicAdd(lacks, 1); \
        } \
    }
