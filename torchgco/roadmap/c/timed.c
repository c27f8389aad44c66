/* The cheapest ways through space and time, one of each class (roadmap/timed.py).

   A state is a layer of time, a cell, and the move that led there; a move differs from the one before by at most one
   unit along each axis. Two sweeps of dynamic programming give the least cost through every state. A row of cells along
   the last axis takes each move side by side. Being at a cell is paid for when it is left; the end has a cost of its
   own. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "timed_field.h"

#define EXCESS 0.05f /* share by which the cheapest way may cost more than what lies ahead says, at first */
#define DOUBLINGS 8 /* of it; then any way is looked for */
#define BESIDE (DIM == 3 ? 27 : 9) /* moves that one may follow */

/* Of each move the cells beside its parts. */
static void look_between(Sweep *w) {
    const Timed *t = w->t;
    for (int64_t m = 0; m < w->moves; m++)
        for (int64_t s = 1; s < t->parts; s++) {
            Between *b = w->between + m * (t->parts - 1) + s - 1;
            b->count = 0;
            for (int corner = 0; corner < CORNERS; corner++) {
                float share = 1.0f;
                int64_t offset = 0;
                for (int a = 0; a < DIM; a++) {
                    int64_t n = s * w->move[m * DIM + a], whole = (n - ((n % t->parts) + t->parts) % t->parts) / t->parts;
                    float part = (float)(n - whole * t->parts) / (float)t->parts;
                    int up = corner >> a & 1;
                    share *= up ? part : 1.0f - part, offset += (whole + up) * w->step[a];
                }
                if (share > 0.0f) b->offset[b->count] = offset, b->share[b->count++] = share;
            }
        }
}

/* The least of what is at most one unit away along each axis, with the cost of the change, of `count` cells side by
   side; `row` (moves, count) is lost. */
static float *changed(const Sweep *w, float *row, float *other, int64_t count) {
    for (int a = 0; a < DIM; a++) {
        int64_t n = w->t->moves[a], step = w->turn[a] * count;
        float more = w->t->change[a];
        for (int64_t o = 0; o < w->moves * count; o += n * step)
            for (int64_t k = 0; k < n; k++) {
                const float *mid = row + o + k * step, *low = k > 0 ? mid - step : mid, *high = k + 1 < n ? mid + step : mid;
                float *out = other + o + k * step;
                for (int64_t j = 0; j < step; j++) out[j] = lower(mid[j], lower(low[j], high[j]) + more);
            }
        float *swap = row;
        row = other, other = swap;
    }
    return row;
}

/* What ending at a cell of a layer costs. */
static inline float end_of(const Sweep *w, int64_t l, int64_t c) {
    return l < w->t->earliest ? FAR : w->t->end_cost[(l - w->t->earliest) * w->cells + c];
}

/* Of what moves cost the share of each axis: at least what the units along it make of it. */
static void divide(const Sweep *w) {
    const Timed *t = w->t;
    float *left = w->row;
    for (int64_t m = 0; m < w->moves; m++) left[m] = t->move_cost[m];
    for (int a = 0; a < DIM; a++) {
        float *own = w->along + a * w->moves;
        for (int64_t k = 0; k < t->moves[a]; k++) own[k] = FAR;
        for (int64_t m = 0; m < w->moves; m++) {
            float *least = own + m / w->turn[a] % t->moves[a];
            *least = lower(*least, left[m]);
        }
        for (int64_t m = 0; m < w->moves; m++)
            left[m] = left[m] >= FAR ? FAR : left[m] - own[m / w->turn[a] % t->moves[a]];
    }
}

/* The least of `row` (cells) within the moves along an axis, with what these cost at least. */
static void reached(const Sweep *w, int a, const float *row, float *to) {
    int64_t n = w->t->counts[a], step = w->step[a], low = w->t->least[a], high = low + w->t->moves[a] - 1;
    for (int64_t c = 0; c < w->cells; c++) to[c] = FAR;
    for (int64_t o = 0; o < w->cells; o += n * step)
        for (int64_t k = low; k <= high; k++) {
            int64_t first = k < 0 ? -k : 0, end = k > 0 ? n - k : n;
            float cost = w->along[a * w->moves + k - low];
            for (int64_t j = o + first * step; j < o + end * step; j++) to[j] = lower(to[j], row[j + k * step] + cost);
        }
}

