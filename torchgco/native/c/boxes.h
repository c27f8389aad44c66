/* Boxes that may be turned, as obstacles: the rows of a knot, for problems with boxes (obstacles/boxes.py). */
#pragma once
#include "box.h"
#include "penalty.h"

/* First come the bounds of all boxes along the first axis of space, middle and half length, then along the second, ...:
   most boxes are too far away for more. Then the factor of each box, which turns a distance into a squared length, and
   at last the numbers of each box (box.h). */

#define TOGETHER 8 /* boxes that are looked at together: most groups are far away and add nothing */

/* Whether a box of this radius counts at knot k: none does where time has stopped. */
static inline I is_here(const Constraint *con, const Rows *rows, V radius, int64_t k) {
    I here = radius >= SET(0.0);
    return con->stops.data ? here & (SET(k) <= rows->stops[0]) : here;
}

/* Row j at knot k, and its derivatives by position (DIM) unless `slopes` is NULL; an absent box is c = -1. */
static inline V solid(const Constraint *con, const Rows *rows, int64_t j, int64_t k, IN x, OUT slopes) {
    IN factors = rows->bound + con->rows * 2 * DIM; IN box = factors + con->rows + j * BOX_NUMBERS;
    IN axes = box + DIM; IN half = BOX_HALF(box); const V radius = BOX_RADIUS(box);
    V factor = factors[j], zero = SET(0.0), local[DIM], away[DIM], square = zero, deepest = zero;
    I nearest[DIM];
    seen_from(box, x + POSITION, local);
    for (int i = 0; i < DIM; i++) {
        V depth = tgco_fabs(local[i]) - half[i];
        away[i] = beyond(local[i], half[i]);
        ADD(square, away[i], away[i]);
        nearest[i] = i == 0 ? zero == zero : depth > deepest; /* the first of equals */
        deepest = tgco_choose(nearest[i], depth, deepest);
        for (int a = 0; a < i; a++) nearest[a] &= NOT(nearest[i]);
    }
    I outside = square > zero, here = is_here(con, rows, radius, k);
    V distance = tgco_sqrt(tgco_choose(outside, square, SET(1.0)));
    V c = factor * (radius - tgco_choose(outside, distance, deepest));
    if (slopes) {
        for (int a = 0; a < DIM; a++) slopes[a] = zero;
        for (int i = 0; i < DIM; i++) {
            V inside = tgco_choose(local[i] < zero, -tgco_truth(nearest[i]), tgco_truth(nearest[i]));
            V side = -factor * tgco_choose(outside, away[i] / distance, inside);
            for (int a = 0; a < DIM; a++) ADD(slopes[a], axes[i * DIM + a], side);
        }
        for (int a = 0; a < DIM; a++) slopes[a] = tgco_if(here, slopes[a]);
    }
    return tgco_choose(here, c, SET(ABSENT));
}

/* The lanes in which the knot lies within the bounds of box j. */
static inline I is_near(const Constraint *con, const Rows *rows, int64_t j, IN x) {
    I far = SET(0.0) != SET(0.0);
    for (int a = 0; a < DIM; a++) {
        IN bounds = rows->bound + (a * con->rows + j) * 2;
        far |= tgco_fabs(x[POSITION + a] - bounds[0]) > bounds[1];
    }
    return NOT(far);
}

/* Whether one of the boxes first, ..., last - 1 may add anything in a lane: the knot is near it, or it has a multiplier
   where some are `pushed`. Most groups of boxes are answered by one test. */
static inline int some_matter(
    const Constraint *con, const Rows *rows, IN lam, int pushed, int64_t first, int64_t last, IN x) {
    I matters = SET(0.0) != SET(0.0);
    for (int64_t j = first; j < last; j++) {
        matters |= is_near(con, rows, j, x);
        if (pushed) matters |= lam[j] != SET(0.0);
    }
    return any(matters);
}

/* The same of one box. */
static inline int may_matter(const Constraint *con, const Rows *rows, IN lam, int pushed, int64_t j, IN x) {
    return some_matter(con, rows, lam, pushed, j, j + 1, x);
}

TGCO_APART V boxes_terms(
    const Lanes *s, const Constraint *con, const Rows *rows, int64_t k, IN x, V total, OUT g, OUT H) {
    IN lam = rows->lam + con->place[k] * con->rows;
    int pushed = any(rows->pushed[con->place[k]]);
    for (int64_t first = 0, last; first < con->rows; first = last) {
        last = first + TOGETHER < con->rows ? first + TOGETHER : con->rows;
        if (!some_matter(con, rows, lam, pushed, first, last, x)) continue;
        for (int64_t j = first; j < last; j++) {
            if (!may_matter(con, rows, lam, pushed, j, x)) continue;
            V slopes[DIM], c = solid(con, rows, j, k, x, g ? slopes : NULL);
            if (!any(NOT(c <= SET(0.0)) | (lam[j] != SET(0.0)))) continue;
            if (g) add_slopes(s, c, lam[j], slopes, g, H);
            else total += worth(s, 0, c, lam[j]);
        }
    }
    return total;
}
