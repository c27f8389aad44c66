/* Memory for solves, from the heap. */
#pragma once
#include "model.h"

/* So many bytes of 0 for the solve of p, or so many numbers; NULL without memory. */
static void *take(const Problem *p, size_t bytes) {
    size_t whole = (bytes + sizeof(V) - 1) / sizeof(V) * sizeof(V);
    void *memory = aligned_alloc(sizeof(V), whole);
    if (memory) memset(memory, 0, whole);
    return memory;
}

static Numbers take_numbers(const Problem *p, int64_t count) { return take(p, count * sizeof(V)); }

#define IN_PLACE(data) NONE /* never: lanes are beside each other */

static void give(const Problem *p, void *memory) { free(memory); }