/* What any way costs at least from each layer and cell on, by cells and moves alone; FAR where nobody may be. */
static void look_ahead(const Sweep *w, float *scratch) {
    const Timed *t = w->t;
    float last = FAR, margin = (float)t->margin;
    for (int64_t m = 0; m < w->moves; m++) last = lower(t->last_cost[m], last);
    divide(w);
    for (int64_t l = t->layers; l >= 0; l--) {
        const float *gap = t->clearance + l * t->parts * w->cells, *cost = t->cell_cost + l * w->cells;
        float *own = w->ahead + l * w->cells, *from = own + w->cells, *to = scratch;
        for (int64_t c = 0; c < w->cells; c++) own[c] = FAR;
        if (l < t->layers) {
            for (int a = 0; a < DIM; a++) {
                reached(w, a, from, to);
                from = to, to = a % 2 ? scratch : scratch + w->cells;
            }
            for (int64_t c = 0; c < w->cells; c++) own[c] = lower(from[c] + cost[c], FAR);
        }
        for (int64_t c = 0; c < w->cells; c++) {
            int barred = (l > 0 && gap[c] < margin) || (l < t->layers && cost[c] >= FAR); /* a start may be near */
            own[c] = barred ? FAR : lower(own[c], end_of(w, l, c) + last);
            if (w->toll && l > 0 && own[c] < FAR) own[c] += w->toll[l * t->parts * w->cells + c];
        }
    }
}

/* Between which cells of each row of the next layer moves may lead. */
static void spread(const Sweep *w, int64_t l) {
    const Timed *t = w->t;
    int32_t *from = w->from + l * w->rows, *to = w->to + l * w->rows, width = (int32_t)w->width;
    ROWS(w) from[w->rows + r] = width, to[w->rows + r] = 0;
    ROWS(w) {
        if (from[r] >= to[r]) continue;
        int64_t at[DIM];
        cell_of(w, r * w->width, at);
        for (int64_t m = 0; m < w->moves; m += w->last) {
            int32_t d[DIM];
            memcpy(d, w->move + m * DIM, sizeof d);
            d[DIM - 1] = 0;
            int64_t cell = moved(w, at, r * w->width, d);
            if (cell < 0) continue;
            int32_t *low = from + w->rows + cell / w->width, *high = to + w->rows + cell / w->width;
            int32_t first = from[r] + (int32_t)t->least[DIM - 1], end = to[r] + (int32_t)(t->least[DIM - 1] + w->last) - 1;
            first = first < 0 ? 0 : first, end = end > width ? width : end;
            *low = first < *low ? first : *low, *high = end > *high ? end : *high;
        }
    }
}

/* Leave out the cells at both ends of the rows of a layer that no way within the limit leads through. */
static void trim(const Sweep *w, int64_t l, int is_known) {
    int32_t *from = w->from + l * w->rows, *to = w->to + l * w->rows;
    ROWS(w) {
        const float *ahead = w->ahead + l * w->cells + r * w->width, *least = w->least + l * w->cells + r * w->width;
#define SERVES(j) (ahead[j] < FAR && (!is_known || (least[j] < FAR && ahead[j] + least[j] <= w->limit)))
        while (from[r] < to[r] && !SERVES(from[r])) from[r]++;
        while (from[r] < to[r] && !SERVES(to[r] - 1)) to[r]--;
    }
}

