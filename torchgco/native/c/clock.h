/* The time, s, by a clock that nobody sets. */
#pragma once
#define _POSIX_C_SOURCE 199309L
#include <time.h>

static double tgco_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}
#define SECONDS_NOW(how) tgco_now()
#define SECONDS_BEGUN(how) tgco_now() /* when a function begins */
