/* Memory for solves: a thread has its share of one block of numbers, where those of STRIDE threads are interleaved, and one of
   all else, from which it takes as from a stack. All of it is free again when a problem is begun. */
#pragma once
#include "model.h"
_Static_assert(sizeof(Rows) + 2 * sizeof(void *) <= ROWS, "Rows have more bytes than Python takes for them");

/* Of all threads: numbers of each, and bytes of all else. */
typedef struct { V *numbers; char *others; int64_t count, bytes; } Arenas;

#define IN_PLACE(data) NONE /* never: numbers of threads are interleaved */

typedef struct { char *numbers, *others; int64_t count, bytes, used, taken; } Arena;
__shared__ Arena tgco_arenas[THREADS];

static void begin_arena(Arenas of) {
    Arena *own = tgco_arenas + LOCAL_THREAD;
    own->numbers = (char *)(of.numbers + THREAD / STRIDE * STRIDE * of.count + THREAD % STRIDE);
    own->others = of.others + THREAD * of.bytes;
    own->count = of.count; own->bytes = of.bytes;
    own->used = own->taken = 0;
}

static void *take(const Problem *p, size_t bytes) {
    Arena *own = tgco_arenas + LOCAL_THREAD;
    int64_t whole = ((int64_t)bytes + 7) / 8 * 8;
    int64_t *memory = (int64_t *)(own->others + own->taken);
    if (own->taken + whole > own->bytes) return NULL;
    own->taken += whole;
    for (int64_t i = 0; i < whole / 8; i++) memory[i] = 0;
    return memory;
}

static Numbers take_numbers(const Problem *p, int64_t count) {
    Arena *own = tgco_arenas + LOCAL_THREAD;
    Numbers memory = (Numbers)(void *)(own->numbers + own->used * (int64_t)(STRIDE * sizeof(V)));
    if (own->used + count > own->count) return NONE;
    own->used += count;
    for (int64_t i = 0; i < count; i++) memory[i] = SET(0.0);
    return memory;
}

/* What was taken later goes with it. */
template <class Pointer> static void give(const Problem *p, Pointer memory) {
    Arena *own = tgco_arenas + LOCAL_THREAD;
    char *at = (char *)memory;
    int64_t each = STRIDE * sizeof(V), number = (at - own->numbers) / each, other = at - own->others;
    if (at >= own->numbers && number < own->used) own->used = number;
    else if (at >= own->others && other < own->taken) own->taken = other;
}