/* The least clearance of a move on its way from cells `begin` to `end` of a row at a layer, into w->gap. */
static void pass(const Sweep *w, int64_t l, int64_t m, int64_t begin, int64_t end) {
    const Timed *t = w->t;
    float *gap = w->gap, *sum = w->gap + w->width, *paid = w->paid;
    for (int64_t j = 0; j < end - begin; j++) gap[j] = FAR, paid[j] = 0.0f;
    for (int64_t s = 1; s < t->parts; s++) {
        const Between *b = w->between + m * (t->parts - 1) + s - 1;
        const float *field = t->clearance + (l * t->parts + s) * w->cells + begin;
        for (int64_t j = 0; j < end - begin; j++) sum[j] = 0.0f;
        for (int64_t i = 0; i < b->count; i++) {
            const float *beside = field + b->offset[i];
            float share = b->share[i];
            for (int64_t j = 0; j < end - begin; j++) sum[j] += share * beside[j];
        }
        for (int64_t j = 0; j < end - begin; j++) gap[j] = lower(gap[j], sum[j]);
        for (int64_t i = 0; w->toll && i < b->count; i++) {
            const float *beside = w->toll + (l * t->parts + s) * w->cells + begin + b->offset[i];
            float share = b->share[i];
            for (int64_t j = 0; j < end - begin; j++) paid[j] += share * beside[j];
        }
    }
}

/* The cells of a row from which a move leads between those of the next layer that are looked at; returns the first of
   these in the row, and by `begin` and `end` from which; an empty range where there is none. */
static int64_t led(const Sweep *w, int64_t l, int64_t r, int64_t m, int64_t *begin, int64_t *end) {
    int64_t at[DIM], d = w->move[m * DIM + DIM - 1];
    int32_t flat[DIM];
    memcpy(flat, w->move + m * DIM, sizeof flat);
    flat[DIM - 1] = 0;
    cell_of(w, r * w->width, at);
    int64_t cell = moved(w, at, r * w->width, flat);
    *begin = *end = 0;
    if (cell < 0) return 0;
    int64_t next = (l + 1) * w->rows + cell / w->width, own = l * w->rows + r;
    int64_t first = w->from[next] - d, last = w->to[next] - d;
    *begin = first > w->from[own] ? first : w->from[own], *end = last < w->to[own] ? last : w->to[own];
    return cell + d;
}

/* The states of the next layer to which a row of cells leads. */
static void lead(const Sweep *w, int64_t l, int64_t r) {
    const Timed *t = w->t;
    int64_t first = w->from[l * w->rows + r], count = w->to[l * w->rows + r] - first, M = w->moves;
    float margin = (float)t->margin;
    for (int64_t m = 0; m < M; m++)
        memcpy(w->row + m * count, w->there + (l * M + m) * w->cells + r * w->width + first, sizeof(float) * (size_t)count);
    const float *cost = changed(w, w->row, w->wide, count), *stay = t->cell_cost + l * w->cells + r * w->width;
    for (int64_t m = 0; m < M; m++) {
        if (t->move_cost[m] >= FAR) continue;
        int64_t begin, end, cell = led(w, l, r, m, &begin, &end);
        const float *so_far = cost + m * count - first;
        float best = FAR;
        for (int64_t j = begin; j < end; j++) best = lower(best, so_far[j]);
        if (best >= FAR) continue;
        pass(w, l, m, r * w->width + begin, r * w->width + end);
        const float *gap = w->gap, *paid = w->paid - begin, *ahead = w->ahead + (l + 1) * w->cells + cell;
        const float *toll = w->toll ? w->toll + (l + 1) * t->parts * w->cells + cell : NULL;
        if (toll)
            for (int64_t j = begin; j < end; j++) w->paid[j - begin] += toll[j];
        float *to = w->there + ((l + 1) * M + m) * w->cells + cell, *least = w->least + (l + 1) * w->cells + cell;
        for (int64_t j = begin; j < end; j++) {
            float v = so_far[j] + stay[j] + t->move_cost[m] + paid[j];
            v = gap[j - begin] < margin || ahead[j] >= FAR || v >= FAR ? FAR : v;
            to[j] = v, least[j] = lower(least[j], v);
        }
    }
}

/* The cheapest ways to all states that one of no more than `limit` may lead through; returns what the cheapest to the
   end costs. */
