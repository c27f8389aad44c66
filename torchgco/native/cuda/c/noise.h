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

__shared__ double tgco_least[THREADS];
static double least_of_all(double least) {
    tgco_least[LOCAL_THREAD] = least;
    __syncthreads();
    for (int i = 0; i < LOCAL_THREADS; i++) if (tgco_least[i] < least) least = tgco_least[i];
    return least;
}
