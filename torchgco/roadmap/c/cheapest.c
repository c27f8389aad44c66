/* The search for short paths between obstacles, one problem after the other; roadmap/cheapest.py calls it.

   Operations have one order, and none is fused here (-ffp-contract=off). Clearance and nearness are compared as squares,
   detours and costs with a tolerance, and ties are broken by the lowest index: a plain search (tests/reference) finds the
   same paths. DIM is the number of coordinates, BLOCK of edges measured side by side. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "cheapest.h"
#if BOXES
#include "boxes.h"
#endif

#define CLAMP(x, low, high) ((x) < (low) ? (low) : (x) > (high) ? (high) : (x))

/* The spheres of a problem that are present: radii, their squares, centres coordinate by coordinate; boxes, some of
   them absent; and the largest size of all. */
typedef struct {
    int64_t count;
    const double *radius, *square, *at[DIM];
    double largest;
#if BOXES
    int64_t boxes;
    const double *box, *bounds;  // of each box, what is too near it to be free or to cost no more
#endif
} Spheres;

/* Memory for a search over n points with k edges each. */
typedef struct {
    double *edge, *cost, *before, *value, *through;
    int32_t *first, *source, *fresh, *next, *seen;
} Room;

/* The distance from obstacles below which an edge costs more. */
static double margin_of(const Arguments *s, const Spheres *o) {
    return s->margin * (o->largest < SMALL ? SMALL : o->largest);
}

/* How many numbers `spheres_of` needs room for. */
static int64_t sphere_room(const Arguments *s) { return (DIM + 2) * s->spheres + 2 * DIM * s->boxes; }

static Spheres spheres_of(const Arguments *s, int64_t b, double *room) {
    const double *R = s->distances + b * s->spheres;
    double *square = room + DIM * s->spheres, *radius = square + s->spheres;
    Spheres o = {.radius = radius, .square = square};
    for (int i = 0; i < DIM; i++) o.at[i] = room + i * s->spheres;
    for (int64_t m = 0; m < s->spheres; m++) {
        if (R[m] < 0) continue;
        for (int i = 0; i < DIM; i++) room[i * s->spheres + o.count] = s->centers[(b * s->spheres + m) * DIM + i];
        radius[o.count] = R[m], square[o.count++] = R[m] * R[m];
        if (R[m] > o.largest) o.largest = R[m];
    }
#if BOXES
    if (s->largest[b] > o.largest) o.largest = s->largest[b];
    o.boxes = s->boxes, o.box = s->box + b * s->boxes * BOX_NUMBERS;
    double *bounds = radius + s->spheres, margin = margin_of(s, &o), gap = s->clear * o.largest;
    for (int64_t m = 0; m < s->boxes; m++)
        bounds_of(o.box + m * BOX_NUMBERS, margin > gap ? margin : gap, bounds + m * 2 * DIM);
    o.bounds = bounds;
#endif
    return o;
}

static int is_free(const double *p, const Spheres *o, double gap) {
    int all = 1;
    for (int64_t m = 0; m < o->count; m++) {
        double square = 0.0, least = o->radius[m] + gap;
        for (int i = 0; i < DIM; i++) square += (p[i] - o->at[i][m]) * (p[i] - o->at[i][m]);
        all &= square > least * least;
    }
#if BOXES
    for (int64_t m = 0; m < o->boxes; m++) {
        const double *box = o->box + m * BOX_NUMBERS, *bounds = o->bounds + m * 2 * DIM;
        double least = BOX_RADIUS(box) + gap;
        int near = 1;
        for (int i = 0; i < DIM; i++) near &= (p[i] >= bounds[i]) & (p[i] <= bounds[DIM + i]);
        if (near) all &= square_from_box(box, p) > least * least;
    }
#endif
    return all;
}

