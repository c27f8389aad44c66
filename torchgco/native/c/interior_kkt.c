/* Linear systems with the matrix of the KKT conditions at given points, for derivatives of solutions: the curvature H of
   the Lagrangian, the dynamics' slopes F and those A of the rows that hold, `active`, which give way to their multipliers
   by D, `give`: 0 of those that hold as equalities, slack / multiplier of those in a barrier,

       [H  F' A'] [z]     [a]
       [F       ] [y] = - [b]
       [A    -D ] [v]     [c]

   The interior point's factors of H + A'wA with w = 1 / (D + 1 / sigma), and of F, give steps towards the solution: each
   round closes what the last one has left open, of active rows all but a share of about 1 / sigma, as the method of
   multipliers does. */
#include "interior_fixed.h"
#include "cholesky.h"

#define LEAST 1e-200 /* multiplier of an active row of an inequality, by which its stiffness is divided */

/* What a solve needs beside the interior point's own memory. */
typedef struct {
    Numbers active, give; /* (rows): 1 where a row holds, and its D */
    Numbers H;         /* (N+1, S, S): curvatures without what holds the rows, triangles */
    Numbers a, b, c;   /* (N+1, S), (N, NX), (rows): a right hand side */
    Numbers z, y, v;   /* the same: its solution */
    Numbers gives, along; /* (rows): what the interior point has of equalities alone, and where the model it needs again lies */
    V sigma;
} System;

/* sigma of a row, and its curvature w, where it holds. */
static inline V sigma_of(const Barrier *t, const System *of, int64_t q) { return of->sigma / t->gives[q]; }
static inline V weight_of(const Barrier *t, const System *of, int64_t q) {
    V sigma = sigma_of(t, of, q);
    return sigma / (SET(1.0) + sigma * of->give[q]);
}

/* A row of inequalities that holds has this curvature; one that doesn't none. (The interior point: z / s.) */
static void stiffen(Barrier *t, const System *of) {
    EACH_ROW(t, 0, q) t->s[q] = tgco_choose(of->active[q] > SET(0.0), t->z[q] / weight_of(t, of, q), SET(INFINITY));
    t->soft = SET(1.0) / of->sigma;
}

/* Adds the slopes of all rows, times their sigma r, to g[1], and their sigma's curvature to H. */
static void add_all_rows(Barrier *t) {
    const Problem *p = t->lanes.of;
    LOCAL_NUMBERS(t, H, 0, S * S);
    t->objective = SET(0.0); /* else rows would add multipliers, and their own curvature once more */
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = t->lanes.X + k * NX; IN u = k < p->N ? t->lanes.U + k * NU : 0;
        unfold(t->H + k * TRIANGLE(S), H, S);
        for (int64_t i = 0; i < p->constraints; i++)
            if (p->constraint[i].place[k] != NOWHERE) add_rows(t, i, k, x, u, H);
        fold(H, t->H + k * TRIANGLE(S), S);
    }
    t->objective = SET(1.0);
}

/* Costates, then curvatures of all knots with their sigma, and the factors; where these don't exist the answer is false. */
TGCO_LARGE I factor_kkt(Barrier *t, System *of, const Kkt *how) {
    const Problem *p = t->lanes.of;
    int64_t N = p->N;
    V largest = SET(0.0);
    I all = largest == largest;
    t->scale = t->objective = t->raised = SET(1.0); t->mu = t->shift = SET(0.0);
    memset(t->y, 0, (N + 1) * NX * sizeof(V));
    memset(t->r, 0, t->rows * sizeof(V));
    of->sigma = SET(0.0);
    stiffen(t, of); /* infinite slacks: rows have no weight yet */
    expand(t);
    adjoin(t, all, how->K ? t->lanes.G : NONE);
    expand(t);
    memcpy(of->H, t->H, (N + 1) * TRIANGLE(S) * sizeof(V));
    for (int64_t k = 0; k <= N; k++)
        for (int i = 0; i < (k < N ? S : NX); i++) largest = most(tgco_fabs(of->H[k * TRIANGLE(S) + ENTRY(i, i)]), largest);
    of->sigma = SET(how->stiff) * largest;
    soften_rows(t, all, SET(how->slight) * largest, of->active);
    memcpy(t->H, of->H, (N + 1) * TRIANGLE(S) * sizeof(V)); /* where costs of moves were measured */
    stiffen(t, of);
    add_all_rows(t);
    return factor(t, NOT(all));
}