static float sweep_there(Sweep *w, float limit) {
    const Timed *t = w->t;
    int64_t M = w->moves, C = w->cells;
    float best = FAR;
    for (int64_t i = 0; i < (t->layers + 1) * C; i++) w->least[i] = FAR;
    ROWS(w) w->from[r] = w->to[r] = 0;
    int64_t row = t->start / w->width, at = t->start % w->width;
    w->from[row] = (int32_t)at, w->to[row] = (int32_t)at + 1;
    for (int64_t m = 0; m < M; m++) w->there[m * C + t->start] = FAR;
    w->there[t->first * C + t->start] = w->least[t->start] = 0.0f;
    for (int64_t l = 0; l <= t->layers; l++) {
        trim(w, l, 0);
        ROWS(w) for (int64_t c = r * w->width + w->from[l * w->rows + r]; c < r * w->width + w->to[l * w->rows + r]; c++) {
            float end = end_of(w, l, c);
            for (int64_t m = 0; end < FAR && w->ahead[l * C + c] < FAR && m < M; m++) {
                float cost = w->there[(l * M + m) * C + c] + end + t->last_cost[m];
                if (cost < best) best = cost, w->end[0] = l, w->end[1] = c, w->end[2] = m;
            }
        }
        if (l == t->layers) break;
        spread(w, l);
        trim(w, l + 1, 0);
        for (int64_t m = 0; m < M; m++) ROWS(w) {
            int64_t next = (l + 1) * w->rows + r;
            float *to = w->there + ((l + 1) * M + m) * C + r * w->width;
            for (int64_t j = w->from[next]; j < w->to[next]; j++) to[j] = FAR;
        }
        ROWS(w) if (w->from[l * w->rows + r] < w->to[l * w->rows + r]) lead(w, l, r);
        /* What no way has led to is left out, and what one that has ended undercuts. */
        w->limit = best < FAR && t->earliest < t->layers ? lower(limit, best + (float)t->dearer * fabsf(best)) : limit;
        trim(w, l + 1, 1);
    }
    return best;
}

/* The cheapest ways on from a row of cells, and through it. */
static void go_on(const Sweep *w, int64_t l, int64_t r, float *through) {
    const Timed *t = w->t;
    int64_t first = w->from[l * w->rows + r], count = w->to[l * w->rows + r] - first, M = w->moves, C = w->cells;
    for (int64_t i = 0; i < M * count; i++) w->row[i] = FAR;
    for (int64_t m = 0; m < M && l < t->layers; m++) {
        int64_t begin, end, cell = led(w, l, r, m, &begin, &end);
        const float *there = w->there + ((l + 1) * M + m) * C + cell, *ahead = w->onward + ((l + 1) * M + m) * C + cell;
        float *own = w->row + m * count - first, cost = t->move_cost[m];
        for (int64_t j = begin; j < end; j++) own[j] = there[j] < FAR ? lower(cost + ahead[j], FAR) : FAR;
    }
    const float *best = changed(w, w->row, w->wide, count), *stay = t->cell_cost + l * C + r * w->width + first;
    float *least = through + l * C + r * w->width + first;
    for (int64_t m = 0; m < M; m++) {
        const float *there = w->there + (l * M + m) * C + r * w->width + first;
        float *to = w->onward + (l * M + m) * C + r * w->width + first;
        for (int64_t j = 0; j < count; j++) {
            float end = l < t->earliest ? FAR : end_of(w, l, r * w->width + first + j) + t->last_cost[m];
            to[j] = lower(end, l < t->layers ? best[m * count + j] + stay[j] : FAR);
            least[j] = lower(least[j], there[j] + to[j]);
        }
    }
}

/* The cheapest ways on from all states that a way within the limit may lead through. */
static void sweep_onward(Sweep *w, float *through) {
    for (int64_t l = w->t->layers; l >= 0; l--) {
        trim(w, l, 1);
        for (int64_t c = 0; c < w->cells; c++) through[l * w->cells + c] = FAR;
        ROWS(w) if (w->from[l * w->rows + r] < w->to[l * w->rows + r]) go_on(w, l, r, through);
    }
}

/* Whether a cell of a layer is one that is looked at. */
static int is_within(const Sweep *w, int64_t l, int64_t c) {
    int64_t row = l * w->rows + c / w->width, at = c % w->width;
    return at >= w->from[row] && at < w->to[row];
}

