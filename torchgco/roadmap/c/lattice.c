/* The cheapest ways over blocks of a lattice, and paths drawn taut through it (roadmap/lattice.py, roadmap/mapped.py).
   Two dimensions are three, with one layer. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "lattice.h"

#define COST double
#include "../../native/c/heap.h"

/* Clearances: roadmap/clearances.py has the same in NumPy. --------------------------------------------------------- */

static inline int64_t held_in(int64_t place, int64_t count) { return place < 0 ? 0 : place < count ? place : count - 1; }

/* What the constraint's lookup gives at a node of the map: squares weighted by B-splines, less the weights' variance. */
static double interpolated(const Map *m, const int64_t *held) {
    static const double weight[3] = {0.125, 0.75, 0.125};
    double square = 0.0, core = m->core;
    int64_t at[3][3];
    for (int a = 0; a < 3; a++)
        for (int i = 0; i < 3; i++) at[a][i] = held_in(held[a] + i - 1, m->shape[a]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const float *row = m->values + (at[0][i] * m->shape[1] + at[1][j]) * m->shape[2];
            double sum = 0.0;
            for (int k = DIM == 3 ? 0 : 1; k < (DIM == 3 ? 3 : 2); k++) {
                double near = row[at[2][k]], own = near < core ? core * (2.0 * near - core) : near * near;
                sum += DIM == 3 ? weight[k] * own : own;
            }
            square += weight[i] * weight[j] * sum;
        }
    square -= 0.25 * DIM * m->spacing * m->spacing;
    return square < core * core ? (square + core * core) / (2.0 * core) : sqrt(square);
}

/* The clearance at a node of the lattice; `raw`: by the field's distance itself, which is no less. */
static inline double clearance_at(const Map *m, const int64_t *node, int raw) {
    int64_t held[3], beyond = 0;
    for (int a = 0; a < DIM; a++) {
        int64_t place = node[a] - m->low[a];
        held[a] = held_in(place, m->shape[a]);
        beyond += (place - held[a]) * (place - held[a]);
    }
    if (DIM == 2) held[2] = 0;
    double distance = m->values[(held[0] * m->shape[1] + held[1]) * m->shape[2] + held[2]];
    if (!raw && m->smooth && distance < m->limit + SURE * m->spacing) distance = interpolated(m, held);
    if (beyond > 0) {
        double near = distance > 0 ? distance : 0.0;
        distance = sqrt(near * near + (double)beyond * (m->spacing * m->spacing));
    }
    return distance - m->limit;
}

/* Clearances at all nodes. */
void tgco_measure(const Map *m, float *clearance) {
    int64_t node[3];
    for (node[0] = 0; node[0] < m->size[0]; node[0]++)
        for (node[1] = 0; node[1] < m->size[1]; node[1]++)
            for (node[2] = 0; node[2] < m->size[2]; node[2]++) *clearance++ = (float)clearance_at(m, node, 0);
}

/* Blocks ----------------------------------------------------------------------------------------------------------- */

typedef struct { int32_t node[3]; float clearance; } Cell;

/* The nodes of a cell, and whether all of them are the map's own. */
typedef struct { int64_t from[3], to[3]; int own; } Nodes;

static Nodes nodes_of(const Graph *g, const int64_t *cell) {
    const Map *m = g->map;
    Nodes n = {{0, 0, 0}, {1, 1, 1}, 1};
    for (int a = 0; a < DIM; a++) {
        n.from[a] = cell[a] * g->side, n.to[a] = n.from[a] + g->side;
        n.own &= n.from[a] >= m->low[a] && n.to[a] <= m->low[a] + m->shape[a];
        n.to[a] = n.to[a] < m->size[a] ? n.to[a] : m->size[a];
    }
    return n;
}

/* The place of a node among those of a cell. */
static inline int64_t place_in(const Graph *g, const Nodes *n, const int64_t *node) {
    int64_t place = 0;
    for (int a = 0; a < DIM; a++) place = place * g->side + node[a] - n->from[a];
    return place;
}

/* The clearest node of a cell by the field's distances. */
static Cell roughly_clearest(const Graph *g, const Nodes *n) {
    const Map *m = g->map;
    Cell best = {{0, 0, 0}, -INFINITY};
    float most = -INFINITY, limit = (float)m->limit;
    int64_t node[3], count = n->to[2] - n->from[2];
    for (node[0] = n->from[0]; node[0] < n->to[0]; node[0]++)
        for (node[1] = n->from[1]; node[1] < n->to[1]; node[1]++) {
            node[2] = n->from[2];
            const float *tie = g->tie + place_in(g, n, node), *row = NULL;
            if (n->own) {
                int64_t i = node[0] - m->low[0], j = node[1] - m->low[1], k = node[2] - m->low[2];
                row = m->values + (i * m->shape[1] + j) * m->shape[2] + k;
            }
            for (int64_t k = 0; k < count; k++) {
                node[2] = n->from[2] + k;
                float found = row ? row[k] - limit : (float)clearance_at(m, node, 1), merit = found - tie[k];
                if (!(merit > most)) continue;
                most = merit, best.clearance = found;
                for (int a = 0; a < 3; a++) best.node[a] = (int32_t)node[a];
            }
        }
    return best;
}