/* A z of every row into ds, of z as dx and du. */
TGCO_LARGE void along_rows(Barrier *t) {
    const Problem *p = t->lanes.of;
    V z[S];
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = t->lanes.X + k * NX; IN u = k < p->N ? t->lanes.U + k * NU : 0;
        for (int i = 0; i < NX; i++) z[i] = t->dx[k * NX + i];
        for (int j = 0; j < NU; j++) z[NX + j] = u ? t->du[k * NU + j] : SET(0.0);
        for (int64_t i = 0; i < p->constraints; i++)
            if (p->constraint[i].place[k] != NOWHERE) along(t, i, k, x, u, z, t->ds + row_of(t, i, k));
    }
}

/* What z, y leave open of stationarity, a + H z + F'y, into g[1], and of the gaps, b + F z, into aim. */
TGCO_LARGE void find_open(Barrier *t, const System *of) {
    int64_t N = t->lanes.of->N;
    for (int64_t k = 0; k <= N; k++) {
        IN H = of->H + k * TRIANGLE(S); IN z = of->z + k * S; IN next = of->z + (k + 1) * S;
        OUT g = t->g[1] + k * S; V ahead[NX], back[S];
        for (int i = 0; i < S; i++) {
            g[i] = of->a[k * S + i];
            t->g[2][k * S + i] = back[i] = SET(0.0);
            if (k == N && i >= NX) { g[i] = SET(0.0); continue; }
            for (int j = 0; j < (k < N ? S : NX); j++) ADD(g[i], H[i < j ? ENTRY(j, i) : ENTRY(i, j)], z[j]);
        }
        if (k > 0) for (int i = 0; i < NX; i++) g[i] -= of->y[(k - 1) * NX + i];
        if (k == N) break;
        model_pull_back(of->y + k * NX, t->f + k * NJ, back);
        for (int i = 0; i < S; i++) g[i] += back[i];
        model_push(t->f + k * NJ, z, ahead);
        for (int i = 0; i < NX; i++) t->aim[k * NX + i] = of->b[k * NX + i] + ahead[i] - next[i];
    }
}

/* Steps that close what is open, from z, y, v = 0 on; returns the largest of c + A z - D v of active rows at the end. What is
   open of rows is counted in c itself: v, in which it is multiplied by sigma, would magnify the rounding of c + A z. */
TGCO_LARGE V solve_kkt(Barrier *t, System *of, int64_t rounds) {
    int64_t N = t->lanes.of->N;
    memset(of->z, 0, (N + 1) * S * sizeof(V));
    memset(of->y, 0, N * NX * sizeof(V));
    memset(of->v, 0, t->rows * sizeof(V));
    for (int64_t round = 0; round < rounds; round++) {
        find_open(t, of);
        for (int64_t q = 0; q < t->rows; q++)
            t->r[q] = tgco_if(of->active[q] > SET(0.0), of->c[q] + of->v[q] / weight_of(t, of, q));
        add_all_rows(t);
        solve(t);
        along_rows(t);
        for (int64_t k = 0; k <= N; k++) {
            for (int i = 0; i < NX; i++) of->z[k * S + i] += t->dx[k * NX + i];
            if (k < N) for (int j = 0; j < NU; j++) of->z[k * S + NX + j] += t->du[k * NU + j];
        }
        for (int64_t i = 0; i < N * NX; i++) of->y[i] += t->yn[NX + i];
        for (int64_t q = 0; q < t->rows; q++) {
            V open = of->c[q] + tgco_if(of->active[q] > SET(0.0), t->ds[q]), sigma = sigma_of(t, of, q);
            of->c[q] = open / (SET(1.0) + sigma * of->give[q]);
            ADD(of->v[q], sigma, of->c[q]);
        }
    }
    V worst = SET(0.0);
    for (int64_t q = 0; q < t->rows; q++) worst = most(tgco_fabs(of->c[q]), worst);
    return worst;
}

