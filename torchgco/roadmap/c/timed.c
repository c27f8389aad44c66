/* The cheapest ways through space and time, one of each class (roadmap/timed.py).

   A state is a layer of time, a cell, and the move that led there; a move differs from the one before by at most one
   unit along each axis. Two sweeps of dynamic programming give the least cost through every state. Two dimensions are
   three, with one cell and one move along the last axis. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "timed.h"

typedef struct {
    const Timed *t;
    int64_t cells, moves, step[3], turn[3]; /* strides of cells and of moves */
    const int32_t *move; /* (moves, 3) */
    const float *length; /* (moves): m */
    float *node; /* (layers + 1, cells): cell_cost, FAR where an obstacle is too near */
    float *ahead; /* (layers + 1, cells): no more than what any way costs from there on, without the changes of moves */
    float *there, *onward; /* (layers + 1, cells, moves): the cheapest way to each state, and from it to the end */
    uint8_t *seen; /* (layers + 1, cells): whether any way leads there */
    float *row, *wide; /* (moves): scratch */
    float limit; /* what a way may cost */
} Sweep;

/* The clearance at a layer's part and at a point between cells, in cells. */
static float clearance_at(const Sweep *w, int64_t part, const float *at) {
    const float *field = w->t->clearance + part * w->cells;
    int64_t base = 0, step[DIM];
    float share[DIM], sum = 0.0f;
    for (int a = 0; a < DIM; a++) {
        int64_t last = w->t->counts[a] - 1, i = (int64_t)at[a];
        i = i < 0 ? 0 : i > last ? last : i;
        share[a] = i < last ? at[a] - (float)i : 0.0f;
        step[a] = i < last ? w->step[a] : 0;
        base += i * w->step[a];
    }
    for (int corner = 0; corner < 1 << DIM; corner++) {
        float weight = 1.0f;
        int64_t place = base;
        for (int a = 0; a < DIM; a++) {
            int up = corner >> a & 1;
            weight *= up ? share[a] : 1.0f - share[a];
            place += up ? step[a] : 0;
        }
        if (weight > 0.0f) sum += weight * field[place];
    }
    return sum;
}

static void cell_of(const Sweep *w, int64_t cell, int64_t *at) {
    for (int a = 0; a < DIM; a++) at[a] = cell / w->step[a] % w->t->counts[a];
}

/* Where a move leads from a cell at `at`; -1: out of the lattice. */
static inline int64_t moved(const Sweep *w, const int64_t *at, int64_t cell, const int32_t *d) {
    for (int a = 0; a < DIM; a++) {
        if ((uint64_t)(at[a] + d[a]) >= (uint64_t)w->t->counts[a]) return -1;
        cell += d[a] * w->step[a];
    }
    return cell;
}

/* Whether a move from a cell keeps clear; the clearance changes no faster than the place does. */
static int is_clear(const Sweep *w, int64_t layer, const int64_t *at, int64_t m, float room) {
    if (w->length[m] <= room) return 1;
    const Timed *t = w->t;
    const int32_t *d = w->move + 3 * m;
    for (int64_t s = 1; s < t->parts; s++) {
        float point[DIM], share = (float)s / (float)t->parts;
        for (int a = 0; a < DIM; a++) point[a] = (float)at[a] + share * (float)d[a];
        if (clearance_at(w, layer * t->parts + s, point) < (float)t->margin) return 0;
    }
    return 1;
}

/* How far, m, moves from a cell at a layer lead that keep clear for sure. */
static float room_at(const Sweep *w, int64_t layer, int64_t cell) {
    const Timed *t = w->t;
    float room = FAR;
    for (int64_t s = 1; s < t->parts; s++) {
        float gap = t->clearance[(layer * t->parts + s) * w->cells + cell] - (float)t->margin;
        float far = gap * (float)t->parts / (float)s;
        room = far < room ? far : room;
    }
    return room;
}

/* The least of what is at most one unit away along each axis, with the cost of the change. */
static const float *changed(const Sweep *w, const float *row) {
    const Timed *t = w->t;
    float *to = w->wide, *other = w->row;
    for (int a = 0; a < DIM; a++) {
        int64_t n = t->moves[a], step = w->turn[a];
        float more = t->change[a];
        for (int64_t o = 0; o < w->moves; o += n * step)
            for (int64_t k = 0; k < n; k++) {
                const float *mid = row + o + k * step, *low = k > 0 ? mid - step : mid, *high = k + 1 < n ? mid + step : mid;
                float *out = to + o + k * step;
                for (int64_t j = 0; j < step; j++) {
                    float side = (low[j] < high[j] ? low[j] : high[j]) + more;
                    out[j] = mid[j] < side ? mid[j] : side;
                }
            }
        row = to;
        float *swap = to;
        to = other;
        other = swap;
    }
    return row;
}

