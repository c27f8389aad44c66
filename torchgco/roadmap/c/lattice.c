/* The cheapest ways over blocks of a lattice, and paths drawn taut through it (roadmap/blocks.py, roadmap/mapped.py). The
   part before this file declares `Sweep`, `String` and the constants. Two dimensions are three, with one layer. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct { double cost; int32_t block; } Entry;

static void push(Entry *heap, int64_t *count, double cost, int32_t block) {
    int64_t i = (*count)++;
    for (; i > 0 && heap[(i - 1) / 2].cost > cost; i = (i - 1) / 2) heap[i] = heap[(i - 1) / 2];
    heap[i] = (Entry){cost, block};
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

static double node_clearance(const Sweep *s, const int64_t *node) {
    return s->clearance[(node[0] * s->size[1] + node[1]) * s->size[2] + node[2]];
}

/* Whether the segment between the nodes of two blocks is nowhere deep in an obstacle. */
static int joined(const Sweep *s, int64_t a, int64_t b) {
    int64_t from[3], to[3], at[3];
    double square = 0.0;
    for (int i = 0; i < 3; i++) {
        from[i] = s->node[3 * a + i], to[i] = s->node[3 * b + i];
        square += (double)((to[i] - from[i]) * (to[i] - from[i]));
    }
    /* The clearance changes no faster than the point moves. */
    double sum = node_clearance(s, from) + node_clearance(s, to) - s->spacing * sqrt(square);
    if (sum > 0) return 1;
    for (int part = 1; part < PARTS; part++) {
        for (int i = 0; i < 3; i++) at[i] = (from[i] * (PARTS - part) + to[i] * part + PARTS / 2) / PARTS;
        if (!(node_clearance(s, at) > s->least)) return 0;
    }
    return 1;
}

/* Costs of the cheapest ways from some blocks, whose costs are given, to all, and the block before each; -1 at the
   beginning of a way, and where none leads. Returns 0 without memory. */
int32_t tgco_sweep(const Sweep *s) {
    int64_t blocks = s->blocks[0] * s->blocks[1] * s->blocks[2], count = 0, room = 1024 + s->seeds;
    Entry *heap = malloc(room * sizeof *heap);
    if (!heap) return 0;
    for (int64_t v = 0; v < blocks; v++) s->cost[v] = INFINITY, s->before[v] = -1;
    for (int64_t i = 0; i < s->seeds; i++) {
        s->cost[s->seed[i]] = s->seed_cost[i];
        push(heap, &count, s->seed_cost[i], (int32_t)s->seed[i]);
    }
    while (count > 0) {
        Entry top = pop(heap, &count);
        int64_t v = top.block, at[3] = {v / (s->blocks[1] * s->blocks[2]), v / s->blocks[2] % s->blocks[1], v % s->blocks[2]};
        if (top.cost > s->cost[v]) continue;
        if (count + 27 > room) {
            Entry *more = realloc(heap, 2 * room * sizeof *heap);
            if (!more) { free(heap); return 0; }
            heap = more, room *= 2;
        }
        for (int step = 0; step < 27; step++) {
            int64_t move[3] = {step / 9 - 1, step / 3 % 3 - 1, step % 3 - 1}, w = 0;
            int inside = step != 13;
            for (int i = 0; i < 3; i++) {
                inside &= at[i] + move[i] >= 0 && at[i] + move[i] < s->blocks[i];
                w = w * s->blocks[i] + at[i] + move[i];
            }
            if (!inside || !(s->weight[w] < INFINITY)) continue;
            double length = sqrt((double)(move[0] * move[0] + move[1] * move[1] + move[2] * move[2])) * s->step;
            double cost = top.cost + 0.5 * length * (s->weight[v] + s->weight[w]);
            if (!(cost < s->cost[w]) || !joined(s, v, w)) continue;
            s->cost[w] = cost, s->before[w] = (int32_t)v;
            push(heap, &count, cost, (int32_t)w);
        }
    }
    free(heap);
    return 1;
}

static double clearance_at(const String *s, const double *p) {
    int64_t index = 0;
    for (int i = 0; i < DIM; i++) {
        double place = rint((p[i] - s->origin[i]) * s->inverse);
        place = place > 0 ? place : 0;
        index = index * s->size[i] + (int64_t)(place < s->size[i] - 1 ? place : s->size[i] - 1);
    }
    return s->clearance[index];
}

/* Whether all clearances on the segment from a to b are above `least`: steps are as long as the clearance allows. */
static int sees(const String *s, const double *a, const double *b, double least) {
    double square = 0.0, spacing = 1.0 / s->inverse;
    for (int i = 0; i < DIM; i++) square += (b[i] - a[i]) * (b[i] - a[i]);
    double length = sqrt(square);
    for (double at = 0.0;;) {
        double p[DIM], share = length > 0 ? at / length : 0.0;
        for (int i = 0; i < DIM; i++) p[i] = a[i] + share * (b[i] - a[i]);
        double over = clearance_at(s, p) - least;
        if (!(over > 0)) return 0;
        if (at >= length) return 1;
        at += over - spacing > spacing ? over - spacing : spacing;
        at = at < length ? at : length;
    }
}

/* From each kept corner straight on to the last point that it sees, and all points before it; the kept ones are marked. */
int32_t tgco_shortcut(const String *s) {
    int64_t last = s->points - 1, i = 0;
    memset(s->corner, 0, s->points);
    s->corner[0] = 1;
    while (i < last) {
        int64_t far = i;
        while (far < last) {
            int ends = far + 1 == last || i == 0;
            if (!sees(s, s->path + i * DIM, s->path + (far + 1) * DIM, ends ? s->least : 0.0)) break;
            far++;
        }
        i = far > i ? far : i + 1;
        s->corner[i] = 1;
    }
    return 1;
}
