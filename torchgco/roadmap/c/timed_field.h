/* What a sweep through space and time keeps, and what is in its way: distances from solids, and tolls among others that
   may be met (timed.c). */
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>
#include "timed.h"

#define CORNERS (1 << DIM)
#define ROWS(x) for (int64_t r = 0; r < (x)->rows; r++)

/* Where a move is at a part of it, between cells: how far these lie from the cell that it leaves, and their shares. */
typedef struct { int64_t offset[CORNERS]; float share[CORNERS]; int64_t count; } Between;

typedef struct {
    const Timed *t;
    int64_t cells, moves, rows, width, last; /* width: cells of a row; last: moves along it */
    int64_t step[DIM], turn[DIM]; /* strides of cells and of moves */
    int32_t *move; /* (moves, DIM) */
    Between *between; /* (moves, parts - 1) */
    float *ahead; /* (layers + 1, cells): no more than what any way costs from there on, without the changes of moves */
    float *least; /* (layers + 1, cells): of the cheapest way there */
    float *there, *onward; /* (layers + 1, moves, cells): the cheapest way to each state, and from it to the end */
    int32_t *from, *to; /* (layers + 1, rows): between these cells of a row any way leads there */
    float *row, *wide, *gap, *paid; /* (moves, width), (moves, width), (2 width), (width): scratch */
    float *toll; /* (layers parts + 1, cells): what being there among others costs; NULL: there are none */
    float *along; /* (DIM, most moves): of a unit's share in what a move costs, at least */
    float limit; /* what a way may cost */
    int64_t end[3]; /* layer, cell and move at which the cheapest way ends */
} Sweep;