/* What a state costs, and how it goes on; FAR where it isn't looked at. */
static float state(const Sweep *w, const float *costs, int64_t l, int64_t m, int64_t c) {
    return is_within(w, l, c) ? costs[(l * w->moves + m) * w->cells + c] : FAR;
}

/* The i-th of the 3^DIM moves at most one unit per axis from `m`, and what the change costs; -1: there is none. */
static int64_t beside(const Sweep *w, int64_t m, int64_t i, float *change) {
    int64_t found = m;
    *change = 0.0f;
    for (int a = DIM - 1; a >= 0; a--, i /= 3) {
        int64_t more = i % 3 - 1, at = w->move[m * DIM + a] - w->t->least[a] + more;
        if (at < 0 || at >= w->t->moves[a]) return -1;
        found += more * w->turn[a], *change += more ? w->t->change[a] : 0.0f;
    }
    return found;
}

/* The cells of the cheapest way to a state, up to its layer; 0 where there is none. */
static int trace_back(const Sweep *w, int64_t layer, int64_t cell, int64_t move, int32_t *way) {
    way[layer] = (int32_t)cell;
    for (int64_t l = layer; l > 0; l--) {
        int64_t before = -1;
        float least = FAR, change;
        for (int a = 0; a < DIM; a++) cell -= w->move[move * DIM + a] * w->step[a];
        way[l - 1] = (int32_t)cell;
        for (int64_t i = 0; i < BESIDE; i++) {
            int64_t k = beside(w, move, i, &change);
            float cost = k < 0 ? FAR : state(w, w->there, l - 1, k, cell) + change;
            if (cost < least) least = cost, before = k;
        }
        if (before < 0) return 0;
        move = before;
    }
    return 1;
}

/* The cells of the cheapest way through a cell at a layer, and the layer at which it ends; 0 where there is none. */
static int trace(const Sweep *w, int64_t layer, int64_t cell, int32_t *way, int32_t *end) {
    const Timed *t = w->t;
    int64_t m = 0, at[DIM];
    float least = FAR, change;
    for (int64_t k = 0; k < w->moves; k++) {
        float cost = state(w, w->there, layer, k, cell) + state(w, w->onward, layer, k, cell);
        if (cost < least) least = cost, m = k;
    }
    if (least >= FAR) return 0;
    if (!trace_back(w, layer, cell, m, way)) return 0;
    for (int64_t l = layer; l <= t->layers; l++) {
        int64_t to = -1, next = -1;
        least = end_of(w, l, cell) + t->last_cost[m], cell_of(w, cell, at);
        for (int64_t i = 0; l < t->layers && i < BESIDE; i++) {
            int64_t k = beside(w, m, i, &change), then = k < 0 ? -1 : moved(w, at, cell, w->move + k * DIM);
            if (then < 0 || state(w, w->there, l + 1, k, then) >= FAR) continue;
            float cost = state(w, w->onward, l + 1, k, then) + t->move_cost[k] + change + t->cell_cost[l * w->cells + cell];
            if (cost < least) least = cost, next = k, to = then;
        }
        *end = (int32_t)l;
        if (next < 0) break;
        way[l + 1] = (int32_t)to, m = next, cell = to;
    }
    return least < FAR;
}

/* Whether the segment between two ways is clear at all times, until one ends: one becomes the other without passing an
   obstacle. */