/* Squared distance of a point from the segment from a to a + along; `inverse` is 1 / its squared length. */
static inline double square_away(const double *p, const double *a, const double *along, double inverse) {
    double toward[DIM], lead = 0.0, away = 0.0;
    for (int i = 0; i < DIM; i++) {
        toward[i] = p[i] - a[i];
        lead += toward[i] * along[i];
    }
    double share = CLAMP(lead * inverse, 0.0, 1.0);
    for (int i = 0; i < DIM; i++) {
        double rest = toward[i] - share * along[i];
        away += rest * rest;
    }
    return away;
}

/* Insert a value smaller than the last of a sorted list, after its equals; the last is dropped. */
static inline void put(double value, int32_t index, double *values, int32_t *indices, int64_t size) {
    int64_t at = size - 1;
    for (; at > 0 && values[at - 1] > value; at--) {
        values[at] = values[at - 1];
        indices[at] = indices[at - 1];
    }
    values[at] = value;
    indices[at] = index;
}

static void empty(double *values, int32_t *indices, int64_t size) {
    for (int64_t i = 0; i < size; i++) values[i] = INFINITY, indices[i] = -1;
}

/* Points ----------------------------------------------------------------------------------------------------------- */

static double square_of(const double *a, const double *b) {
    double square = 0.0;
    for (int i = 0; i < DIM; i++) square += (a[i] - b[i]) * (a[i] - b[i]);
    return square;
}

/* Candidates around the spheres, midway between each and its nearest, and around boxes; returns their number. */
static int64_t propose(const Arguments *s, int64_t b, double *values, int32_t *near, double *to) {
    const double *o = s->centers + b * s->spheres * DIM, *R = s->distances + b * s->spheres;
    const double *rays = s->rays + b * s->directions * DIM;
    double *p = to;
    for (int64_t shell = 0; shell < s->shells; shell++)
        for (int64_t m = 0; m < s->spheres; m++)
            for (int64_t r = 0; r < s->directions && R[m] >= 0; r++, p += DIM)
                for (int i = 0; i < DIM; i++) p[i] = o[m * DIM + i] + s->shell[shell] * R[m] * rays[r * DIM + i];
    for (int64_t m = 0; m < s->spheres; m++) {
        empty(values, near, s->midway);
        for (int64_t n = 0; n < s->spheres && R[m] >= 0; n++) {
            double square = square_of(o + m * DIM, o + n * DIM);
            if (n != m && R[n] >= 0 && square < values[s->midway - 1])
                put(square, (int32_t)n, values, near, s->midway);
        }
        for (int64_t h = 0; h < s->midway && near[h] >= 0; h++, p += DIM) {
            double length = sqrt(values[h]);
            double share = 0.5 + 0.5 * ((R[m] - R[near[h]]) / (length < TINY ? TINY : length));
            for (int i = 0; i < DIM; i++)
                p[i] = o[m * DIM + i] + share * (o[near[h] * DIM + i] - o[m * DIM + i]);
        }
    }
#if BOXES
    for (int64_t e = b * s->extras; e < (b + 1) * s->extras; e++)
        if (s->exists[e]) memcpy(p, s->beside + e * DIM, DIM * sizeof(double)), p += DIM;
#endif
    return (p - to) / DIM;
}

/* Start, goal, and points spread over the region that holds start, goal and obstacles. */
static void scatter(const Arguments *s, int64_t b, double *to) {
    const double *start = s->start + b * DIM, *goal = s->goal + b * DIM, *reach = s->reach + b * 2 * DIM;
    for (int i = 0; i < DIM; i++) {
        double low = reach[i], high = reach[DIM + i];
        to[i] = start[i], to[DIM + i] = goal[i];
        for (int64_t v = 0; v < s->spread; v++) to[(2 + v) * DIM + i] = low + s->cube[v * DIM + i] * (high - low);
    }
}

/* The points of a graph: those of `scatter`, then the candidates with the shortest detours; unused places lie at the
   start. */