/* Columns (count, NX) of changes of the state at knot k, carried to the next knot by what the gains make of the controls. */
static void carry(const Barrier *t, int64_t k, OUT columns, int64_t count) {
    IN K = t->lanes.G + k * NU * NZ;
    V z[S];
    for (OUT x = columns; x < columns + count * NX; x += NX) {
        for (int i = 0; i < NX; i++) z[i] = x[i];
        for (int j = 0; j < NU; j++) {
            z[NX + j] = SET(0.0);
            for (int i = 0; i < NX; i++) ADD(z[NX + j], K[j * NZ + i], x[i]);
        }
        model_push(t->f + k * NJ, z, x);
    }
}

/* Responses to forces: the inverse of the matrix that was factored is the covariance of states that follow the gains, with
   controls disturbed by the inverse of their own curvature L L'. */
TGCO_LARGE void find_responses(const Barrier *t, const Kkt *how, int64_t at, int own) {
    int64_t N = t->lanes.of->N, d = how->d, width = N * d;
    V spread[NX * NX], turned[NX * NX], z[S], pushed[NX];
    memset(spread, 0, sizeof spread);
    for (int64_t k = 0; k < N; k++) {
        carry(t, k, spread, NX);
        for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) turned[i * NX + j] = spread[j * NX + i];
        carry(t, k, turned, NX);
        memcpy(spread, turned, sizeof spread);
        for (int j = 0; j < NU; j++) {
            for (int i = 0; i < S; i++) z[i] = SET(i == NX + j ? 1.0 : 0.0);
            solve_upper(t->L + k * TRIANGLE(NU), z + NX, 1, 1);
            model_push(t->f + k * NJ, z, pushed);
            for (int a = 0; a < NX; a++) for (int b = 0; b < NX; b++) ADD(spread[a * NX + b], pushed[a], pushed[b]);
        }
        memcpy(turned, spread + how->first * NX, d * NX * sizeof(V));
        for (int64_t l = k; l < N; l++) {
            if (l > k) carry(t, l, turned, d);
            for (int64_t a = 0; a < d; a++) for (int64_t b = 0; b < d; b++) for (int lane = 0; lane < own; lane++) {
                double *out = how->responses + (at + lane) * width * width;
                out[(l * d + b) * width + k * d + a] = out[(k * d + a) * width + l * d + b] =
                    LANE(turned[a * NX + how->first + b], lane);
            }
        }
    }
}

/* Reads or writes one right hand side of a lane: (count, E, ...) each. */
#define COLUMN(how, name, column, e, size) ((how)->name + ((column) * (how)->problems + (e)) * (size))

static void enter_column(Barrier *t, System *of, const Kkt *how, int64_t column, int lane, int64_t e) {
    int64_t N = t->lanes.of->N;
    for (int64_t i = 0; i < (N + 1) * S; i++) LANE(of->a[i], lane) = COLUMN(how, a, column, e, (N + 1) * S)[i];
    for (int64_t i = 0; i < N * NX; i++) LANE(of->b[i], lane) = COLUMN(how, b, column, e, N * NX)[i];
    for (int64_t q = 0; q < t->rows; q++)
        LANE(of->c[q], lane) = LANE(of->active[q], lane) > 0 ? COLUMN(how, c, column, e, t->rows)[q] : 0;
}

static void leave_column(Barrier *t, const System *of, const Kkt *how, int64_t column, int lane, int64_t e, V left) {
    int64_t N = t->lanes.of->N;
    for (int64_t i = 0; i < (N + 1) * S; i++) COLUMN(how, a, column, e, (N + 1) * S)[i] = LANE(of->z[i], lane);
    for (int64_t i = 0; i < N * NX; i++) COLUMN(how, b, column, e, N * NX)[i] = LANE(of->y[i], lane);
    for (int64_t q = 0; q < t->rows; q++) COLUMN(how, c, column, e, t->rows)[q] = LANE(of->v[q], lane);
    how->left[column * how->problems + e] = LANE(left, lane);
}

