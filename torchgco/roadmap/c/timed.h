/* What the search in space and time reads and writes. Python's own declaration follows from this one
   (roadmap/timed.py), which also gives the numbers of compile_flags.txt. */
#pragma once
#include <stdint.h>

typedef struct {
    const int64_t *counts, *least, *moves; /* (3): cells, the smallest move and how many moves, along each axis */
    int64_t layers, parts; /* moves one after another; of each, so many parts at whose ends it is looked at */
    int64_t start, first; /* the cell at layer 0, and the move before it */
    double spacing, margin; /* of cells; the clearance that ways keep, m */
    double dearer; /* share by which ways may cost more than the cheapest */
    const float *clearance; /* (layers * parts + 1, cells), m */
    const float *cell_cost; /* (layers + 1, cells): of being there; FAR or more where nobody may be */
    const float *move_cost, *last_cost, *change; /* (moves), (moves): of the last one; (3): of one unit more or less */
    int64_t most, tries; /* classes, and ways that are looked at for them */
    int32_t *way; /* (most, layers + 1): the cells of each way */
    float *cost; /* (most) */
    float *through; /* (layers + 1, cells): of the cheapest way through each; or NULL */
    int64_t found, states; /* classes; states that were reached */
} Timed;
