/* What the search in space and time reads and writes. Python's own declaration follows from this one
   (roadmap/timed.py), which also gives the numbers of compile_flags.txt. */
#pragma once
#include <stdint.h>

typedef struct {
    const int64_t *counts, *least, *moves; /* (3): cells, the smallest move and how many moves, along each axis */
    int64_t layers, parts; /* moves one after another; of each, so many parts at whose ends it is looked at */
    int64_t earliest; /* the first layer at which ways may end */
    int64_t start, first; /* the cell at layer 0, and the move before it */
    double spacing, margin; /* of cells; the clearance that ways keep, m */
    double dearer; /* share by which ways may cost more than the cheapest */
    int64_t solids, resting; /* rounded boxes, of which the first ones rest */
    const float *center; /* (layers * parts + 1, solids, DIM): where they are, from the first cell, m */
    const float *half, *axes; /* (solids, DIM), (solids, DIM, DIM): m; rows of axes are sides */
    const float *radius; /* as center, without DIM: by which they are rounded, m */
    float *clearance; /* (layers * parts + 1, cells), m: of all else; then of the solids, too */
    int64_t others; /* balls that may be met, at a price */
    const float *other, *reach, *price; /* (layers * parts + 1, others, DIM), (others), (others): as center; m; of being
                                           all the way inside for a layer */
    const float *cell_cost; /* (layers, cells): of being there until the next layer; FAR or more: nobody may be there */
    const float *end_cost; /* (layers + 1 - earliest, cells): of ending there; FAR or more: nobody may */
    const float *move_cost, *last_cost, *change; /* (moves), (moves): of the last one; (3): of one unit more or less */
    int64_t most, tries; /* classes, and ways that are looked at for them */
    int32_t *way, *end; /* (most, layers + 1), (most): the cells of each way, and the layer at which it ends */
    float *cost; /* (most) */
    float *through; /* (layers + 1, cells): of the cheapest way through each; or NULL */
    int64_t found; /* classes */
} Timed;