/* What any way costs at least from each layer and cell on, by cells and moves alone. */
static void look_ahead(const Sweep *w, float *scratch) {
    const Timed *t = w->t;
    float least = FAR, last = FAR, margin = (float)t->margin;
    for (int64_t l = 0; l <= t->layers; l++) {
        const float *gap = t->clearance + l * t->parts * w->cells, *cost = t->cell_cost + l * w->cells;
        for (int64_t c = 0; c < w->cells; c++)
            w->node[l * w->cells + c] = gap[c] < margin || cost[c] >= FAR ? FAR : cost[c];
    }
    for (int64_t m = 0; m < w->moves; m++) {
        least = t->move_cost[m] < least ? t->move_cost[m] : least;
        last = t->last_cost[m] < last ? t->last_cost[m] : last;
    }
    for (int64_t c = 0; c < w->cells; c++) w->ahead[t->layers * w->cells + c] = last;
    for (int64_t l = t->layers - 1; l >= 0; l--) {
        float *own = w->ahead + l * w->cells, *from = scratch, *to = own;
        for (int64_t c = 0; c < w->cells; c++) {
            float cost = w->node[(l + 1) * w->cells + c] + own[w->cells + c];
            from[c] = cost < FAR ? cost : FAR;
        }
        for (int a = 0; a < DIM; a++) {
            int64_t n = t->counts[a], step = w->step[a], low = t->least[a], high = low + t->moves[a] - 1;
            for (int64_t c = 0; c < w->cells; c++) {
                int64_t i = c / step % n, first = i + low < 0 ? -i : low, end = i + high >= n ? n - 1 - i : high;
                float cost = FAR;
                for (int64_t k = first; k <= end; k++) cost = from[c + k * step] < cost ? from[c + k * step] : cost;
                to[c] = cost;
            }
            float *swap = from;
            from = to;
            to = swap;
        }
        if (from != own) memcpy(own, from, sizeof(float) * (size_t)w->cells);
        for (int64_t c = 0; c < w->cells; c++) own[c] = own[c] < FAR ? own[c] + least : FAR;
    }
}

/* The cheapest ways to all states; returns what the cheapest to the end costs. */
static float sweep_there(Sweep *w) {
    const Timed *t = w->t;
    int64_t M = w->moves;
    memset(w->seen, 0, (size_t)((t->layers + 1) * w->cells));
    for (int64_t m = 0; m < M; m++) w->there[t->start * M + m] = FAR;
    w->there[t->start * M + t->first] = 0.0f;
    w->seen[t->start] = 1;
    for (int64_t l = 0; l < t->layers; l++)
        for (int64_t c = 0; c < w->cells; c++) {
            if (!w->seen[l * w->cells + c] || w->ahead[l * w->cells + c] >= FAR) continue;
            const float *cost = changed(w, w->there + (l * w->cells + c) * M);
            float room = room_at(w, l, c);
            int64_t at[DIM];
            cell_of(w, c, at);
            for (int64_t m = 0; m < M; m++) {
                float so_far = cost[m] + t->move_cost[m];
                int64_t to = so_far < FAR ? moved(w, at, c, w->move + 3 * m) : -1;
                if (to < 0) continue;
                int64_t next = (l + 1) * w->cells + to;
                float node = w->node[next];
                if (node >= FAR || w->ahead[next] >= FAR || !is_clear(w, l, at, m, room)) continue;
                if (!w->seen[next]) {
                    w->seen[next] = 1;
                    for (int64_t k = 0; k < M; k++) w->there[next * M + k] = FAR;
                }
                w->there[next * M + m] = so_far + node; /* which no other cell's move leads to */
            }
        }
    float best = FAR;
    for (int64_t c = 0; c < w->cells; c++)
        for (int64_t m = 0, at = t->layers * w->cells + c; w->seen[at] && m < M; m++) {
            float cost = w->there[at * M + m] + t->last_cost[m];
            best = cost < best ? cost : best;
        }
    return best;
}