static void choose(
    const Arguments *s, int64_t b, const Spheres *o, const double *others, int64_t count, double *values,
    int32_t *indices, uint8_t *usable
) {
    double gap = s->clear * o->largest, *nodes = s->nodes + b * s->points * DIM;
    int64_t given = 2 + s->spread, most = s->points - given;
    scatter(s, b, nodes);
    for (int64_t v = 0; v < given; v++) usable[v] = v < 2 || is_free(nodes + v * DIM, o, gap);
    empty(values, indices, most);
    for (int64_t c = 0; c < count; c++) {
        const double *p = others + c * DIM;
        // In single precision, so that detours which differ by rounding alone are equal.
        double detour = (float)(sqrt(square_of(p, nodes)) + sqrt(square_of(p, nodes + DIM)));
        if (detour < values[most - 1] && is_free(p, o, gap)) put(detour, (int32_t)c, values, indices, most);
    }
    for (int64_t v = 0; v < most; v++) {
        memcpy(nodes + (given + v) * DIM, indices[v] < 0 ? nodes : others + indices[v] * DIM, DIM * sizeof(double));
        usable[given + v] = indices[v] >= 0;
    }
}

/* Each free point's edges: to the nearest points, to the nearest of those from `scatter`, to the goal. */
static void join(const Arguments *s, int64_t b, const uint8_t *usable, double *at, double *values, int32_t *found) {
    const double *nodes = s->nodes + b * s->points * DIM;
    int64_t n = s->points, k = s->edges, given = 2 + s->spread, near = s->neighbours, hubs = s->hubs;
    int64_t most = near > hubs ? near : hubs;
    double *apart = at + DIM * n;
    for (int64_t v = 0; v < n; v++)
        for (int i = 0; i < DIM; i++) at[i * n + v] = nodes[v * DIM + i];
    for (int64_t v = 0; v < n; v++) {
        int32_t *ends = s->ends + (b * n + v) * k;
        empty(values, found, most);
        for (int64_t w = 0; w < n; w++) {
            double square = 0.0;
            for (int i = 0; i < DIM; i++) square += (at[i * n + v] - at[i * n + w]) * (at[i * n + v] - at[i * n + w]);
            apart[w] = usable[w] ? square : INFINITY;
        }
        apart[v] = INFINITY;
        for (int64_t w = 0; w < n && usable[v]; w++) {
            if (w == given) memcpy(ends + near, found, hubs * sizeof(int32_t));
            if (apart[w] < values[most - 1]) put(apart[w], (int32_t)w, values, found, most);
        }
        if (n == given || !usable[v]) memcpy(ends + near, found, hubs * sizeof(int32_t));
        memcpy(ends, found, near * sizeof(int32_t));
        ends[k - 1] = usable[v] ? 1 : -1;
    }
}

/* Lengths ---------------------------------------------------------------------------------------------------------- */