static int is_same(const Sweep *w, const int32_t *a, const int32_t *b, int64_t layers) {
    const Timed *t = w->t;
    for (int64_t l = 0; l < layers; l++) {
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

static void classes(const Sweep *w, Timed *t, const float *through, Least *found) {
    int64_t count = local_minima(w, through, found), line = t->layers + 1;
    qsort(found, (size_t)count, sizeof(Least), cheaper);
    for (int64_t i = 0; i < count && i < t->tries && t->found < t->most; i++) {
        int32_t *way = t->way + t->found * line, *end = t->end + t->found;
        int is_new = trace(w, found[i].layer, found[i].cell, way, end);
        for (int64_t k = 0; k < t->found && is_new; k++)
            is_new = !is_same(w, t->way + k * line, way, t->end[k] < *end ? t->end[k] : *end);
        if (is_new) t->cost[t->found++] = found[i].cost;
    }
}

/* The cheapest way alone: it seldom costs much more than what lies ahead says, so few states are looked at. */
static void cheapest(Sweep *w, Timed *t) {
    float least = w->ahead[t->start], best = FAR, more = EXCESS;
    for (int i = 0; i < DOUBLINGS && best >= FAR && least < FAR; i++, more *= 2.0f) {
        float limit = i + 1 < DOUBLINGS ? least + more * fabsf(least) : FAR;
        best = sweep_there(w, limit);
        if (best > limit) best = FAR;
    }
    if (best >= FAR || !trace_back(w, w->end[0], w->end[1], w->end[2], t->way)) return;
    *t->end = (int32_t)w->end[0], *t->cost = best, t->found = 1;
}

static void search(Timed *t, Sweep *w, float *through, float *scratch, Least *found) {
    t->found = 0;
    measure(w, scratch);
    look_between(w);
    if (w->toll) ask_tolls(w);
    look_ahead(w, scratch);
    if (t->most == 1 && !t->through) {
        cheapest(w, t);
        return;
    }
    float best = sweep_there(w, FAR);
    if (best >= FAR) {
        for (int64_t i = 0; i < (t->layers + 1) * w->cells; i++) through[i] = FAR;
        return;
    }
    w->limit = best + (float)t->dearer * fabsf(best);
    sweep_onward(w, through);
    classes(w, t, through, found);
}

/* One problem; 0 where there is no memory. */
static int solve(Timed *t) {
    Sweep w = {.t = t, .cells = 1, .moves = 1};
    for (int a = DIM - 1; a >= 0; a--) {
        w.step[a] = w.cells, w.cells *= t->counts[a];
        w.turn[a] = w.moves, w.moves *= t->moves[a];
    }
    w.width = t->counts[DIM - 1], w.rows = w.cells / w.width, w.last = t->moves[DIM - 1];
    size_t layers = (size_t)t->layers + 1, C = (size_t)w.cells, M = (size_t)w.moves, lines = layers * (size_t)w.rows;
    size_t wide = M * (size_t)w.width;
    int32_t *whole = malloc(sizeof(int32_t) * (M * DIM + 2 * lines));
    int one = t->most == 1 && !t->through;
    float *numbers = malloc(sizeof(float) * (3 * layers * C + 2 * C + 2 * wide + 3 * (size_t)w.width + DIM * M));
    w.toll = t->others ? malloc(sizeof(float) * ((size_t)(t->layers * t->parts) + 1) * C) : NULL;
    w.there = malloc(sizeof(float) * layers * C * M), w.onward = malloc(one ? 1 : sizeof(float) * layers * C * M);
    w.between = malloc(sizeof(Between) * M * (size_t)t->parts);
    Least *found = malloc(sizeof(Least) * layers * C);
    int done = whole && numbers && (w.toll || !t->others) && w.there && w.onward && w.between && found;
    if (done) {
        float *through = numbers + 2 * layers * C, *scratch = numbers + 3 * layers * C;
        w.ahead = numbers, w.least = numbers + layers * C, w.row = scratch + 2 * C, w.wide = w.row + wide;
        w.gap = w.wide + wide, w.paid = w.gap + 2 * w.width, w.along = w.paid + w.width;
        w.move = whole, w.from = whole + M * DIM, w.to = w.from + lines;
        for (int64_t m = 0; m < w.moves; m++)
            for (int a = 0; a < DIM; a++)
                w.move[m * DIM + a] = (int32_t)(t->least[a] + m / w.turn[a] % t->moves[a]);
        search(t, &w, t->through ? t->through : through, scratch, found);
    }
    free(whole), free(numbers), free(w.toll), free(w.there), free(w.onward), free(w.between), free(found);
    return done;
}

/* Problems `begin` to `end` of those at `all`, each by itself; 0 where there is no memory. */
int tgco_timed(Timed *all, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; b++)
        if (!solve(all + b)) return 0;
    return 1;
}
