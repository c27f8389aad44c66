/* What the search among a map's cells reads and writes. Python's own declaration follows from this one
   (roadmap/native_maps.py), which also gives the numbers of compile_flags.txt. */
#pragma once
#include <stdint.h>

typedef struct {
    const float *values; /* distances at the map's nodes */
    const int64_t *shape, *low, *size; /* (3): the map's nodes, those before its first one, all */
    double spacing, core, limit;
    int64_t smooth;
} Map;

typedef struct {
    const Map *map;
    const int64_t *cells; /* (3): of blocks, along each axis */
    int64_t side, merged; /* nodes along the side of a cell; whether cells become one block where all are free */
    double least; /* clearance from which a block is free, m */
    const float *tie; /* (side ** DIM): what nodes are less clear than others of the same clearance, m */
    int32_t *block; /* (cells): the block of each, -1 where there is none */
    int32_t *first, *node; /* (blocks, 3): its first cell, its clearest node */
    uint8_t *layers; /* (blocks): cells along its side */
    float *clearance; /* (blocks) */
    int64_t blocks;
} Graph;

typedef struct {
    const Graph *graph;
    const double *weight; /* (blocks): price per metre, infinite where blocked */
    const int64_t *seed; /* (seeds): blocks at which ways begin */
    const double *seed_cost;
    int64_t seeds, end; /* the block at which the cheapest way to the goal ends */
    const double *ahead; /* (blocks): of ways to the goal, no more than they cost; or NULL */
    const int32_t *onward; /* (blocks): -1 where ways to the goal end */
    double deepest; /* the clearance that joins two blocks, m */
    double *cost; /* (blocks) */
    int32_t *before; /* (blocks) */
} Sweep;

typedef struct {
    const Map *map;
    const double *origin, *path; /* (DIM), (points, DIM) */
    int64_t points;
    double least, reach; /* the clearance of segments at either end, and the longest segment, m */
    int64_t parts, rounds; /* steps of a path that is drawn taut, and how often that is done */
    double little; /* gain in length, as a share, below which there is no further round */
    double *taut; /* (room, DIM) */
    int64_t room;
} String;