/* Lengths of the edges of n points, k each, to `ends`: longer close to an obstacle, infinite through one. */
static void measure(
    const Arguments *s, const Spheres *o, const double *p, int64_t n, int64_t k, const int32_t *ends, double *lengths
) {
    double margin = margin_of(s, o), whole = 0.0;
    for (int i = 0; i < DIM; i++) whole += (p[DIM + i] - p[i]) * (p[DIM + i] - p[i]);
    double shortest = s->least * sqrt(whole);
    int64_t from = 0, slot = 0;
    for (int64_t first = 0; first < n * k; first += BLOCK) {
        double a[DIM][BLOCK], along[DIM][BLOCK], square[BLOCK], inverse[BLOCK], gap[BLOCK], open[BLOCK];
        for (int e = 0; e < BLOCK; e++) {
            int64_t to = ends[from * k + slot] < 0 ? from : ends[from * k + slot];
            square[e] = 0.0;
            for (int i = 0; i < DIM; i++) {
                a[i][e] = p[from * DIM + i];
                along[i][e] = p[to * DIM + i] - a[i][e];
                square[e] += along[i][e] * along[i][e];
            }
            inverse[e] = 1.0 / (square[e] < TINY ? TINY : square[e]);
            gap[e] = open[e] = INFINITY;
            if (++slot == k) slot = 0, from += from + 1 < n;  // past the last edge, the last point's again
        }
        for (int64_t m = 0; m < o->count; m++)
            for (int e = 0; e < BLOCK; e++) {
                double center[DIM], begin[DIM], step[DIM];
                for (int i = 0; i < DIM; i++) center[i] = o->at[i][m], begin[i] = a[i][e], step[i] = along[i][e];
                double away = square_away(center, begin, step, inverse[e]);
                double left = sqrt(away) - o->radius[m], more = away - o->square[m];
                gap[e] = left < gap[e] ? left : gap[e];
                open[e] = more < open[e] ? more : open[e];
            }
#if BOXES
        Segments segments;
        find_bounds(a, along, &segments);
        for (int64_t m = 0; m < o->boxes; m++)
            measure_box(o->box + m * BOX_NUMBERS, o->bounds + m * 2 * DIM, &segments, gap, open);
#endif
        for (int e = 0; e < BLOCK && first + e < n * k; e++) {
            double close = 1.0 + CLAMP((margin - gap[e]) / margin, 0.0, 1.0);
            lengths[first + e] = ends[first + e] >= 0 && open[e] > 0 ? (sqrt(square[e]) + shortest) * close : INFINITY;
        }
    }
}

/* Free edges first, then the blocked ones, marked by -1. */
static void pack(int64_t n, int64_t k, int32_t *ends, double *lengths) {
    for (int64_t v = 0; v < n; v++, ends += k, lengths += k) {
        int64_t held = 0;
        for (int64_t i = 0; i < k; i++) {
            int32_t end = ends[i];
            double length = lengths[i];
            ends[held] = end, lengths[held] = length;
            held += length < INFINITY;
        }
        for (int64_t i = held; i < k; i++) ends[i] = -1, lengths[i] = INFINITY;
    }
}

/* Paths ------------------------------------------------------------------------------------------------------------ */

static size_t room_size(int64_t n, int64_t k) {
    return (2 * n * k + 2 * n + k) * sizeof(double) + (n * k + 4 * n + 2) * sizeof(int32_t);
}

static Room room_at(void *memory, int64_t n, int64_t k) {
    Room r = {.edge = memory};
    r.value = r.edge + n * k;
    r.cost = r.value + n * k;
    r.before = r.cost + n;
    r.through = r.before + n;
    r.source = (int32_t *)(r.through + k);
    r.first = r.source + n * k;
    r.fresh = r.first + n + 2;
    r.next = r.fresh + n;
    r.seen = r.next + n;
    return r;
}

/* Sort edges by the point where they end: once that point's cost has fallen, they pass the change on. */
static void turn(Room *r, int64_t n, int64_t k, const int32_t *ends) {
    int32_t *first = r->first;
    memset(first, 0, (n + 2) * sizeof(int32_t));
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++) first[ends[e] + 2]++;
    for (int64_t v = 0; v < n; v++) first[v + 2] += first[v + 1];
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++) {
            int32_t place = first[ends[e] + 1]++;
            r->source[place] = (int32_t)v;
            r->value[place] = r->edge[e];
        }
}

/* Costs of the cheapest paths to point 1 with at most `rounds` edges: a round reads the costs of the round before. */
static void relax(Room *r, int64_t n, int64_t rounds) {
    int64_t fresh = 1;
    for (int64_t v = 0; v < n; v++) r->cost[v] = INFINITY, r->seen[v] = -1;
    r->cost[1] = 0.0;
    r->fresh[0] = 1;
    for (int32_t round = 0; round < rounds && fresh > 0; round++) {
        int64_t next = 0;
        for (int64_t f = 0; f < fresh; f++) r->before[f] = r->cost[r->fresh[f]];
        for (int64_t f = 0; f < fresh; f++)
            for (int32_t e = r->first[r->fresh[f]]; e < r->first[r->fresh[f] + 1]; e++) {
                int32_t v = r->source[e];
                double through = r->value[e] + r->before[f];
                if (!(through < r->cost[v])) continue;
                r->cost[v] = through;
                if (r->seen[v] != round) r->seen[v] = round, r->next[next++] = v;
            }
        int32_t *done = r->fresh;
        r->fresh = r->next, r->next = done, fresh = next;
    }
}

