/* The time, s, by the clock of the device, and when a kernel began. */
#pragma once
__shared__ double tgco_begun;

#ifdef __CUDACC_RTC__
static double tgco_now(void) {
    unsigned long long nanoseconds;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(nanoseconds));
    return 1e-9 * (double)nanoseconds;
}
#else
#include <ctime>
static double tgco_now(void) { return (double)std::clock() / CLOCKS_PER_SEC; }
#endif
#define SECONDS_NOW(how) tgco_now()
#define SECONDS_BEGUN(how) tgco_begun
