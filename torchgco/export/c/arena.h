/* Memory and time of an exported solver: its workspace's. */
#pragma once
#include "model.h"
#include "stack.h"

#define IN_PLACE(data) ((Numbers)(data))

static void *take(const Problem *p, size_t bytes) {
    Arena *arena = p->arena;
    size_t whole = (bytes + sizeof(double) - 1) / sizeof(double) * sizeof(double);
    void *memory = arena->next;
    if (whole > (size_t)(arena->end - arena->next)) return 0;
    arena->next += whole;
    memset(memory, 0, whole);
    return memory;
}

static Numbers take_numbers(const Problem *p, int64_t count) { return (Numbers)take(p, (size_t)count * sizeof(V)); }

/* All of it is taken anew for the next solve. */
static void give(const Problem *p, void *memory) { (void)p; (void)memory; }
