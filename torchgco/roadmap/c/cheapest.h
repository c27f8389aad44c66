/* What the search reads and writes: B problems among M spheres, graphs of V points with K edges each, and paths of P
   corners. Python's own declaration follows from this one (roadmap/cheapest.py), which also gives the numbers of
   compile_flags.txt. */
#pragma once
#include <stdint.h>

typedef struct {
    int64_t spheres, spread, candidates, points, edges, neighbours, hubs, corners, directions, shells, midway;
    double margin, least, clear, factor, tie;
    const double *centers, *distances; /* (B, M, DIM), (B, M): radii, negative where absent */
    const double *start, *goal; /* (B, DIM) */
    const double *cube, *rays, *shell; /* (spread, DIM) in the unit cube; (B, directions, DIM); (shells) */
    double *nodes; /* (B, V, DIM) */
    int32_t *ends; /* (B, V, K): where edges lead; blocked ones are -1 and come last */
    double *lengths; /* (B, V, K), infinite for blocked ones */
    double *price; /* (B, V) */
    double *path; /* (B, P, DIM) */
    double *string; /* (B, 2 P - 1, DIM) */
    const double *cost; /* (B, 2 P - 1) */
    uint8_t *arrives; /* (B) */
    const double *reach; /* corners (B, 2, DIM) of the region that holds start, goal and obstacles */
    /* Read only where there are boxes. */
    int64_t boxes, extras;
    const double *box; /* their numbers (B, boxes, BOX_NUMBERS) */
    const double *beside; /* points around them (B, extras, DIM) */
    const uint8_t *exists; /* (B, extras) */
    const double *largest; /* the largest size (B) */
} Arguments;
