/* A heap, whose cheapest item is at its top. Whoever includes it defines COST, the type of costs. */
#pragma once
#include <stdint.h>

typedef struct { COST cost; int32_t item; } Entry;

static void push(Entry *heap, int64_t *count, COST cost, int32_t item) {
    int64_t i = (*count)++;
    for (; i > 0 && heap[(i - 1) / 2].cost > cost; i = (i - 1) / 2) heap[i] = heap[(i - 1) / 2];
    heap[i] = (Entry){cost, item};
}

static Entry pop(Entry *heap, int64_t *count) {
    Entry top = heap[0], last = heap[--*count];
    int64_t i = 0;
    for (int64_t child; (child = 2 * i + 1) < *count; i = child) {
        child += child + 1 < *count && heap[child + 1].cost < heap[child].cost;
        if (!(heap[child].cost < last.cost)) break;
        heap[i] = heap[child];
    }
    heap[i] = last;
    return top;
}
