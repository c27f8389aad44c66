/* Squared distances of points and of segments from boxes; box.h has the numbers of a box. A vector V has LANES edges. */
#pragma once
#include <float.h>
#include <stdint.h>
#include "../../native/c/box.h"

/* Squared distances of points, and half their slopes where the points move along segments. */
static inline V square_at_share(const V *half, const V *begin, const V *along, V share, V *slope) {
    V square = SET(0.0), sum = SET(0.0);
    for (int i = 0; i < DIM; i++) {
        V away = beyond(begin[i] + share * along[i], half[i]);
        square += away * away;
        sum += away * along[i];
    }
    *slope = sum;
    return square;
}

static inline void spread(const double *box, V *to) {
    for (int i = 0; i < BOX_NUMBERS; i++) to[i] = SET(box[i]);
}

static double square_from_box(const double *box, const double *p) {
    V numbers[BOX_NUMBERS], point[DIM], local[DIM], none[DIM], slope;
    spread(box, numbers);
    for (int i = 0; i < DIM; i++) point[i] = SET(p[i]), none[i] = SET(0.0);
    seen_from(numbers, point, local);
    return square_at_share(BOX_HALF(numbers), local, none, SET(0.0), &slope)[0];
}

static inline V held(V share) {
    share = tgco_choose(share < SET(0.0), SET(0.0), share);
    return tgco_choose(share > SET(1.0), SET(1.0), share);
}

/* Smallest squared distances of the segments from `start` to `start + step`. */
static inline V square_of_segment(const V *box, const V *start, const V *step) {
    V begin[DIM], along[DIM], zero = SET(0.0), low = zero, high = SET(1.0), falls, rises, found;
    const V *half = BOX_HALF(box);
    seen_from(box, start, begin);
    along_sides(box, step, along);
    square_at_share(half, begin, along, low, &falls);
    square_at_share(half, begin, along, high, &rises);
    for (int i = 0; i < DIM; i++)
        for (int side = -1; side <= 1; side += 2) {
            V share = held((SET(side) * half[i] - begin[i]) / tgco_choose(along[i] == zero, SET(1.0), along[i]));
            square_at_share(half, begin, along, share, &found);
            I left = (found < zero) & (share > low), right = (found >= zero) & (share < high);
            low = tgco_choose(left, share, low), falls = tgco_choose(left, found, falls);
            high = tgco_choose(right, share, high), rises = tgco_choose(right, found, rises);
        }
    V change = rises - falls, part = held(-falls / tgco_choose(change > SET(DBL_MIN), change, SET(DBL_MIN)));
    return square_at_share(half, begin, along, tgco_choose(falls < zero, low + (high - low) * part, low), &found);
}

/* The lower and upper bounds (2, DIM) of what lies no farther than `margin` from a box; none of an absent one. */
static void bounds_of(const double *box, double margin, double *bounds) {
    const double *axes = box + DIM, *half = BOX_HALF(box), radius = BOX_RADIUS(box);
    for (int i = 0; i < DIM; i++) {
        double reach = radius + margin;
        for (int j = 0; j < DIM; j++) reach += fabs(axes[j * DIM + i]) * half[j];
        reach += 1e-9 * (fabs(reach) + fabs(box[i])); /* more than rounding */
        bounds[i] = radius < 0 ? INFINITY : box[i] - reach;
        bounds[DIM + i] = radius < 0 ? -INFINITY : box[i] + reach;
    }
}

/* Some segments from a to a + along, and the bounds of each and of all together. */
typedef struct {
    double (*a)[BLOCK], (*along)[BLOCK];
    double low[DIM][BLOCK], high[DIM][BLOCK], least[DIM], most[DIM];
} Segments;

static inline void find_bounds(double a[DIM][BLOCK], double along[DIM][BLOCK], Segments *g) {
    g->a = a, g->along = along;
    for (int i = 0; i < DIM; i++) {
        g->least[i] = INFINITY, g->most[i] = -INFINITY;
        for (int e = 0; e < BLOCK; e++) {
            double start = a[i][e], end = start + along[i][e], low = start < end ? start : end;
            double high = start < end ? end : start;
            g->low[i][e] = low, g->high[i][e] = high;
            g->least[i] = low < g->least[i] ? low : g->least[i];
            g->most[i] = high > g->most[i] ? high : g->most[i];
        }
    }
}

/* Lowers `gap`, the distances of segments from the surface, and `open`, a measure with the same sign. What lies outside
   of the box's bounds doesn't count: segments that don't reach them are left out, as well as those that another box
   blocks. */
static inline void measure_box(const double *box, const double *bounds, const Segments *g, double *gap, double *open) {
    for (int i = 0; i < DIM; i++) if (g->least[i] > bounds[DIM + i] || g->most[i] < bounds[i]) return;
    int64_t near[BLOCK];
    int place[BLOCK], count = 0;
    for (int e = 0; e < BLOCK; e++) {
        near[e] = open[e] > 0.0;
        for (int i = 0; i < DIM; i++) near[e] &= (g->low[i][e] <= bounds[DIM + i]) & (g->high[i][e] >= bounds[i]);
    }
    for (int e = 0; e < BLOCK; e++) place[count] = e, count += near[e] != 0;
    if (count == 0) return;
    V numbers[BOX_NUMBERS];
    double radius = BOX_RADIUS(box);
    spread(box, numbers);
    for (int first = 0; first < count; first += LANES) {
        V start[DIM], step[DIM];
        for (int l = 0; l < LANES; l++) {
            int e = place[first + l < count ? first + l : first];
            for (int i = 0; i < DIM; i++) start[i][l] = g->a[i][e], step[i][l] = g->along[i][e];
        }
        V away = square_of_segment(numbers, start, step);
        for (int l = 0; l < LANES && first + l < count; l++) {
            int e = place[first + l];
            double left = sqrt(away[l]) - radius, more = away[l] - radius * radius;
            gap[e] = left < gap[e] ? left : gap[e];
            open[e] = more < open[e] ? more : open[e];
        }
    }
}
