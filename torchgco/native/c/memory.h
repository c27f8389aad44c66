/* Lanes: their memory, and problems that enter and leave them. */
#pragma once
#include "allocation.h"

static int64_t length(const Array *a, int64_t knots) { return a->data ? (a->knot ? knots : 1) * a->size : 0; }

static void fill(OUT to, const Array *from, int64_t knots, int lane, int64_t element) {
    if (!from->data || ADDRESS(to) == from->data) return;
    const double *source = from->data + element * from->element;
    int64_t count = from->knot ? knots : 1;
    for (int64_t k = 0; k < count; k++)
        for (int64_t i = 0; i < from->size; i++) LANE(to[k * from->size + i], lane) = source[k * from->knot + i];
}

/* Where the numbers of problem e are. */
static inline int64_t numbers_of(const Problem *p, int64_t e) { return p->numbers ? p->numbers[e] : e; }

/* The same of one knot. */
static void fill_stage(OUT to, const Array *from, int64_t k, int lane, int64_t element) {
    for (int64_t i = 0; i < from->size; i++) LANE(to[i], lane) = from->data[element * from->element + k * from->knot + i];
}

/* Memory that is laid out; without any, it is counted how much that takes. */
typedef struct { Numbers memory; int64_t used; } Cut;
static Numbers cut(Cut *from, int64_t count) {
    Numbers part = from->memory ? from->memory + from->used : 0;
    from->used += count;
    return part;
}

/* Numbers that whoever calls has: of a single problem, an exported solver has them there alone. */
static Numbers cut_at(Cut *from, const Problem *p, const double *data, int64_t count) {
    return p->arena && data ? IN_PLACE(data) : cut(from, count);
}

static Numbers cut_array(Cut *from, const Problem *p, const Array *a, int64_t knots) {
    return cut_at(from, p, a->data, length(a, knots));
}

static int64_t lay_out(Lanes *s, Numbers memory) {
    const Problem *p = s->of;
    int64_t N = p->N;
    Cut m = {memory, 0};
    s->X = cut_at(&m, p, p->X, (N + 1) * NX); s->U = cut_at(&m, p, p->U, N * NU);
    if (!s->of_barrier) { s->Xn = cut(&m, (N + 1) * NX); s->Un = cut(&m, N * NU); }
    s->G = cut_at(&m, p, p->gains, N * NU * NZ);
    s->parameters = cut_array(&m, p, &p->parameters, N);
    for (int i = 0; i < COST_ARRAYS; i++) s->cost_data[i] = cut_array(&m, p, p->cost_data + i, N);
    s->center = cut_array(&m, p, &p->center, N + 1); s->radius = cut_array(&m, p, &p->radius, N + 1);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        Rows rows = {0};
        if (!s->of_barrier) { rows.lam = cut(&m, c->knots * c->rows); rows.pushed = (Truths)cut(&m, c->knots); }
        rows.bound = cut_array(&m, p, &c->bound, c->knots); rows.squares = cut_array(&m, p, &c->squares, 1);
        rows.velocities = cut_array(&m, p, &c->velocities, 1); rows.stops = cut_array(&m, p, &c->stops, 1);
        rows.radii = cut_array(&m, p, &c->radii, c->knots); rows.lift = cut_array(&m, p, &c->lift, c->knots);
        if (c->balls > 0) {
            rows.widest = cut(&m, c->squares.size / c->balls);
            rows.near = (Places)cut(&m, c->rows / c->balls);
        }
        for (int l = 0; l < LANES; l++) rows.map[l] = c->map;
        if (memory) s->rows[i] = rows;
    }
    return m.used;
}

static void finish(Lanes *s) { give(s->of, s->rows); give(s->of, s->memory); }

static int take_lanes(Lanes *s) {
    const Problem *p = s->of;
    int64_t count = lay_out(s, 0);
    s->memory = take_numbers(p, count + 1);
    s->rows = (Rows *)take(p, (p->constraints + 1) * sizeof(Rows));
    if (!s->memory || !s->rows) { finish(s); return 0; }
    lay_out(s, s->memory);
    return 1;
}

static int start(Lanes *s, const Problem *p) {
    memset(s, 0, sizeof *s);
    s->of = p;
    return take_lanes(s);
}

/* Find the largest radii of a body's spheres in a lane. */
static void widen(const Rows *rows, const Constraint *c, int lane) {
    int64_t each = c->squares.size / c->balls;
    for (int64_t j = 0; j < each; j++) {
        double square = ABSENT;
        for (int64_t b = 0; b < c->balls; b++)
            if (LANE(rows->squares[b * each + j], lane) > square) square = LANE(rows->squares[b * each + j], lane);
        LANE(rows->widest[j], lane) = square < 0 ? ABSENT : sqrt(square);
    }
}