/* The clearest node of a cell. Where that is sure to be free, or to be blocked, by the field's distances. */
static Cell clearest(const Graph *g, const int64_t *cell) {
    const Map *m = g->map;
    Nodes n = nodes_of(g, cell);
    Cell best = roughly_clearest(g, &n);
    if (best.clearance <= 0 || best.clearance >= SURE * m->spacing) return best;
    int64_t node[3] = {best.node[0], best.node[1], best.node[2]};
    best.clearance = (float)clearance_at(m, node, 0);
    float most = best.clearance - g->tie[place_in(g, &n, node)];
    for (node[0] = n.from[0]; node[0] < n.to[0]; node[0]++)
        for (node[1] = n.from[1]; node[1] < n.to[1]; node[1]++)
            for (node[2] = n.from[2]; node[2] < n.to[2]; node[2]++) {
                float tie = g->tie[place_in(g, &n, node)], found = (float)clearance_at(m, node, 1);
                if (!(found > 0) || !(found - tie > most)) continue; /* it is no less than the other */
                found = (float)clearance_at(m, node, 0);
                if (!(found - tie > most)) continue;
                most = found - tie, best.clearance = found;
                for (int a = 0; a < 3; a++) best.node[a] = (int32_t)node[a];
            }
    return best;
}

static void add_block(Graph *g, const int64_t *cell, const Cell *of, int layers) {
    int64_t v = g->blocks++;
    for (int a = 0; a < 3; a++) g->first[3 * v + a] = (int32_t)cell[a], g->node[3 * v + a] = of->node[a];
    g->layers[v] = (uint8_t)layers, g->clearance[v] = of->clearance;
}

static double nodes_apart(const int32_t *a, const int32_t *b) {
    double square = 0.0;
    for (int i = 0; i < 3; i++) square += (double)(b[i] - a[i]) * (double)(b[i] - a[i]);
    return sqrt(square);
}

/* The clearest of some free cells, if the straight ways from it to all others are free for sure; else -1. */
static int common(const Graph *g, const Cell *cell, int count) {
    int best = 0;
    for (int i = 1; i < count; i++) best = cell[i].clearance > cell[best].clearance ? i : best;
    for (int i = 0; i < count; i++) {
        /* The clearance changes no faster than the point moves. */
        double apart = g->map->spacing * nodes_apart(cell[i].node, cell[best].node);
        if (!((double)cell[i].clearance + (double)cell[best].clearance - apart > 0)) return -1;
    }
    return best;
}

/* Blocks of the free cells: of 2^DIM cells one, where all are free and the clearest sees the others. */
void tgco_blocks(Graph *g) {
    const int64_t *cells = g->cells;
    int64_t corner[3], at[3], step[3];
    g->blocks = 0;
    for (int a = 0; a < 3; a++) step[a] = a < DIM ? 2 : 1;
    for (corner[0] = 0; corner[0] < cells[0]; corner[0] += step[0])
        for (corner[1] = 0; corner[1] < cells[1]; corner[1] += step[1])
            for (corner[2] = 0; corner[2] < cells[2]; corner[2] += step[2]) {
                Cell own[8];
                int64_t place[8], where[8][3];
                int count = 0, all = g->merged, one = -1;
                for (int i = 0; i < 1 << DIM; i++) {
                    int inside = 1;
                    for (int a = 0; a < 3; a++) {
                        at[a] = corner[a] + (a < DIM ? i >> (DIM - 1 - a) & 1 : 0);
                        inside &= at[a] < cells[a];
                    }
                    all &= inside;
                    if (!inside) continue;
                    own[count] = clearest(g, at);
                    place[count] = (at[0] * cells[1] + at[1]) * cells[2] + at[2];
                    memcpy(where[count], at, sizeof at);
                    g->block[place[count]] = -1;
                    all &= own[count].clearance > g->least;
                    count++;
                }
                if (all) one = common(g, own, count);
                if (one >= 0) {
                    for (int i = 0; i < count; i++) g->block[place[i]] = (int32_t)g->blocks;
                    add_block(g, corner, own + one, 2);
                    continue;
                }
                for (int i = 0; i < count; i++) {
                    if (!(own[i].clearance > g->least)) continue;
                    g->block[place[i]] = (int32_t)g->blocks;
                    add_block(g, where[i], own + i, 1);
                }
            }
}