/* A problem's point, its gains, its multipliers, 0 of rows that aren't active, and which these are. */
static void enter_system(Barrier *t, System *of, const Kkt *how, int lane, int64_t e) {
    const Problem *p = t->lanes.of;
    enter_barrier(t, lane, e);
    for (int64_t i = 0; how->K && i < p->N * NU; i++)
        for (int j = 0; j < NX; j++) LANE(t->lanes.G[i * NZ + j], lane) = how->K[(e * p->N * NU + i) * NX + j];
    for (int64_t i = 0, q = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        int64_t count = con->knots * con->rows;
        for (int64_t j = 0; j < count; j++, q++) {
            double lam = con->lam[e * count + j], held = how->active[e * t->rows + q];
            LANE(of->active[q], lane) = held;
            LANE(of->give[q], lane) = how->give && held > 0 ? how->give[e * t->rows + q] : 0;
            LANE(t->z[q], lane) = held <= 0 ? 0 : con->equality || lam > LEAST ? lam : LEAST;
        }
    }
}

static int64_t lay_out_system(System *of, const Problem *p, int64_t rows, Numbers memory) {
    int64_t N = p->N, point = (N + 1) * S, gaps = N * NX;
    Cut m = {memory, 0};
    of->H = cut(&m, (N + 1) * TRIANGLE(S)); of->active = cut(&m, rows); of->give = cut(&m, rows);
    of->a = cut(&m, point); of->b = cut(&m, gaps); of->c = cut(&m, rows);
    of->z = cut(&m, point); of->y = cut(&m, gaps); of->v = cut(&m, rows);
    of->gives = cut(&m, rows); of->along = cut(&m, rows);
    return m.used;
}

/* How many numbers of a lane a solve of these systems has room for. */
int64_t tgco_kkt_room(const Kkt *how) {
    Interior options = {.of = how->of, .free_start = how->free_start};
    System system;
    int64_t rows = 0;
    for (int64_t i = 0; i < how->of->constraints; i++) rows += how->of->constraint[i].knots * how->of->constraint[i].rows;
    return room_of(&options) + lay_out_system(&system, how->of, rows, 0) + 1;
}

/* Problems first, first + 1, ..., last - 1. Returns 0 without memory. */
int tgco_kkt(const Kkt *how, int64_t first, int64_t last) {
    Interior options = {
        .of = how->of, .free_start = how->free_start, .ask = how->ask, .constr_mult_init_max = INFINITY,
        .pivot = how->pivot};
    Barrier barrier, *t = &barrier;
    System system, *of = &system;
    if (!start_barrier(t, &options)) return 0;
    const Problem *p = t->lanes.of;
    Numbers memory = take_numbers(p, lay_out_system(of, p, t->rows, 0) + 1);
    if (!memory) { finish_barrier(t); return 0; }
    lay_out_system(of, p, t->rows, memory);
    t->gives = of->gives; t->ds = of->along;
    for (int64_t q = 0; q < t->rows; q++) t->gives[q] = SET(1.0);
    for (int64_t at = first; at < last; at += LANES) {
        int own = last - at < LANES ? last - at : LANES; /* lanes without a problem repeat the first one */
        for (int l = 0; l < LANES; l++) {
            enter_system(t, of, how, l, l < own ? at + l : at);
            LANE(t->live, l) = l < own ? -1 : 0;
        }
        I good = factor_kkt(t, of, how);
        for (int l = 0; l < own; l++) {
            p->status[at + l] = LANE(good, l) ? CONVERGED : NOT_POSITIVE_DEFINITE;
            for (int64_t i = 0; i < (p->N + 1) * NX; i++) how->y[(at + l) * (p->N + 1) * NX + i] = LANE(t->y[i], l);
        }
        if (how->responses) find_responses(t, how, at, own);
        for (int64_t column = 0; column < how->count; column++) {
            for (int l = 0; l < LANES; l++) enter_column(t, of, how, column, l, l < own ? at + l : at);
            V left = solve_kkt(t, of, how->rounds);
            for (int l = 0; l < own; l++) leave_column(t, of, how, column, l, at + l, left);
        }
    }
    give(p, memory);
    finish_barrier(t);
    return 1;
}