/* The cheapest ways on from all states that a way within the limit may lead through. */
static void sweep_onward(Sweep *w, float *through) {
    const Timed *t = w->t;
    int64_t M = w->moves;
    float *ahead = w->onward; /* of the last layer, then of those before */
    for (int64_t l = t->layers; l >= 0; l--)
        for (int64_t c = 0; c < w->cells; c++) {
            int64_t place = l * w->cells + c, at[DIM];
            through[place] = FAR;
            if (!w->seen[place]) continue;
            const float *there = w->there + place * M;
            float *own = ahead + place * M, least = FAR;
            for (int64_t m = 0; m < M; m++) least = there[m] < least ? there[m] : least;
            if (least + w->ahead[place] > w->limit) {
                w->seen[place] = 0;
                continue;
            }
            if (l == t->layers) memcpy(own, t->last_cost, sizeof(float) * (size_t)M);
            else {
                cell_of(w, c, at);
                for (int64_t m = 0; m < M; m++) {
                    int64_t to = moved(w, at, c, w->move + 3 * m), next = (l + 1) * w->cells + to;
                    own[m] = FAR;
                    if (to < 0 || !w->seen[next] || w->there[next * M + m] >= FAR) continue;
                    float cost = t->move_cost[m] + w->node[next] + ahead[next * M + m];
                    own[m] = cost < FAR ? cost : FAR;
                }
                memcpy(own, changed(w, own), sizeof(float) * (size_t)M);
            }
            for (int64_t m = 0; m < M; m++) {
                float cost = there[m] + own[m];
                through[place] = cost < through[place] ? cost : through[place];
            }
        }
}

/* The move, at most one unit per axis from `m`, that minimises `cost` with the change; -1 where none is finite. */
static int64_t beside(const Sweep *w, int64_t m, const float *cost) {
    const Timed *t = w->t;
    int64_t best = -1;
    float least = FAR;
    for (int64_t k = 0; k < w->moves; k++) {
        float sum = cost[k];
        for (int a = 0; a < DIM; a++) {
            int32_t more = w->move[3 * k + a] - w->move[3 * m + a];
            sum += more == 0 ? 0.0f : more * more == 1 ? t->change[a] : FAR;
        }
        if (sum < least) least = sum, best = k;
    }
    return best;
}

/* The cells of the cheapest way through a cell at a layer; 0 where it doesn't lead to both ends. */
static int trace(Sweep *w, int64_t layer, int64_t cell, int32_t *way) {
    const Timed *t = w->t;
    int64_t M = w->moves, place = layer * w->cells + cell, m = 0, at[DIM];
    float least = FAR;
    for (int64_t k = 0; k < M; k++) {
        float cost = w->there[place * M + k] + w->onward[place * M + k];
        if (cost < least) least = cost, m = k;
    }
    way[layer] = (int32_t)cell;
    int64_t move = m, from = cell;
    for (int64_t l = layer; l > 0; l--) {
        for (int a = 0; a < DIM; a++) from -= w->move[3 * move + a] * w->step[a];
        way[l - 1] = (int32_t)from;
        move = beside(w, move, w->there + ((l - 1) * w->cells + from) * M);
        if (move < 0) return 0;
    }
    for (int64_t l = layer; l < t->layers; l++) {
        cell_of(w, cell, at);
        for (int64_t k = 0; k < M; k++) {
            int64_t to = moved(w, at, cell, w->move + 3 * k), next = (l + 1) * w->cells + to;
            w->row[k] = FAR;
            if (to < 0 || !w->seen[next] || w->there[next * M + k] >= FAR) continue;
            w->row[k] = t->move_cost[k] + w->node[next] + w->onward[next * M + k];
        }
        m = beside(w, m, w->row);
        if (m < 0) return 0;
        cell = moved(w, at, cell, w->move + 3 * m);
        way[l + 1] = (int32_t)cell;
    }
    return 1;
}

/* Whether the segment between two ways is clear at all times: one becomes the other without passing an obstacle. */
static int is_same(const Sweep *w, const int32_t *a, const int32_t *b) {
    const Timed *t = w->t;
    for (int64_t l = 0; l < t->layers; l++) {
        if (a[l] == b[l] && a[l + 1] == b[l + 1]) continue;
        int64_t ends[4][DIM];
        cell_of(w, a[l], ends[0]), cell_of(w, a[l + 1], ends[1]);
        cell_of(w, b[l], ends[2]), cell_of(w, b[l + 1], ends[3]);
        for (int64_t s = 1; s <= t->parts; s++) {
            float share = (float)s / (float)t->parts, p[DIM], q[DIM], far = 0.0f;
            for (int i = 0; i < DIM; i++) {
                p[i] = (float)ends[0][i] + share * (float)(ends[1][i] - ends[0][i]);
                q[i] = (float)ends[2][i] + share * (float)(ends[3][i] - ends[2][i]);
                far += (q[i] - p[i]) * (q[i] - p[i]);
            }
            int64_t steps = (int64_t)ceilf(2.0f * sqrtf(far)); /* half a cell apart */
            for (int64_t k = 1; k < steps; k++) {
                float point[DIM];
                for (int i = 0; i < DIM; i++) point[i] = p[i] + (q[i] - p[i]) * (float)k / (float)steps;
                if (clearance_at(w, l * t->parts + s, point) < 0.0f) return 0;
            }
        }
    }
    return 1;
}

