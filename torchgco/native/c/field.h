/* Maps as obstacles: the row of a knot, from a distance field (maps/field.py). maps/lookup.py does the same, and explains
   it. Numbers of type V are per problem, and so is the map that a lane reads. */
#pragma once
#include "penalty.h"

/* The numbers of a problem: its first node (DIM), 1 / h, h^2, R^2, the factor a, the core, what counts as distance 0, and
   the distance of a node from which no point near it is in contact. a is negative where the map is empty. */
enum { INVERSE = DIM, STEP_SQUARE, RADIUS_SQUARE, SLOPE_SCALE, CORE, LIMIT, REACH, FIELD_NUMBERS };

#define TAPS 3

/* The nodes around x along one axis: places in the lattice, weights and their first two derivatives, and what the axis
   adds to G in squared steps. */
typedef struct {
    int count;
    V place[TAPS], weight[TAPS], slope[TAPS], bend[TAPS], more, more_slope, more_bend;
} Axis;

static inline V within_lattice(V place, int64_t size) {
    V low = tgco_choose(place > SET(0.0), place, SET(0.0)), last = SET((double)(size - 1)); /* NaN: the first */
    return tgco_choose(low < last, low, last);
}

static inline V lattice_place(const Rows *rows, IN x, int axis) {
    return (x[POSITION + axis] - rows->bound[axis]) * rows->bound[INVERSE];
}

static inline int64_t lattice_size(const Constraint *con, int axis) {
    return axis == 0 ? con->map_x : axis == 1 ? con->map_y : con->map_z;
}

static inline Axis axis_at(const Constraint *con, const Rows *rows, IN x, int axis) {
    V u = lattice_place(rows, x, axis), one = SET(1.0), zero = SET(0.0), half = SET(0.5), two = SET(2.0);
    V base = tgco_floor(con->smooth ? u + half : u), f = u - base;
    Axis t;
    t.count = con->smooth ? 3 : 2;
    if (con->smooth) {
        V low = half - f, high = half + f;
        t.weight[0] = half * low * low; t.weight[1] = SET(0.75) - f * f; t.weight[2] = half * high * high;
        t.slope[0] = -low; t.slope[1] = -two * f; t.slope[2] = high;
        t.bend[0] = one; t.bend[1] = -two; t.bend[2] = one;
        t.more = SET(-0.25); t.more_slope = zero; t.more_bend = zero;
    } else {
        t.weight[0] = one - f; t.weight[1] = f;
        t.slope[0] = -one; t.slope[1] = one;
        t.bend[0] = t.bend[1] = zero;
        t.more = -f * (one - f); t.more_slope = two * f - one; t.more_bend = two;
    }
    for (int i = 0; i < t.count; i++) {
        V place = base + SET((double)(con->smooth ? i - 1 : i)), held = within_lattice(place, lattice_size(con, axis));
        V beyond = (place - held) * (place - held);
        ADD(t.more, t.weight[i], beyond);
        ADD(t.more_slope, t.slope[i], beyond);
        ADD(t.more_bend, t.bend[i], beyond);
        t.place[i] = held;
    }
    return t;
}

/* The distance at a node of each lane's map. */
static inline V node(const Constraint *con, const Rows *rows, const V *const *at) {
    V distance;
    for (int l = 0; l < LANES; l++) {
        int64_t index = 0;
        for (int a = 0; a < DIM; a++) index = index * lattice_size(con, a) + (int64_t)LANE(at[a][0], l);
        LANE(distance, l) = rows->map[l][index];
    }
    return distance;
}

/* Sums over the nodes around a point, G in the end: value, slopes by the axes, and second derivatives (DIM, DIM), upper
   triangle. */
typedef struct { V value, slope[DIM], bend[DIM * DIM]; } Sums;

static inline Sums sum_of_node(const Constraint *con, const Rows *rows, const Axis *axes, const V **at, int order) {
    V distance = node(con, rows, at), core = rows->bound[CORE];
    V tangent = core * (SET(2.0) * distance - core);
    Sums sums;
    sums.value = tgco_choose(distance < core, tangent, distance * distance);
    return sums;
}

/* NAME: sums over the nodes of AXIS and all later ones, which INNER sums over; `at` holds the places along the axes
   before. `order` is that of the derivatives asked for. */