/* The cheapest path from point 0 to point 1, as corners; returns whether there is one. */
static int cheapest(
    const Arguments *s, Room r, const double *p, int64_t n, int64_t k, const int32_t *ends, const double *lengths,
    const double *price, double *path
) {
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++)
            r.edge[e] = lengths[e] * 0.5 * (price[v] + price[ends[e]]);
    turn(&r, n, k, ends);
    relax(&r, n, s->corners - 1);
    int64_t stop = 0;
    for (int64_t c = 0; c < s->corners; c++) {
        memcpy(path + c * DIM, p + stop * DIM, DIM * sizeof(double));
        if (stop == 1 || c + 1 == s->corners) continue;
        double best = INFINITY;
        int64_t first = stop * k, e = first;
        for (; e < first + k && ends[e] >= 0; e++) {
            r.through[e - first] = r.edge[e] + r.cost[ends[e]];
            if (r.through[e - first] < best) best = r.through[e - first];
        }
        if (!(best < INFINITY)) return 0;
        for (e = first; !(r.through[e - first] <= best + s->tie * fabs(best)); e++) continue;
        stop = ends[e];
    }
    return stop == 1;
}

/* Number of edges of a path: its corners that differ from its end. */
static int64_t edges_of(const double *path, int64_t corners) {
    int64_t edges = 0;
    for (int64_t c = 0; c < corners; c++) {
        int other = 0;
        for (int i = 0; i < DIM; i++) other |= path[c * DIM + i] != path[(corners - 1) * DIM + i];
        edges += other;
    }
    return edges;
}

/* Start and goal of a path, then alternately the middles of its edges and its other corners. */
static void lay(const double *path, int64_t corners, double *string) {
    memcpy(string, path, DIM * sizeof(double));
    memcpy(string + DIM, path + (corners - 1) * DIM, DIM * sizeof(double));
    for (const double *a = path, *end = path + (corners - 1) * DIM; a < end; a += DIM, string += 2 * DIM)
        for (int i = 0; i < DIM; i++) {
            string[2 * DIM + i] = 0.5 * (a[i] + a[DIM + i]);
            if (a + DIM < end) string[3 * DIM + i] = a[DIM + i];
        }
}

/* Called from Python for the problems begin, ..., end - 1; 0 where there is no memory ------------------------------ */

int32_t tgco_graph(const Arguments *s, int64_t begin, int64_t end) {
    int64_t n = s->points, k = s->edges, list = n + k + s->midway;
    int64_t size = sphere_room(s) + (DIM + 1) * n + DIM * s->candidates + list;
    double *memory = malloc(size * sizeof(double) + list * sizeof(int32_t) + n);
    if (!memory) return 0;
    double *at = memory + sphere_room(s), *others = at + (DIM + 1) * n, *values = others + DIM * s->candidates;
    int32_t *indices = (int32_t *)(memory + size);
    uint8_t *usable = (uint8_t *)(indices + list);
    for (int64_t b = begin; b < end; b++) {
        Spheres o = spheres_of(s, b, memory);
        int64_t count = propose(s, b, values, indices, others);
        choose(s, b, &o, others, count, values, indices, usable);
        join(s, b, usable, at, values, indices);
        int32_t *ends = s->ends + b * n * k;
        measure(s, &o, s->nodes + b * n * DIM, n, k, ends, s->lengths + b * n * k);
        pack(n, k, ends, s->lengths + b * n * k);
    }
    free(memory);
    return 1;
}

