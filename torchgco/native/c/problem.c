/* Problems side by side, one per lane of the vectors V; no operation mixes lanes.

   The generated part before this file declares the structures and enumerations of native/structures.py. It defines NX,
   NU, NP, NJ, DIM, POSITION, QUADRATIC_FULL, WITH_BOXES, WITH_FIELDS, COST_ARRAYS, MAX_ROWS, and

       tgco_step, tgco_jacobian                         the model
       tgco_gather(P, f, T), tgco_product(f, T, Q)      T = P F and Q = F' T (upper triangle) for its sparse F = [fx fu]
       tgco_pull_back(p, f, g)                          g = F' p
       tgco_rows(i, x, u, p, w, c), tgco_add_rows(i, ...)  traced constraints, with a knot's own numbers p, and w that
                                                        all problems share */

#include <stdlib.h>
#include <string.h>
#include <time.h>

#define S (NX + NU)
#define NZ (NX + 1)

/* A constraint's multipliers and numbers. */
typedef struct {
    V *lam, *bound, *squares, *velocities, *stops;
    I *pushed; /* (knots): whether any multiplier of the knot isn't zero */
    const float *map[LANES]; /* of a FIELD: each lane's map */
} Rows;

/* The working data of a group of lanes. */
typedef struct {
    const Problem *of;
    V *X, *U, *Xn, *Un, *G, *parameters, *cost_data[COST_ARRAYS], *center, *radius;
    Rows *rows;
    V weight, mu, inverse_mu, mu_r, merit, cost, inner, made, alpha, used;
    V floor; /* the constraints' terms add no less than minus this to L_M: lam^2 / (2 mu) for each row */
    int64_t element[LANES], rung[LANES]; /* at which the next line search begins */
    V *memory;
} Lanes;

static inline int any(I where) { return tgco_any(where); }
static inline I finite(V a) { return (a - a) == SET(0.0); }

/* Lanes ----------------------------------------------------------------------------------------------------------- */

static int64_t length(const Array *a, int64_t knots) { return a->data ? (a->knot ? knots : 1) * a->size : 0; }

static void fill(V *to, const Array *from, int64_t knots, int lane, int64_t element) {
    if (!from->data) return;
    const double *source = from->data + element * from->element;
    int64_t count = from->knot ? knots : 1;
    for (int64_t k = 0; k < count; k++)
        for (int64_t i = 0; i < from->size; i++) to[k * from->size + i][lane] = source[k * from->knot + i];
}

/* The same of one knot. */
static void fill_stage(V *to, const Array *from, int64_t k, int lane, int64_t element) {
    for (int64_t i = 0; i < from->size; i++) to[i][lane] = from->data[element * from->element + k * from->knot + i];
}

static inline const V *at(const V *array, const Array *shape, int64_t k) {
    return array + (shape->knot ? k * shape->size : 0);
}

/* Array i of the cost at knot k. */
static inline const V *cost_at(const Lanes *s, int i, int64_t k) {
    return at(s->cost_data[i], s->of->cost_data + i, k);
}

/* The model's own numbers at stage k. */
static inline const V *model_at(const Lanes *s, int64_t k) { return at(s->parameters, &s->of->parameters, k); }

static V *cut(V **memory, int64_t count) { V *part = *memory; *memory += count; return part; }

static int64_t lay_out(Lanes *s, V *memory) {
    const Problem *p = s->of;
    int64_t N = p->N;
    V *m = memory;
    s->X = cut(&m, (N + 1) * NX); s->U = cut(&m, N * NU); s->Xn = cut(&m, (N + 1) * NX); s->Un = cut(&m, N * NU);
    s->G = cut(&m, N * NU * NZ);
    s->parameters = cut(&m, length(&p->parameters, N));
    for (int i = 0; i < COST_ARRAYS; i++) s->cost_data[i] = cut(&m, length(p->cost_data + i, N));
    s->center = cut(&m, length(&p->center, N + 1)); s->radius = cut(&m, length(&p->radius, N + 1));
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        Rows rows = {0};
        rows.lam = cut(&m, c->knots * c->rows); rows.bound = cut(&m, length(&c->bound, c->knots));
        rows.squares = cut(&m, length(&c->squares, 1)); rows.velocities = cut(&m, length(&c->velocities, 1));
        rows.stops = cut(&m, length(&c->stops, 1));
        rows.pushed = (I *)cut(&m, c->knots);
        for (int l = 0; l < LANES; l++) rows.map[l] = c->map;
        if (memory) s->rows[i] = rows;
    }
    return m - memory;
}

