/* noise.h where a thread has a sample, which draws its noise where it is needed, and a block of threads shares loops. */
#pragma once
#include "normal.h"

#define NOISE(q, row) \
    noise_at((q)->key, (q)->first, ((q)->of->knots > 0 ? (q)->of->knots : (q)->of->of->N) * NU, row)

/* Draw `row` of `rows` of a sample. */
static V noise_at(uint64_t key, int64_t sample, int64_t rows, int64_t row) {
    int64_t half = (rows + 1) / 2;
    F cosine, sine;
    pair(key, (uint32_t)sample * (uint32_t)half + (uint32_t)(row < half ? row : row - half), &cosine, &sine);
    return TGCO_CONVERTED(row < half ? cosine : sine, V);
}

#define SHARED(i, count) for (int64_t i = LOCAL_THREAD; i < count; i += LOCAL_THREADS)
#define IS_FIRST (LOCAL_THREAD == 0)
#define ALL_DONE __syncthreads()
#define LEAST_OF_ALL(least) least_of_all(least)
/* Numbers come by way of shared memory, so many at a time: one after the other each would be waited for. */
#define IN_ORDER(i, from, count) \
    for (int64_t first_ = 0; first_ < (count); first_ += LOCAL_THREADS) \
        for (int i = 0, end_ = staged(from, first_, count); i < end_; i++)
#define STAGED(from, i) tgco_staged[i]

__shared__ double tgco_staged[THREADS];

static double least_of_all(double least) {
    tgco_staged[LOCAL_THREAD] = least;
    __syncthreads();
    for (int i = 0; i < LOCAL_THREADS; i++) if (tgco_staged[i] < least) least = tgco_staged[i];
    return least;
}

static int staged(const double *from, int64_t first, int64_t count) {
    int64_t left = count - first;
    __syncthreads(); /* those before have been read */
    if (LOCAL_THREAD < left) tgco_staged[LOCAL_THREAD] = from[first + LOCAL_THREAD];
    __syncthreads();
    return left < LOCAL_THREADS ? (int)left : LOCAL_THREADS;
}
