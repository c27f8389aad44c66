/* Cheapest paths among the cells of a map, by A* over the 26 neighbours. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#define COST float
#include "../../../native/c/heap.h"

static inline float octile(const int64_t *a, const int64_t *b) {
    float d[3];
    for (int i = 0; i < 3; i++) d[i] = (float)llabs(a[i] - b[i]);
    float high = fmaxf(d[0], fmaxf(d[1], d[2])), low = fminf(d[0], fminf(d[1], d[2])), mid = d[0] + d[1] + d[2] - high - low;
    return high + 0.41421356f * mid + 0.31783725f * low; /* (sqrt 2 - 1), (sqrt 3 - sqrt 2) */
}

/* The cheapest path from a cell to within `near` cells of a goal, over every `stride`-th cell of the map along each axis;
 * writes its cells from the goal's end to the start.
 *
 * distance (cells): from obstacles, m. A cell is passable from `radius` on; around the start, within `leave` cells, from
 * any distance above 0; so is the one midway to a neighbour. A step costs its length times a price: 1, plus `shy` at
 * `radius`, falling to 0 at radius + band, plus `unseen` where the state is 0, up to
 * `nearby` cells from the start, four times as much within the band, as walls go on more often than they have holes, plus the cell's own `price`. Estimates of
 * what is left count `greed` times: paths cost at most so much more than the cheapest. Scratch for each cell: sum, from,
 * seen; heap of `room` entries. Returns the number of cells of the path, negative where it ends at the cell nearest to
 * the goal, as none leads there; 0 after `limit` cells. Then `left` holds the number of entries in the heap and the cell
 * nearest to the goal, and a call with the same scratch, round, start and goal goes on. A search begins with left 0. */
int64_t tgco_search(
    const int64_t *shape, const float *distance, const uint8_t *state, const float *price, double radius, double band,
    double shy, double unseen, double nearby, double greed,
    int64_t leave, int64_t stride, const int64_t *start, const int64_t *goal,
    double near, int64_t round, float *sum, int32_t *from, int32_t *seen, int64_t room, uint8_t *heap_bytes,
    int32_t *path, int64_t limit, int64_t *left, int64_t *expanded) {
    Entry *heap = (Entry *)heap_bytes;
    int64_t ny = shape[1], nz = shape[2], count = 0, best = -1, steps = 0, s = stride;
    int32_t open = (int32_t)(2 * round), closed = open + 1, found = -1;
    float best_h = INFINITY, r = (float)radius, g = (float)greed;
    int64_t begin[3] = {start[0] / s * s, start[1] / s * s, start[2] / s * s};
    int32_t first = (int32_t)((begin[0] * ny + begin[1]) * nz + begin[2]);
    if (left[0] > 0) {
        int64_t c[3] = {left[1] / (ny * nz), left[1] / nz % ny, left[1] % nz};
        count = left[0], best = left[1], best_h = octile(c, goal);
    } else {
        sum[first] = 0.0f, from[first] = -1, seen[first] = open;
        push(heap, &count, g * octile(begin, goal), first);
    }
    while (count > 0) {
        if (steps >= limit) {
            left[0] = count, left[1] = best, *expanded = steps;
            return 0;
        }
        int32_t at = pop(heap, &count).item;
        if (seen[at] == closed) continue;
        seen[at] = closed, steps++;
        int64_t c[3] = {at / (ny * nz), at / nz % ny, at % nz};
        float h = octile(c, goal);
        if (h < best_h) best_h = h, best = at;
        if (h <= (float)near) {
            found = at;
            break;
        }
        for (int64_t dx = -1; dx <= 1; dx++)
            for (int64_t dy = -1; dy <= 1; dy++)
                for (int64_t dz = -1; dz <= 1; dz++) {
                    int64_t n[3] = {c[0] + s * dx, c[1] + s * dy, c[2] + s * dz};
                    if (n[0] < 0 || n[1] < 0 || n[2] < 0 || n[0] >= shape[0] || n[1] >= ny || n[2] >= nz) continue;
                    int32_t to = (int32_t)((n[0] * ny + n[1]) * nz + n[2]);
                    if (seen[to] == closed) continue;
                    int64_t halfway = at + (((s / 2) * dx * ny) + (s / 2) * dy) * nz + (s / 2) * dz;
                    float d = distance[to], least = s > 1 && distance[halfway] < d ? distance[halfway] : d;
                    if (least < r && !(least > 0.0f && octile(n, begin) <= (float)leave)) continue;
                    int64_t axes = dx * dx + dy * dy + dz * dz;
                    float length = (float)s * (axes == 1 ? 1.0f : axes == 2 ? 1.41421356f : 1.73205081f);
                    float close = 1.0f - (d - r) / (float)band, each = 1.0f + price[to];
                    each += (close > 0.0f ? (float)shy * close : 0.0f);
                    if (state[to] == 0 && octile(n, begin) <= (float)nearby) each += (float)unseen * (close > 0.0f ? 4.0f : 1.0f);
                    float cost = sum[at] + length * each;
                    if (seen[to] == open && sum[to] <= cost) continue;
                    if (count >= room) continue; /* the heap is full: this neighbour is left out */
                    seen[to] = open, sum[to] = cost, from[to] = at;
                    push(heap, &count, cost + g * octile(n, goal), to);
                }
    }
    *expanded = steps, left[0] = 0;
    int64_t length = 0;
    for (int32_t at = found >= 0 ? found : (int32_t)best; at >= 0; at = from[at]) path[length++] = at;
    return found >= 0 ? length : -length;
}