static int start(Lanes *s, const Problem *p) {
    memset(s, 0, sizeof *s);
    s->of = p;
    int64_t count = lay_out(s, 0);
    s->memory = aligned_alloc(sizeof(V), (count + 1) * sizeof(V));
    s->rows = calloc(p->constraints + 1, sizeof(Rows));
    if (!s->memory || !s->rows) { free(s->memory); free(s->rows); return 0; }
    memset(s->memory, 0, (count + 1) * sizeof(V));
    lay_out(s, s->memory);
    return 1;
}

/* The numbers first, ..., last - 1 of problems, to be freed; NULL without memory. */
static int64_t *in_order(int64_t first, int64_t last) {
    int64_t *number = malloc((last - first + 1) * sizeof *number);
    for (int64_t i = 0; number && first + i < last; i++) number[i] = first + i;
    return number;
}

static void finish(Lanes *s) { free(s->memory); free(s->rows); }

/* Load problem e into a lane: first state, model, cost, and the numbers of its constraints. */
static void enter_problem(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    s->element[lane] = e;
    for (int i = 0; i < NX; i++) s->X[i][lane] = p->X[e * (N + 1) * NX + i];
    fill(s->parameters, &p->parameters, N, lane, e);
    for (int i = 0; i < COST_ARRAYS; i++) fill(s->cost_data[i], p->cost_data + i, N, lane, e);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        fill(s->rows[i].bound, &c->bound, c->knots, lane, e);
        fill(s->rows[i].squares, &c->squares, 1, lane, e);
        fill(s->rows[i].velocities, &c->velocities, 1, lane, e);
        fill(s->rows[i].stops, &c->stops, 1, lane, e);
        if (c->map) s->rows[i].map[lane] = c->map + c->map_of[e] * c->map_x * c->map_y * c->map_z;
    }
}

/* Load problem e with its iterate. */
static void enter_iterate(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    enter_problem(s, lane, e);
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->X[i][lane] = p->X[e * (N + 1) * NX + i];
    for (int64_t i = 0; i < N * NU; i++) s->U[i][lane] = p->U[e * N * NU + i];
}

/* Load problem e with its iterate, multipliers and guide. */
static void enter(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    enter_iterate(s, lane, e);
    fill(s->center, &p->center, N + 1, lane, e); fill(s->radius, &p->radius, N + 1, lane, e);
    if (p->guide != NO_GUIDE) s->weight[lane] = p->weight.data[e * p->weight.element];
    double squares = 0;
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        if (!c->lam) continue; /* `start` has set them to 0, and only an outer loop changes them, which has some */
        const double *lam = c->lam + e * c->knots * c->rows;
        for (int64_t k = 0; k < c->knots; k++) {
            int pushed = 0;
            for (int j = 0; j < c->rows; j++, lam++) {
                s->rows[i].lam[k * c->rows + j][lane] = *lam;
                if (*lam != 0) pushed = 1, squares += *lam * *lam;
            }
            s->rows[i].pushed[k][lane] = -pushed;
        }
    }
    s->mu[lane] = p->mu[e]; s->inverse_mu[lane] = 1 / p->mu[e];
    s->floor[lane] = squares > 0 ? 0.5 * squares / p->mu[e] : 0;
    s->mu_r[lane] = p->regularisation ? p->regularisation[e] : 0;
    s->merit[lane] = p->merit[e]; s->cost[lane] = p->cost[e];
    s->inner[lane] = p->inner ? p->inner[e] : 0; s->made[lane] = 0; s->rung[lane] = p->rung ? p->rung[e] : 0;
}

static void leave(const Lanes *s, int lane, int32_t status, int32_t converged, int32_t refused, int32_t lost) {
    const Problem *p = s->of;
    int64_t N = p->N, e = s->element[lane];
    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = s->X[i][lane];
    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = s->U[i][lane];
    p->cost[e] = s->cost[lane]; p->merit[e] = s->merit[lane]; p->regularisation[e] = s->mu_r[lane];
    p->iterations[e] += (int64_t)s->made[lane]; p->inner[e] = (int64_t)s->inner[lane]; p->rung[e] = s->rung[lane];
    p->alpha[e] = s->alpha[lane]; p->used[e] = s->used[lane];
    p->status[e] = status; p->converged[e] = converged; p->refused[e] = refused; p->lost[e] = lost;
}