/* The cheapest ways ------------------------------------------------------------------------------------------------ */

/* Whether the segment between the nodes of two blocks is nowhere deep in an obstacle. */
static int joined(const Sweep *s, int64_t a, int64_t b) {
    const Graph *g = s->graph;
    const int32_t *from = g->node + 3 * a, *to = g->node + 3 * b;
    int parts = PARTS * (g->layers[a] > g->layers[b] ? g->layers[a] : g->layers[b]);
    double apart = g->map->spacing * nodes_apart(from, to);
    if ((double)g->clearance[a] + (double)g->clearance[b] - apart > 0) return 1;
    for (int part = 1; part < parts; part++) {
        int64_t at[3];
        for (int i = 0; i < 3; i++) at[i] = (from[i] * (parts - part) + to[i] * part + parts / 2) / parts;
        double raw = clearance_at(g->map, at, 1);
        if (!(raw > s->deepest)) return 0; /* interpolated, it is no more */
        /* Nor is it less by as much as a spacing, farther than two from what is occupied. */
        int sure = raw > s->deepest + g->map->spacing && raw + g->map->limit > 2.0 * g->map->spacing;
        if (!sure && !(clearance_at(g->map, at, 0) > s->deepest)) return 0;
    }
    return 1;
}

/* Between the middles of two blocks, in sides of a cell. */
static double blocks_apart(const Graph *g, int64_t a, int64_t b) {
    double square = 0.0;
    for (int i = 0; i < DIM; i++) {
        int64_t twice = 2 * (g->first[3 * b + i] - g->first[3 * a + i]) + g->layers[b] - g->layers[a];
        square += (double)(twice * twice);
    }
    return 0.5 * sqrt(square);
}

static inline double rest(const Sweep *s, int64_t v) { return s->ahead ? s->ahead[v] : 0.0; }

/* Costs of the cheapest ways from some blocks, whose costs are given, to all, and the block before each; -1 at the
   beginning of a way, and where none leads. With the costs `ahead` to the goal, ways are sought only until one ends: at
   the block that `end` becomes. Returns 0 without memory. */
int32_t tgco_sweep(Sweep *s) {
    const Graph *g = s->graph;
    const int64_t *cells = g->cells;
    int64_t count = 0, room = 1024 + s->seeds;
    double step = g->map->spacing * (double)g->side;
    Entry *heap = malloc(room * sizeof *heap);
    if (!heap) return 0;
    for (int64_t v = 0; v < g->blocks; v++) s->cost[v] = INFINITY, s->before[v] = -1;
    for (int64_t i = 0; i < s->seeds; i++) {
        s->cost[s->seed[i]] = s->seed_cost[i];
        push(heap, &count, s->seed_cost[i] + rest(s, s->seed[i]), (int32_t)s->seed[i]);
    }
    while (count > 0) {
        Entry top = pop(heap, &count);
        int64_t v = top.item, from[3], to[3], at[3];
        if (top.cost > s->cost[v] + rest(s, v)) continue;
        top.cost = s->cost[v];
        if (s->ahead && s->onward[v] < 0) { s->end = v; break; }
        if (count + 64 > room) {
            Entry *more = realloc(heap, 2 * room * sizeof *heap);
            if (!more) { free(heap); return 0; }
            heap = more, room *= 2;
        }
        for (int a = 0; a < 3; a++) {
            int64_t first = g->first[3 * v + a], last = first + (a < DIM ? g->layers[v] : 0);
            from[a] = first > 0 ? first - 1 : 0, to[a] = last < cells[a] ? last : cells[a] - 1;
        }
        for (at[0] = from[0]; at[0] <= to[0]; at[0]++)
            for (at[1] = from[1]; at[1] <= to[1]; at[1]++) {
                const int32_t *row = g->block + (at[0] * cells[1] + at[1]) * cells[2];
                for (at[2] = from[2]; at[2] <= to[2]; at[2]++) {
                    int64_t w = row[at[2]];
                    if (w < 0 || w == v || !(top.cost < s->cost[w]) || !(s->weight[w] < INFINITY)) continue;
                    double cost = top.cost + 0.5 * (blocks_apart(g, v, w) * step) * (s->weight[v] + s->weight[w]);
                    if (!(cost < s->cost[w]) || !joined(s, v, w)) continue;
                    s->cost[w] = cost, s->before[w] = (int32_t)v;
                    push(heap, &count, cost + rest(s, w), (int32_t)w);
                }
            }
    }
    free(heap);
    return 1;
}

/* Taut strings ----------------------------------------------------------------------------------------------------- */

