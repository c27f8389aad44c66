/* Obstacles as the balls of a body meet them (obstacles/body.py): the rows of each ball are those of its center, whose
   place is a function of the state that is traced. */
#pragma once
#include "rows.h"

/* The obstacles of one ball: a share of the numbers and rows of all. x holds its center where kernels read a position. */
typedef struct { Constraint con; Rows rows; V x[POSITION + DIM]; } Ball;

/* The centers of all balls at knot k. */
static inline void ball_centers(const Lanes *s, int64_t i, int64_t k, IN x, OUT centers) {
    const Constraint *con = s->of->constraint + i;
    model_rows((int)i, x, NONE, at(s->rows[i].lift, &con->lift, con->place[k]), con->shared, centers);
}

/* Ball b of `con` at knot k, with v (DIM) in the place of its position: its center, or how that changes. */
static inline void ball_at(const Constraint *con, const Rows *rows, int b, int64_t k, IN v, Ball *ball) {
    int64_t each = con->rows / con->balls;
    ball->con = *con; ball->rows = *rows;
    ball->con.rows = (int32_t)each; ball->con.kind = con->kind_of_balls;
    ball->rows.lam += con->place[k] * (con->rows - each) + b * each;
    ball->rows.bound += b * (con->bound.size / con->balls);
    ball->rows.squares += b * (con->squares.size / con->balls);
    ball->rows.velocities += b * (con->velocities.size / con->balls);
    for (int a = 0; a < DIM; a++) ball->x[POSITION + a] = v[a];
}

/* Whether a ball adds nothing, in any lane, with gradient g and upper triangle H (DIM, S) by its position. */
static inline int adds_nothing(IN g, IN H) {
    I adds = SET(0.0) != SET(0.0);
    for (int a = 0; a < DIM; a++) {
        adds |= g[a] != SET(0.0);
        for (int b = a; b < DIM; b++) adds |= H[a * S + POSITION + b] != SET(0.0);
    }
    return !any(adds);
}

/* Adds e' h e to H (S, S), with h (DIM, S) the upper triangle by a ball's position, and its slopes e (DIM, count). */
static inline void pull_square(int count, const int *columns, IN e, IN h, OUT H) {
    for (int p = 0; p < count; p++) {
        V along[DIM];
        for (int b = 0; b < DIM; b++) {
            along[b] = SET(0.0);
            for (int a = 0; a < DIM; a++)
                ADD(along[b], e[a * count + p], h[(a < b ? a : b) * S + POSITION + (a < b ? b : a)]);
        }
        for (int q = p; q < count; q++)
            for (int b = 0; b < DIM; b++) ADD(H[columns[p] * S + columns[q]], along[b], e[b * count + q]);
    }
}

/* Adds e' g to the gradient by z. */
static inline void pull_slope(int count, const int *columns, IN e, IN g, OUT by) {
    for (int p = 0; p < count; p++)
        for (int a = 0; a < DIM; a++) ADD(by[columns[p]], e[a * count + p], g[a]);
}