static inline float lower(float a, float b) { return a < b ? a : b; }

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
    for (int corner = 0; corner < CORNERS; corner++) {
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
static int64_t moved(const Sweep *w, const int64_t *at, int64_t cell, const int32_t *d) {
    for (int a = 0; a < DIM; a++) {
        if ((uint64_t)(at[a] + d[a]) >= (uint64_t)w->t->counts[a]) return -1;
        cell += d[a] * w->step[a];
    }
    return cell;
}

/* Lower the distances of a row of cells to those from one solid; `v` leads there from its centre, at the first cell. */
static void lowered(const Timed *t, int64_t i, float radius, float *row, int64_t count, const float *v) {
    const float *half = t->half + i * DIM, *axes = t->axes + i * DIM * DIM;
    float h = (float)t->spacing, begin[DIM], along[DIM], square = 0.0f, size = 0.0f;
    for (int k = 0; k < DIM; k++) {
        begin[k] = 0.0f, along[k] = h * axes[k * DIM + DIM - 1], size += half[k];
        for (int a = 0; a < DIM; a++) begin[k] += axes[k * DIM + a] * v[a];
        if (k < DIM - 1) square += v[k] * v[k];
    }
    if (size == 0.0f) {
        for (int64_t j = 0; j < count; j++) {
            float x = v[DIM - 1] + h * (float)j, away = sqrtf(square + x * x) - radius;
            row[j] = away < row[j] ? away : row[j];
        }
        return;
    }
    for (int64_t j = 0; j < count; j++) {
        float deepest = -FAR, sum = 0.0f;
        for (int k = 0; k < DIM; k++) {
            float q = fabsf(begin[k] + along[k] * (float)j) - half[k], out = q > 0.0f ? q : 0.0f;
            deepest = q > deepest ? q : deepest, sum += out * out;
        }
        float away = (deepest > 0.0f ? sqrtf(sum) : deepest) - radius;
        row[j] = away < row[j] ? away : row[j];
    }
}

/* The cells within `reach` of a centre along each axis; 0 where there are none. */
static int is_window(const Timed *t, const float *center, const double *reach, int64_t *low, int64_t *high) {
    for (int a = 0; a < DIM; a++) {
        double first = ceil((center[a] - reach[a]) / t->spacing), last = floor((center[a] + reach[a]) / t->spacing);
        if (!(first < (double)t->counts[a]) || !(last >= 0.0)) return 0;
        low[a] = first > 0.0 ? (int64_t)first : 0;
        high[a] = last < (double)t->counts[a] - 1.0 ? (int64_t)last : t->counts[a] - 1;
    }
    return 1;
}

/* The first cell of the row at `at`, and the way there from a centre. */
static int64_t row_of(const Sweep *w, const int64_t *at, const float *center, float *v) {
    int64_t cell = 0;
    for (int a = 0; a < DIM; a++) cell += at[a] * w->step[a], v[a] = (float)at[a] * (float)w->t->spacing - center[a];
    return cell;
}

/* Whether there is a next row of a window; `at` is its first cell then. */
static int has_next(int64_t *at, const int64_t *low, const int64_t *high) {
    int a = DIM - 2;
    for (; a >= 0 && ++at[a] > high[a]; a--) at[a] = low[a];
    return a >= 0;
}

/* Lower the distances of all cells nearer than `far` to a solid at one time, k. */
static void lower_around(const Sweep *w, int64_t i, int64_t k, float far, float *field) {
    const Timed *t = w->t;
    const float *center = t->center + (k * t->solids + i) * DIM, radius = t->radius[k * t->solids + i];
    int64_t low[DIM], high[DIM], at[DIM];
    double reach[DIM];
    float v[DIM];
    for (int a = 0; a < DIM; a++) {
        reach[a] = far + radius;
        for (int s = 0; s < DIM; s++) reach[a] += fabsf(t->axes[(i * DIM + s) * DIM + a]) * t->half[i * DIM + s];
    }
    if (!is_window(t, center, reach, low, high)) return;
    memcpy(at, low, sizeof at);
    do {
        int64_t cell = row_of(w, at, center, v);
        lowered(t, i, radius, field + cell, high[DIM - 1] - low[DIM - 1] + 1, v);
    } while (has_next(at, low, high));
}

/* The clearance from the solids, too, no more than what matters: beyond it all cells beside are clear. */
static void measure(const Sweep *w, float *rest) {
    const Timed *t = w->t;
    float far = (float)(t->margin + t->spacing * sqrt(DIM));
    for (int64_t c = 0; c < w->cells; c++) rest[c] = far;
    for (int64_t i = 0; i < t->resting; i++) lower_around(w, i, 0, far, rest);
    for (int64_t k = 0; k <= t->layers * t->parts; k++) {
        float *field = t->clearance + k * w->cells;
        for (int64_t c = 0; c < w->cells; c++) field[c] = lower(field[c], rest[c]);
        for (int64_t i = t->resting; i < t->solids; i++) lower_around(w, i, k, far, field);
    }
}

/* What being at each cell costs at a part, among one that may be met: its price, by how deep. */
static void ask_toll(const Sweep *w, int64_t i, const float *center, float *toll) {
    const Timed *t = w->t;
    float far = t->reach[i], price = t->price[i] / (far * (float)t->parts), v[DIM];
    int64_t low[DIM], high[DIM], at[DIM];
    double reach[DIM];
    for (int a = 0; a < DIM; a++) reach[a] = far;
    if (!is_window(t, center, reach, low, high)) return;
    memcpy(at, low, sizeof at);
    do {
        float *row = toll + row_of(w, at, center, v), square = 0.0f;
        for (int a = 0; a < DIM - 1; a++) square += v[a] * v[a];
        for (int64_t j = 0; j <= high[DIM - 1] - low[DIM - 1]; j++) {
            float x = v[DIM - 1] + (float)t->spacing * (float)j, deep = far - sqrtf(square + x * x);
            row[j] += deep > 0.0f ? price * deep : 0.0f;
        }
    } while (has_next(at, low, high));
}

static void ask_tolls(const Sweep *w) {
    const Timed *t = w->t;
    for (int64_t k = 0; k <= t->layers * t->parts; k++) {
        float *toll = w->toll + k * w->cells;
        for (int64_t c = 0; c < w->cells; c++) toll[c] = 0.0f;
        for (int64_t i = 0; i < t->others; i++) ask_toll(w, i, t->other + (k * t->others + i) * DIM, toll);
    }
}
