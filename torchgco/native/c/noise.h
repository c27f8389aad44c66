/* How samples come by their noise, and what a single thread makes of loops that several share. */
#pragma once
#include "normal.h"

#define NOISE(q, row) ((q)->z[row])

#define SHARED(i, count) for (int64_t i = 0; i < count; i++)
#define IN_ORDER(i, from, count) for (int64_t i = 0; i < count; i++) /* what all do, with numbers STAGED(from, i) */
#define STAGED(from, i) (from)[i]
#define IS_FIRST 1
#define ALL_DONE
#define LEAST_OF_ALL(least) (least)