int32_t tgco_cheapest(const Arguments *s, int64_t begin, int64_t end) {
    int64_t n = s->points, k = s->edges, size = s->corners * DIM;
    void *memory = malloc(room_size(n, k));
    if (!memory) return 0;
    Room room = room_at(memory, n, k);
    for (int64_t b = begin; b < end; b++) {
        const double *p = s->nodes + b * n * DIM;
        double *path = s->path + b * size;
        s->arrives[b] = cheapest(
            s, room, p, n, k, s->ends + b * n * k, s->lengths + b * n * k, s->price + b * n, path
        );
        if (!s->arrives[b])
            for (int64_t c = 0; c < s->corners; c++) memcpy(path + c * DIM, p + (c > 0) * DIM, DIM * sizeof(double));
        lay(path, s->corners, s->string + b * (2 * s->corners - 1) * DIM);
    }
    free(memory);
    return 1;
}

int32_t tgco_taut(const Arguments *s, int64_t begin, int64_t end) {
    int64_t most = 2 * s->corners - 1, size = s->corners * DIM;
    size_t lengths_size = most * most * sizeof(double), ends_size = most * most * sizeof(int32_t);
    size_t room = room_size(most, most), spheres = sphere_room(s) * sizeof(double);
    char *memory = malloc(lengths_size + size * sizeof(double) + spheres + room + ends_size);
    if (!memory) return 0;
    double *lengths = (double *)memory, *taut = lengths + most * most, *at = taut + size;
    void *rest = at + sphere_room(s);
    int32_t *ends = (int32_t *)((char *)rest + room);
    for (int64_t b = begin; b < end; b++) {
        double *path = s->path + b * size;
        int64_t n = 2 * edges_of(path, s->corners) + 1;
        if (n == 1) continue;
        Spheres o = spheres_of(s, b, at);
        for (int64_t e = 0; e < n * n; e++) ends[e] = (int32_t)(e % n);
        const double *p = s->string + b * most * DIM;
        measure(s, &o, p, n, n, ends, lengths);
        pack(n, n, ends, lengths);
        if (cheapest(s, room_at(rest, n, n), p, n, n, ends, lengths, s->cost + b * most, taut))
            memcpy(path, taut, size * sizeof(double));
    }
    free(memory);
    return 1;
}

int32_t tgco_raise(const Arguments *s, int64_t begin, int64_t end) {
    int64_t n = s->points, M = s->spheres;
    double *at = malloc((DIM + 1) * n * sizeof(double)), *nearest = at + DIM * n;
    if (!at) return 0;
    for (int64_t b = begin; b < end; b++) {
        const double *path = s->path + b * s->corners * DIM, *R = s->distances + b * M;
        double reach = 0.0;
        for (int64_t m = 0; m < M; m++) reach = R[m] > reach ? R[m] : reach;
#if BOXES
        if (s->largest[b] > reach) reach = s->largest[b];
#endif
        for (int64_t v = 0; v < n; v++) {
            nearest[v] = INFINITY;
            for (int i = 0; i < DIM; i++) at[i * n + v] = s->nodes[(b * n + v) * DIM + i];
        }
        for (const double *a = path; a < path + (s->corners - 1) * DIM; a += DIM) {
            double along[DIM], square = 0.0;
            for (int i = 0; i < DIM; i++) along[i] = a[DIM + i] - a[i], square += along[i] * along[i];
            double inverse = 1.0 / (square < TINY ? TINY : square);
            for (int64_t v = 0; v < n; v++) {
                double point[DIM];
                for (int i = 0; i < DIM; i++) point[i] = at[i * n + v];
                double away = square_away(point, a, along, inverse);
                nearest[v] = away < nearest[v] ? away : nearest[v];
            }
        }
        for (int64_t v = 0; v < n; v++)
            if (nearest[v] < reach * reach) s->price[b * n + v] *= s->factor;
    }
    free(at);
    return 1;
}
