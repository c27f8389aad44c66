/* The rows of bounds and spheres at one knot. */
#pragma once
#include "model.h"

#define BLOCK 32 /* spheres evaluated together: most blocks are far away and add nothing */

/* Row j of bounds at knot k. */
static inline V bound(const Constraint *con, const Rows *rows, int64_t j, int64_t k, IN x, IN u) {
    int v = con->variable[j];
    return SET(con->sign[j]) * ((v < NX ? x[v] : u[v - NX]) - at(rows->bound, &con->bound, con->place[k])[j]);
}

#if DIM > 0
/* The squared radius of sphere j at knot k; ABSENT without one, or where time has stopped. */
static inline V square_at(const Constraint *con, const Rows *rows, int64_t j, int64_t k) {
    if (!con->stops.data) return rows->squares[j];
    return tgco_choose(SET(k) > rows->stops[0], SET(ABSENT), rows->squares[j]);
}

/* Row j of spheres at knot k, and the vector from the centre to the position (DIM); an absent sphere is c = -1. */
static inline V sphere(const Constraint *con, const Rows *rows, int64_t j, int64_t k, IN x, OUT away) {
    IN o = at(rows->bound, &con->bound, con->place[k]) + j * DIM;
    V square = SET(0.0), limit = square_at(con, rows, j, k);
    I here = limit >= SET(0.0);
    for (int a = 0; a < DIM; a++) {
        away[a] = x[POSITION + a] - o[a];
        if (con->velocities.data) SUBTRACT(away[a], SET(k * con->dt), rows->velocities[j * DIM + a]);
        away[a] = tgco_if(here, away[a]);
        ADD(square, away[a], away[a]);
    }
    return limit - square;
}

/* Rows c of the spheres first, ..., last - 1 at knot k, and whether they add anything in any lane. */
static inline int spheres(
    const Constraint *con, const Rows *rows, int64_t first, int64_t last, int64_t k, IN x, OUT c) {
    I matters = rows->pushed[con->place[k]];
    for (int64_t j = first; j < last; j++) {
        V away[DIM];
        c[j - first] = sphere(con, rows, j, k, x, away);
        matters |= NOT(c[j - first] <= SET(0.0)); /* NaN matters */
    }
    return any(matters);
}
#endif
