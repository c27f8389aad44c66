/* Distances from boxes that may be turned and are grown by a radius, for numbers of type V: double in the search for
   paths, vectors of lanes in the solver. obstacles/box_geometry.py does the same operations in the same order.

   The numbers of a box: its centre (DIM), the directions of its sides (DIM, DIM), half their lengths (DIM), and the
   radius, which is negative where there is no box. */
#pragma once
#include "lanes.h"

#define BOX_NUMBERS (DIM * DIM + 2 * DIM + 1)
#define BOX_HALF(box) ((box) + DIM + DIM * DIM)
#define BOX_RADIUS(box) ((box)[BOX_NUMBERS - 1])

/* Coordinates of a vector along the sides. */
static inline void along_sides(IN box, IN v, OUT local) {
    IN axes = box + DIM;
    for (int i = 0; i < DIM; i++) {
        local[i] = SET(0.0);
        for (int j = 0; j < DIM; j++) local[i] += axes[i * DIM + j] * v[j];
    }
}

/* Coordinates of a point along the sides, from the centre. */
static inline void seen_from(IN box, IN p, OUT local) {
    V away[DIM];
    for (int i = 0; i < DIM; i++) away[i] = p[i] - box[i];
    along_sides(box, away, local);
}

/* What x has beyond -half or half, with its sign; 0 between them. */
static inline V beyond(V x, V half) {
    V held = tgco_choose(x > -half, x, -half);
    return x - tgco_choose(held < half, held, half);
}
