/* What C has and the compilers of CUDA C++ lack, or call otherwise. Compiled by g++, a thread is a call. */
#pragma once
#define TGCO_FUSED
#define TGCO_APART static __noinline__
#define TGCO_BETWEEN_UNITS static __noinline__
#define TGCO_LARGE static __noinline__
#define restrict __restrict__
#define _Static_assert static_assert
#define any any_lane /* CUDA has a function of that name */

#ifdef __CUDACC_RTC__
typedef signed char int8_t;
typedef unsigned char uint8_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
#define NULL 0
#define INFINITY __int_as_float(0x7f800000)
#define NAN __int_as_float(0x7fffffff)
#define DBL_MAX 0x1.fffffffffffffp+1023
#define DBL_EPSILON 0x1p-52

/* The number of this thread among all, and in its block, of which there are so many; that of its block. */
#define THREAD ((int64_t)blockIdx.x * blockDim.x + threadIdx.x)
#define LOCAL_THREAD ((int)threadIdx.x)
#define LOCAL_THREADS ((int)blockDim.x)
#define BLOCK_NUMBER ((int64_t)blockIdx.x)

static void memmove_down(void *to, const void *from, size_t bytes) {
    for (size_t i = 0; i < bytes; i++) ((char *)to)[i] = ((const char *)from)[i];
}
#define memmove memmove_down
#else
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#define __noinline__ __attribute__((noinline))
#define __global__
#define __shared__ static
static int64_t tgco_thread;
#define THREAD tgco_thread
#define BLOCK_NUMBER tgco_thread
#ifndef LOCAL_THREAD /* as tests define it */
#define LOCAL_THREAD 0
#define LOCAL_THREADS 1
#define __syncthreads() ((void)0)
#endif
static inline unsigned long long atomicAdd(unsigned long long *at, unsigned long long more) {
    unsigned long long before = *at;
    *at += more;
    return before;
}
#endif