static double clearance_near(const String *s, const double *p) {
    int64_t node[3] = {0, 0, 0};
    for (int i = 0; i < DIM; i++) {
        double place = rint((p[i] - s->origin[i]) * (1.0 / s->map->spacing));
        node[i] = !(place > 0) ? 0 : place < s->map->size[i] - 1 ? (int64_t)place : s->map->size[i] - 1;
    }
    return clearance_at(s->map, node, 0);
}

/* Whether all clearances on the segment from a to b are above `least`: steps are as long as the clearance allows. */
static int sees(const String *s, const double *a, const double *b, double least) {
    double square = 0.0, spacing = s->map->spacing;
    for (int i = 0; i < DIM; i++) square += (b[i] - a[i]) * (b[i] - a[i]);
    double length = sqrt(square);
    for (double at = 0.0;;) {
        double p[DIM], share = length > 0 ? at / length : 0.0;
        for (int i = 0; i < DIM; i++) p[i] = a[i] + share * (b[i] - a[i]);
        double over = clearance_near(s, p) - least;
        if (!(over > 0)) return 0;
        if (at >= length) return 1;
        at += over - spacing > spacing ? over - spacing : spacing;
        at = at < length ? at : length;
    }
}

static double apart(const double *a, const double *b) {
    double square = 0.0;
    for (int i = 0; i < DIM; i++) square += (b[i] - a[i]) * (b[i] - a[i]);
    return sqrt(square);
}

/* From each kept corner straight on to the last point that it sees, and all points before it, no
   farther than `reach`; the kept ones are marked. */
static void mark_corners(const String *s, const double *path, int64_t points, uint8_t *corner) {
    int64_t last = points - 1, i = 0;
    memset(corner, 0, points);
    corner[0] = 1;
    while (i < last) {
        int64_t far = i;
        while (far < last) {
            int ends = far + 1 == last || i == 0;
            const double *from = path + i * DIM, *to = path + (far + 1) * DIM;
            if ((far > i && apart(from, to) > s->reach) || !sees(s, from, to, ends ? s->least : 0.0)) break;
            far++;
        }
        i = far > i ? far : i + 1;
        corner[i] = 1;
    }
}

typedef struct { double *point; int64_t count; } Path;

static double length_of(const Path *path) {
    double sum = 0.0;
    for (int64_t i = 1; i < path->count; i++) sum += apart(path->point + (i - 1) * DIM, path->point + i * DIM);
    return sum;
}

/* Leaves out the corners of a path that aren't needed. */
static void shorten(const String *s, Path *path, uint8_t *corner) {
    int64_t kept = 0;
    mark_corners(s, path->point, path->count, corner);
    for (int64_t i = 0; i < path->count; i++)
        if (corner[i]) memmove(path->point + DIM * kept++, path->point + DIM * i, DIM * sizeof(double));
    path->count = kept;
}

/* The same path with points at most a step apart, from its end to its beginning. */
static void reversed(const Path *path, double step, Path *dense) {
    int64_t last = path->count - 1;
    const double *a = path->point + last * DIM;
    memcpy(dense->point, a, DIM * sizeof(double));
    dense->count = 1;
    for (int64_t i = 0; i < last; i++) {
        const double *b = a - DIM;
        double parts = ceil(apart(a, b) / step);
        int64_t count = parts > 1 ? (int64_t)parts : 1;
        for (int64_t k = 1; k <= count; k++, dense->count++)
            for (int j = 0; j < DIM; j++)
                dense->point[dense->count * DIM + j] = k == count ? b[j] : a[j] + (double)k / (double)count * (b[j] - a[j]);
        a = b;
    }
}

/* A path drawn taut within its homotopy class: corners that aren't needed are left out, from either end in turn. Returns
   how many points it has in `taut`; 0 without memory. */
int32_t tgco_tighten(const String *s) {
    Path path = {s->taut, s->points}, dense = {malloc(s->room * DIM * sizeof(double)), 0};
    uint8_t *corner = malloc(s->room);
    if (!dense.point || !corner) { free(dense.point); free(corner); return 0; }
    memcpy(path.point, s->path, s->points * DIM * sizeof(double));
    shorten(s, &path, corner);
    double step = length_of(&path) / (double)s->parts;
    step = step > 2.0 * s->map->spacing ? step : 2.0 * s->map->spacing;
    for (int64_t round = 0; round < s->rounds; round++) {
        double before = length_of(&path);
        for (int back = 1; back >= 0; back--) {
            reversed(&path, step, &dense); /* twice reversed it is as it was */
            shorten(s, &dense, corner);
            memcpy(path.point, dense.point, dense.count * DIM * sizeof(double));
            path.count = dense.count;
        }
        if (length_of(&path) > (1.0 - s->little) * before) break;
    }
    free(dense.point);
    free(corner);
    return (int32_t)path.count;
}