typedef struct { float cost; int32_t layer, cell; } Least;

static int cheaper(const void *a, const void *b) {
    const Least *p = a, *q = b;
    if (p->cost != q->cost) return p->cost < q->cost ? -1 : 1;
    return p->layer != q->layer ? p->layer - q->layer : p->cell - q->cell;
}

/* Cells at which the cheapest ways of a few layers are cheaper than those through the cells beside; how many. */
static int64_t local_minima(const Sweep *w, const float *through, Least *found) {
    const Timed *t = w->t;
    int64_t count = 0, every = t->layers / LOOKS > 1 ? t->layers / LOOKS : 1;
    for (int64_t l = every; l <= t->layers; l += every)
        for (int64_t c = 0; c < w->cells; c++) {
            const float *own = through + l * w->cells + c;
            int64_t at[DIM];
            if (*own >= FAR || *own > w->limit) continue;
            cell_of(w, c, at);
            int low = 1;
            for (int a = 0; a < DIM && low; a++)
                low = (at[a] == 0 || *own <= own[-w->step[a]]) && (at[a] == t->counts[a] - 1 || *own <= own[w->step[a]]);
            if (low) found[count++] = (Least){*own, (int32_t)l, (int32_t)c};
        }
    return count;
}

static void classes(Sweep *w, Timed *t, const float *through, Least *found) {
    int64_t count = local_minima(w, through, found), line = t->layers + 1;
    qsort(found, (size_t)count, sizeof(Least), cheaper);
    for (int64_t i = 0; i < count && i < t->tries && t->found < t->most; i++) {
        int32_t *way = t->way + t->found * line;
        int is_new = trace(w, found[i].layer, found[i].cell, way);
        for (int64_t k = 0; k < t->found && is_new; k++) is_new = !is_same(w, t->way + k * line, way);
        if (is_new) t->cost[t->found++] = found[i].cost;
    }
}

static int search(Timed *t, Sweep *w, float *through, float *scratch, Least *found) {
    t->found = t->states = 0;
    look_ahead(w, scratch);
    float best = sweep_there(w);
    for (int64_t i = 0; i < (t->layers + 1) * w->cells; i++) t->states += w->seen[i];
    if (best >= FAR) return 1;
    w->limit = best + (float)t->dearer * fabsf(best);
    sweep_onward(w, through);
    classes(w, t, through, found);
    return 1;
}

/* One problem; 0 where there is no memory. */
static int solve(Timed *t) {
    Sweep w = {.t = t, .cells = 1, .moves = 1};
    for (int a = DIM - 1; a >= 0; a--) {
        w.step[a] = w.cells, w.cells *= t->counts[a];
        w.turn[a] = w.moves, w.moves *= t->moves[a];
    }
    size_t places = (size_t)((t->layers + 1) * w.cells), states = places * (size_t)w.moves;
    int32_t *move = malloc(sizeof(int32_t) * 3 * (size_t)w.moves);
    float *numbers = malloc(sizeof(float) * (3 * places + 3 * (size_t)w.moves + (size_t)w.cells));
    w.there = malloc(sizeof(float) * states), w.onward = malloc(sizeof(float) * states);
    w.seen = malloc(places);
    Least *found = malloc(sizeof(Least) * places);
    int done = move && numbers && w.there && w.onward && w.seen && found;
    if (done) {
        float *length = numbers + 3 * places + w.cells;
        w.ahead = numbers, w.node = numbers + 2 * places + w.cells, w.move = move, w.length = length, w.row = length + w.moves, w.wide = w.row + w.moves;
        for (int64_t m = 0; m < w.moves; m++) {
            double far = 0.0;
            for (int a = 0; a < 3; a++) {
                int64_t d = a < DIM ? t->least[a] + m / w.turn[a] % t->moves[a] : 0;
                move[3 * m + a] = (int32_t)d, far += (double)(d * d);
            }
            length[m] = (float)(t->spacing * sqrt(far));
        }
        done = search(t, &w, t->through ? t->through : numbers + places + w.cells, numbers + places, found);
    }
    free(move), free(numbers), free(w.there), free(w.onward), free(w.seen), free(found);
    return done;
}

/* Problems `begin` to `end` of those at `all`, each by itself; 0 where there is no memory. */
int tgco_timed(Timed *all, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; b++)
        if (!solve(all + b)) return 0;
    return 1;
}
