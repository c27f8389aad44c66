/* Kernels of MPPI: all samples of some problems at the same time. */
#pragma once
_Static_assert(sizeof(Samples) <= SAMPLES, "Samples have more bytes than Python takes for them");

/* A thread per problem, `first` and those after it: the working data of each, at `all`. */
extern "C" __global__ void sample_begin(
    const Sampling *o, Samples *all, int64_t first, int64_t problems, V *numbers, char *others, int64_t count, int64_t bytes,
    unsigned long long *lacks) {
    Arenas arenas = {numbers, others, count, bytes};
    int64_t e = THREAD;
    if (e >= problems) return;
    begin_arena(arenas);
    if (begin(all + e, o)) load(all + e, first + e);
    else atomicAdd(lacks, 1);
}

extern "C" __global__ void sample_round(Samples *all, int64_t first, int64_t problems, int64_t round) {
    if (THREAD < problems) begin_round(all + THREAD, first + THREAD, round);
}

/* A thread per sample. */
extern "C" __global__ void sample_fly(const Sampling *o, const Samples *all, int64_t problems) {
    if (THREAD >= problems * o->samples) return;
    Samples own = all[THREAD / o->samples];
    own.first = THREAD % o->samples;
    fly(&own);
}

/* A block per problem. */
extern "C" __global__ void sample_weigh(const Sampling *o, const Samples *all) { weigh(o, all[BLOCK_NUMBER].score); }

/* A thread per stage of each problem and partial sum, which leaves out samples of no weight. */
extern "C" __global__ void sample_average(const Sampling *o, const Samples *all, int64_t problems) {
    int64_t N = o->of->N, e = THREAD / (N * SUMS), k = THREAD / SUMS % N;
    if (e >= problems) return;
    Samples own = all[e];
    V sum[NU], eps[NU], u[NU];
    for (int j = 0; j < NU; j++) sum[j] = SET(0.0);
    for (own.first = THREAD % SUMS; own.first < o->samples; own.first += SUMS) {
        V weight = (V)own.score[own.first];
        if (!(weight > SET(0.0))) continue;
        draw(&own, k, eps, u);
        for (int j = 0; j < NU; j++) ADD(sum[j], weight, u[j]);
    }
    for (int j = 0; j < NU; j++) own.sum[(k * NU + j) * SUMS + THREAD % SUMS] = sum[j];
}

/* A thread per control of each problem, into `mean` (E, N, NU), too. */
extern "C" __global__ void sample_mean(const Sampling *o, const Samples *all, int64_t first, int64_t problems) {
    int64_t size = o->of->N * NU, e = THREAD / size, i = THREAD % size;
    if (e >= problems) return;
    V mean = mean_of(all + e, i);
    all[e].mean[i] = mean;
    o->mean[(first + e) * size + i] = (double)mean;
}