#define SUM_OVER(AXIS, NAME, INNER) \
    static inline Sums NAME(const Constraint *con, const Rows *rows, const Axis *axes, const V **at, int order) { \
        const Axis *t = axes + (AXIS); \
        Sums sums; \
        memset(&sums, 0, sizeof sums); \
        for (int i = 0; i < t->count; i++) { \
            at[AXIS] = t->place + i; \
            Sums inner = INNER(con, rows, axes, at, order); \
            ADD(sums.value, t->weight[i], inner.value); \
            if (order < 1) continue; \
            ADD(sums.slope[AXIS], t->slope[i], inner.value); \
            for (int a = (AXIS) + 1; a < DIM; a++) ADD(sums.slope[a], t->weight[i], inner.slope[a]); \
            if (order < 2) continue; \
            ADD(sums.bend[(AXIS) * DIM + (AXIS)], t->bend[i], inner.value); \
            for (int a = (AXIS) + 1; a < DIM; a++) { \
                ADD(sums.bend[(AXIS) * DIM + a], t->slope[i], inner.slope[a]); \
                for (int b = a; b < DIM; b++) ADD(sums.bend[a * DIM + b], t->weight[i], inner.bend[a * DIM + b]); \
            } \
        } \
        return sums; \
    }
SUM_OVER(DIM - 1, sum_of_line, sum_of_node)
SUM_OVER(DIM - 2, sum_of_plane, sum_of_line)
#if DIM == 3
SUM_OVER(0, sum_of_all, sum_of_plane)
#else
#define sum_of_all sum_of_plane
#endif

/* Whether the map counts at knot k: not where it is empty, or time has stopped. */
static inline I map_counts(const Constraint *con, const Rows *rows, int64_t k) {
    I here = rows->bound[SLOPE_SCALE] >= SET(0.0);
    return con->stops.data ? here & (SET(k) <= rows->stops[0]) : here;
}

/* The row at knot k, with its derivatives by position, (DIM) and (DIM, DIM), where they aren't NULL; -1 where the map
   doesn't count. */
TGCO_APART V field_row(
    const Constraint *con, const Rows *rows, int64_t k, IN x, OUT slopes, OUT curvature) {
    Axis axes[DIM];
    const V *at[DIM];
    IN number = rows->bound;
    for (int a = 0; a < DIM; a++) axes[a] = axis_at(con, rows, x, a);
    Sums sums = sum_of_all(con, rows, axes, at, curvature ? 2 : slopes ? 1 : 0);
    V factor = number[SLOPE_SCALE], inverse = number[INVERSE], square = number[STEP_SQUARE];
    I here = map_counts(con, rows, k);
    for (int a = 0; a < DIM; a++) {
        ADD(sums.value, square, axes[a].more);
        if (!slopes) continue;
        slopes[a] = tgco_if(here, -factor * (inverse * sums.slope[a] + square * inverse * axes[a].more_slope));
        for (int b = a; curvature && b < DIM; b++) {
            V bend = inverse * inverse * sums.bend[a * DIM + b];
            if (a == b) bend += axes[a].more_bend;
            curvature[a * DIM + b] = tgco_if(here, -factor * bend);
        }
    }
    return tgco_choose(here, factor * (number[RADIUS_SQUARE] - sums.value), SET(ABSENT));
}

/* Whether no lane is in contact: as the distance at the nearest node shows, which is all that is read. */
static inline int is_far_from_map(const Constraint *con, const Rows *rows, IN x) {
    V place[DIM];
    const V *at[DIM];
    for (int a = 0; a < DIM; a++) {
        V u = lattice_place(rows, x, a);
        place[a] = within_lattice(tgco_floor(con->smooth ? u + SET(0.5) : u), lattice_size(con, a));
        at[a] = place + a;
        if (any(u != u)) return 0;
    }
    return !any(NOT(node(con, rows, at) > rows->bound[REACH]));
}

/* The distance whose square, or the tangent to it nearer than the core, is `square`. */
static inline V length_of(V square, V core) {
    V least = core * core;
    return tgco_choose(square < least, (square + least) / (SET(2.0) * core), tgco_sqrt(square));
}

/* How deep beneath the full surface a row c > 0 is, m. */
static inline V depth_of(const Rows *rows, V c) {
    IN number = rows->bound;
    return number[LIMIT] - length_of(number[RADIUS_SQUARE] - c / number[SLOPE_SCALE], number[CORE]);
}

TGCO_APART V field_terms(
    const Lanes *s, const Constraint *con, const Rows *rows, int64_t k, IN x, V total, OUT g, OUT H) {
    V lam = rows->lam[con->place[k]], slopes[DIM];
    if (!any(lam != SET(0.0)) && is_far_from_map(con, rows, x)) return total;
    V c = field_row(con, rows, k, x, g ? slopes : NULL, NONE);
    if (!g) return total + worth(s, 0, c, lam);
    add_slopes(s, c, lam, slopes, g, H);
    return total;
}
