/* Problems side by side, one per lane of the vectors V; no operation mixes lanes.

   The library of a form of problems is linked from units. Its own one, the model (model.c), knows all sizes; those that
   take them as constants (passes.c, riccati.c) are compiled for each NX and NU; all others read them from the model, and
   differ in DIM, REAL and LANES alone. A unit is some .c files with all that these include. Two files that are included
   are Python's text (native/codegen/source.py): constants.h, and code.h with the functions of a model, its cost and its
   traced constraints. `editor` has one of each, and compile_flags.txt the sizes, with which every file compiles alone. */
#pragma once
#include "functions.h"
#include "structures.h"

#define S (NX + NU)
#define NZ (NX + 1)

/* A constraint's multipliers and numbers. */
typedef struct {
    Numbers lam, bound, squares, velocities, radii, stops, lift;
    Numbers widest; /* of a body among spheres: the largest inflated radius of each, ABSENT without one */
    Places near; /* room for the numbers of those that a ball may touch */
    Truths pushed; /* (knots): whether any multiplier of the knot isn't zero */
    const float *map[LANES]; /* of a FIELD: each lane's map */
} Rows;

/* The working data of a group of lanes. */
typedef struct {
    const Problem *of;
    Numbers X, U, Xn, Un, G, parameters, cost_data[COST_ARRAYS], center, radius;
    Rows *rows;
    V weight, mu, inverse_mu, mu_r, merit, cost, inner, made, alpha, used;
    V floor; /* the constraints' terms add no less than minus this to L_M: lam^2 / (2 mu) for each row */
    int64_t element[LANES], rung[LANES]; /* at which the next line search begins */
    int of_barrier; /* whose memory has room for trials and multipliers */
    Numbers memory;
} Lanes;

/* Bits of the kinds of rows that there may be; where a text serves one problem, of its own alone. */
#ifndef KINDS
#define KINDS (-1)
#endif
static inline int is_kind(const Constraint *con, int kind) { return (KINDS >> kind & 1) && con->kind == kind; }
static inline int is_solid(const Constraint *con) {
    return is_kind(con, SPHERES) || is_kind(con, BOXES) || is_kind(con, FIELD);
}

static inline int any(I where) { return tgco_any(where); }
static inline I tgco_finite(V a) { return (a - a) == SET(0.0); }

static inline ConstNumbers at(ConstNumbers array, const Array *shape, int64_t k) {
    return array + (shape->knot ? k * shape->size : 0);
}

/* Array i of the cost at knot k. */
static inline ConstNumbers cost_at(const Lanes *s, int i, int64_t k) {
    return at(s->cost_data[i], s->of->cost_data + i, k);
}

/* The model's own numbers at stage k. */
static inline ConstNumbers model_at(const Lanes *s, int64_t k) { return at(s->parameters, &s->of->parameters, k); }