/* Load problem e into a lane: first state, model, cost, and the numbers of its constraints. */
TGCO_LARGE void enter_problem(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    s->element[lane] = e;
    for (int i = 0; i < NX; i++) LANE(s->X[i], lane) = p->X[e * (N + 1) * NX + i];
    e = numbers_of(p, e);
    fill(s->parameters, &p->parameters, N, lane, e);
    for (int i = 0; i < COST_ARRAYS; i++) fill(s->cost_data[i], p->cost_data + i, N, lane, e);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        fill(s->rows[i].bound, &c->bound, c->knots, lane, e);
        fill(s->rows[i].squares, &c->squares, 1, lane, e);
        if (c->balls > 0) widen(s->rows + i, c, lane);
        fill(s->rows[i].velocities, &c->velocities, 1, lane, e);
        fill(s->rows[i].stops, &c->stops, 1, lane, e);
        fill(s->rows[i].radii, &c->radii, c->knots, lane, e);
        fill(s->rows[i].lift, &c->lift, c->knots, lane, e);
        if (c->map) s->rows[i].map[lane] = c->map + c->map_of[e] * c->map_x * c->map_y * c->map_z;
    }
}

/* Load problem e with its iterate. */
TGCO_LARGE void enter_iterate(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    enter_problem(s, lane, e);
    for (int64_t i = 0; i < (N + 1) * NX; i++) LANE(s->X[i], lane) = p->X[e * (N + 1) * NX + i];
    for (int64_t i = 0; i < N * NU; i++) LANE(s->U[i], lane) = p->U[e * N * NU + i];
}

/* Load problem e with its iterate, multipliers and guide. */
TGCO_LARGE void enter(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    enter_iterate(s, lane, e);
    fill(s->center, &p->center, N + 1, lane, e); fill(s->radius, &p->radius, N + 1, lane, e);
    if (p->guide != NO_GUIDE) LANE(s->weight, lane) = p->weight.data[e * p->weight.element];
    double squares = 0;
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        if (!c->lam) continue; /* `start` has set them to 0, and only an outer loop changes them, which has some */
        const double *lam = c->lam + e * c->knots * c->rows;
        for (int64_t k = 0; k < c->knots; k++, lam += c->rows) {
            int pushed = 0;
            for (int j = 0; j < c->rows; j++) pushed |= lam[j] != 0;
            if (!pushed && !LANE(s->rows[i].pushed[k], lane)) continue; /* as at most knots, where the lane's are 0, too */
            for (int j = 0; j < c->rows; j++) {
                LANE(s->rows[i].lam[k * c->rows + j], lane) = lam[j];
                if (lam[j] != 0) squares += lam[j] * lam[j];
            }
            LANE(s->rows[i].pushed[k], lane) = -pushed;
        }
    }
    LANE(s->mu, lane) = p->mu[e]; LANE(s->inverse_mu, lane) = 1 / p->mu[e];
    LANE(s->floor, lane) = squares > 0 ? 0.5 * squares / p->mu[e] : 0;
    LANE(s->mu_r, lane) = p->regularisation ? p->regularisation[e] : 0;
    LANE(s->merit, lane) = p->merit[e]; LANE(s->cost, lane) = p->cost[e];
    LANE(s->inner, lane) = p->inner ? p->inner[e] : 0; LANE(s->made, lane) = 0; s->rung[lane] = p->rung ? p->rung[e] : 0;
}

TGCO_LARGE void leave(const Lanes *s, int lane, int32_t status, int32_t converged, int32_t refused, int32_t lost) {
    const Problem *p = s->of;
    int64_t N = p->N, e = s->element[lane];
    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = LANE(s->X[i], lane);
    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = LANE(s->U[i], lane);
    p->cost[e] = LANE(s->cost, lane); p->merit[e] = LANE(s->merit, lane); p->regularisation[e] = LANE(s->mu_r, lane);
    p->iterations[e] += (int64_t)LANE(s->made, lane); p->inner[e] = (int64_t)LANE(s->inner, lane); p->rung[e] = s->rung[lane];
    p->alpha[e] = LANE(s->alpha, lane); p->used[e] = LANE(s->used, lane);
    p->status[e] = status; p->converged[e] = converged; p->refused[e] = refused; p->lost[e] = lost;
}

/* Loads the problems first, ..., last - 1, and puts what is asked of them: of e and those after it, in the first `used`
   lanes. Returns 0 without memory. */
typedef void Enter(Lanes *s, int lane, int64_t e);
typedef void Put(Lanes *s, int64_t e, int used);

static int put_all(const Problem *p, int64_t first, int64_t last, CALLABLE(Enter) load, CALLABLE(Put) put) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) load(s, l, e + l < last ? e + l : e);
        put(s, e, last - e < LANES ? (int)(last - e) : LANES);
    }
    finish(s);
    return 1;
}
