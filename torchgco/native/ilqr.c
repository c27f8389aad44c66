/* iLQR (Algorithm 2) for problems side by side, one to a lane of the vectors V; no operation mixes lanes.

   The generated part before this file defines NX, NU, NP, NJ, DIM, POSITION, QUADRATIC_FULL, and

       tgco_step, tgco_jacobian                       the model
       tgco_gather(P, f, T), tgco_product(f, T, Q)    T = P F and Q = F' T (upper triangle) for its sparse F = [fx fu]
       tgco_pull_back(p, f, g)                        g = F' p
       tgco_rows(i, x, u, c), tgco_add_rows(i, ...)   constraints that are given as functions

   The single lanes of an element agree with PyTorch's kernels up to rounding (tests/native). */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define S (NX + NU)
#define NZ (NX + 1)

enum { BOX = 0, SPHERES = 1, FUNCTION = 2 };
enum { NO_GUIDE = 0, REGION = 1, PATH = 2 };
enum { GOING = 0, ENDED = 1, NOT_POSITIVE_DEFINITE = 4, NON_FINITE = 5 };

/* An array over (elements, knots, numbers); a stride of 0 stands for an axis of length 1. */
typedef struct { const double *data; int64_t element, knot; int64_t size; } Array;

typedef struct {
    int32_t kind, equality, rows;  /* rows of a knot */
    const int32_t *place;          /* (N+1): which of the constraint's knots, -1 where it says nothing */
    int64_t knots;
    double *lam;                   /* (E, knots, rows) */
    const int32_t *variable;       /* BOX: (rows) index into [x, u] */
    const double *sign;            /* BOX: (rows) +1 for an upper bound, -1 for a lower one */
    Array bound;                   /* BOX: (E, 1, rows); SPHERES: centres (E, 1, rows * DIM) */
    Array squares;                 /* SPHERES: squared distances (E, 1, rows) */
    Array velocities;              /* SPHERES: as centres, or NULL */
    double dt;
} Constraint;

typedef struct {
    int64_t N, elements, constraints, rungs, limit, max_iterations;
    double *X, *U, *cost, *merit, *regularisation;  /* (E, ...) in and out */
    double *alpha, *used;                           /* (E): step length and mu_r of the last iteration */
    double *gains;                                  /* (E, N, NU, NZ): what tgco_gains writes */
    const double *mu;
    int64_t *inner, *iterations;
    int32_t *status, *converged, *refused, *lost;
    Array parameters, Q, R, Qf, x_ref, xf_ref, u_ref, q, r, qf, cross;
    const Constraint *constraint;
    int32_t guide, clip, accept_last, replicas, optimality;
    Array center, radius, weight;
    const double *ladder;
    double tolerance, absolute_tolerance, ratio_min, ratio_max, smallest;
    double first, growth, most, damping, rounding, lost_beyond;
} Problem;

/* What a group of lanes works on. */
typedef struct {
    const Problem *of;
    V *X, *U, *Xn, *Un, *G, **lam, **bound, **squares, **velocities;
    V *parameters, *Q, *R, *Qf, *x_ref, *xf_ref, *u_ref, *q, *r, *qf, *cross, *center, *radius;
    V weight, mu, mu_r, merit, cost, inner, made, alpha, used;
    int64_t element[LANES];
    V *memory;
} Lanes;

static inline int any(I where) {
    for (int l = 0; l < LANES; l++) if (where[l]) return 1;
    return 0;
}
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

static const V *at(const V *array, const Array *shape, int64_t k) { return array + (shape->knot ? k * shape->size : 0); }

static V *cut(V **memory, int64_t count) { V *part = *memory; *memory += count; return part; }

static int64_t lay_out(Lanes *s, V *memory) {
    const Problem *p = s->of;
    int64_t N = p->N;
    V *m = memory;
    s->X = cut(&m, (N + 1) * NX); s->U = cut(&m, N * NU); s->Xn = cut(&m, (N + 1) * NX); s->Un = cut(&m, N * NU);
    s->G = cut(&m, N * NU * NZ);
    s->parameters = cut(&m, length(&p->parameters, 1));
    s->Q = cut(&m, length(&p->Q, N)); s->R = cut(&m, length(&p->R, N)); s->Qf = cut(&m, length(&p->Qf, 1));
    s->x_ref = cut(&m, length(&p->x_ref, N)); s->xf_ref = cut(&m, length(&p->xf_ref, 1));
    s->u_ref = cut(&m, length(&p->u_ref, N)); s->q = cut(&m, length(&p->q, N)); s->r = cut(&m, length(&p->r, N));
    s->qf = cut(&m, length(&p->qf, 1)); s->cross = cut(&m, length(&p->cross, N));
    s->center = cut(&m, length(&p->center, N + 1)); s->radius = cut(&m, length(&p->radius, N + 1));
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        V *lam = cut(&m, c->knots * c->rows), *bound = cut(&m, length(&c->bound, 1));
        V *squares = cut(&m, length(&c->squares, 1)), *velocities = cut(&m, length(&c->velocities, 1));
        if (memory) { s->lam[i] = lam; s->bound[i] = bound; s->squares[i] = squares; s->velocities[i] = velocities; }
    }
    return m - memory;
}

static int start(Lanes *s, const Problem *p) {
    memset(s, 0, sizeof *s);
    s->of = p;
    int64_t count = lay_out(s, 0), many = p->constraints + 1;
    s->memory = aligned_alloc(sizeof(V), (count + 1) * sizeof(V));
    s->lam = calloc(4 * many, sizeof(V *));
    if (!s->memory || !s->lam) { free(s->memory); free(s->lam); return 0; }
    memset(s->memory, 0, (count + 1) * sizeof(V));
    s->bound = s->lam + many; s->squares = s->lam + 2 * many; s->velocities = s->lam + 3 * many;
    lay_out(s, s->memory);
    return 1;
}

static void finish(Lanes *s) { free(s->memory); free(s->lam); }

static void enter(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t N = p->N;
    s->element[lane] = e;
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->X[i][lane] = p->X[e * (N + 1) * NX + i];
    for (int64_t i = 0; i < N * NU; i++) s->U[i][lane] = p->U[e * N * NU + i];
    fill(s->parameters, &p->parameters, 1, lane, e);
    fill(s->Q, &p->Q, N, lane, e); fill(s->R, &p->R, N, lane, e); fill(s->Qf, &p->Qf, 1, lane, e);
    fill(s->x_ref, &p->x_ref, N, lane, e); fill(s->xf_ref, &p->xf_ref, 1, lane, e);
    fill(s->u_ref, &p->u_ref, N, lane, e); fill(s->q, &p->q, N, lane, e); fill(s->r, &p->r, N, lane, e);
    fill(s->qf, &p->qf, 1, lane, e); fill(s->cross, &p->cross, N, lane, e);
    fill(s->center, &p->center, N + 1, lane, e); fill(s->radius, &p->radius, N + 1, lane, e);
    if (p->guide != NO_GUIDE) s->weight[lane] = p->weight.data[e * p->weight.element];
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        int64_t size = c->knots * c->rows;
        for (int64_t j = 0; j < size; j++) s->lam[i][j][lane] = c->lam[e * size + j];
        fill(s->bound[i], &c->bound, 1, lane, e);
        fill(s->squares[i], &c->squares, 1, lane, e);
        fill(s->velocities[i], &c->velocities, 1, lane, e);
    }
    s->mu[lane] = p->mu[e]; s->mu_r[lane] = p->regularisation ? p->regularisation[e] : 0;
    s->merit[lane] = p->merit[e]; s->cost[lane] = p->cost[e];
    s->inner[lane] = p->inner ? p->inner[e] : 0; s->made[lane] = 0;
}

static void leave(const Lanes *s, int lane, int32_t status, int32_t converged, int32_t refused, int32_t lost) {
    const Problem *p = s->of;
    int64_t N = p->N, e = s->element[lane];
    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = s->X[i][lane];
    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = s->U[i][lane];
    p->cost[e] = s->cost[lane]; p->merit[e] = s->merit[lane]; p->regularisation[e] = s->mu_r[lane];
    p->iterations[e] += (int64_t)s->made[lane]; p->inner[e] = (int64_t)s->inner[lane];
    p->alpha[e] = s->alpha[lane]; p->used[e] = s->used[lane];
    p->status[e] = status; p->converged[e] = converged; p->refused[e] = refused; p->lost[e] = lost;
}

/* The Lagrangian at one knot --------------------------------------------------------------------------------------- */

/* What a row adds to L_M. */
static inline V worth(const Problem *p, int equality, V c, V lam, V mu) {
    V half = SET(0.5);
    if (equality) return (lam + half * mu * c) * c;
    if (p->clip) {
        I idle = lam + mu * c < SET(0.0);
        return tgco_choose(idle, -half * lam * lam / mu, (lam + half * mu * c) * c);
    }
    I idle = (c < SET(0.0)) & (lam == SET(0.0));
    return (lam + half * tgco_if(~idle, mu) * c) * c;
}

/* First and second derivative of that by c; of lam c, with the penalty's curvature, where optimality is asked for. */
static inline V pull(const Problem *p, int equality, V c, V lam, V mu, V *rho) {
    if (p->optimality) { *rho = tgco_if(lam != SET(0.0), mu); return lam; }
    if (equality) { *rho = mu; return lam + mu * c; }
    I idle = p->clip ? lam + mu * c < SET(0.0) : (c < SET(0.0)) & (lam == SET(0.0));
    *rho = tgco_if(~idle, mu);
    V g = lam + *rho * c;
    return p->clip ? tgco_if(~idle, g) : g;
}

static inline void sphere(const Lanes *s, int64_t i, int64_t j, const V *x, int64_t k, V *away, V *c) {
    const Constraint *con = s->of->constraint + i;
    const V *o = s->bound[i] + j * DIM;
    V square = SET(0.0);
    I here = s->squares[i][j] >= SET(0.0); /* an absent one is c = -1 everywhere */
    for (int a = 0; a < DIM; a++) {
        away[a] = x[POSITION + a] - o[a];
        if (con->velocities.data) away[a] -= SET(k * con->dt) * s->velocities[i][j * DIM + a];
        away[a] = tgco_if(here, away[a]);
        square += away[a] * away[a];
    }
    *c = s->squares[i][j] - square;
}

/* Cost of stage k; both guides and constraints of knot k go into `added`. */
static inline V knot_value(const Lanes *s, int64_t k, const V *x, const V *u, V *added) {
    const Problem *p = s->of;
    V total = SET(0.0), more = SET(0.0), half = SET(0.5), ex[NX], eu[NU];
    int last = k == p->N;
    const V *ref = last ? s->xf_ref : at(s->x_ref, &p->x_ref, k), *Q = last ? s->Qf : at(s->Q, &p->Q, k);
    for (int i = 0; i < NX; i++) ex[i] = x[i] - ref[i];
#if QUADRATIC_FULL
    for (int i = 0; i < NX; i++) {
        V row = SET(0.0);
        for (int j = 0; j < NX; j++) row += Q[i * NX + j] * ex[j];
        total += half * ex[i] * row;
    }
#else
    for (int i = 0; i < NX; i++) total += half * Q[i] * ex[i] * ex[i];
#endif
    const V *q = last ? (p->qf.data ? s->qf : 0) : (p->q.data ? at(s->q, &p->q, k) : 0);
    if (q) for (int i = 0; i < NX; i++) total += q[i] * ex[i];
    if (!last) {
        const V *u_ref = at(s->u_ref, &p->u_ref, k), *R = at(s->R, &p->R, k);
        for (int i = 0; i < NU; i++) eu[i] = u[i] - u_ref[i];
#if QUADRATIC_FULL
        for (int i = 0; i < NU; i++) {
            V row = SET(0.0);
            for (int j = 0; j < NU; j++) row += R[i * NU + j] * eu[j];
            total += half * eu[i] * row;
        }
#else
        for (int i = 0; i < NU; i++) total += half * R[i] * eu[i] * eu[i];
#endif
        if (p->r.data) for (int i = 0; i < NU; i++) total += at(s->r, &p->r, k)[i] * eu[i];
        if (p->cross.data) {
            const V *H = at(s->cross, &p->cross, k);
            for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) total += eu[i] * H[i * NX + j] * ex[j];
        }
    }
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (con->place[k] < 0) continue;
        const V *lam = s->lam[i] + con->place[k] * con->rows;
        if (con->kind == BOX) {
            for (int j = 0; j < con->rows; j++) {
                V z = con->variable[j] < NX ? x[con->variable[j]] : u[con->variable[j] - NX];
                V c = SET(con->sign[j]) * (z - s->bound[i][j]);
                more += worth(p, 0, c, lam[j], s->mu);
            }
#if DIM > 0
        } else if (con->kind == SPHERES) {
            for (int j = 0; j < con->rows; j++) {
                V away[DIM], c;
                sphere(s, i, j, x, k, away, &c);
                if (any((c > SET(0.0)) | (lam[j] != SET(0.0)) | (c != c))) more += worth(p, 0, c, lam[j], s->mu);
            }
#endif
        } else {
            V c[MAX_ROWS];
            tgco_rows((int)i, x, u, c);
            for (int j = 0; j < con->rows; j++) more += worth(p, con->equality, c[j], lam[j], s->mu);
        }
    }
#if DIM > 0
    if (p->guide != NO_GUIDE) {
        const V *center = s->center + k * DIM;
        V square = SET(0.0);
        for (int a = 0; a < DIM; a++) { V e = x[POSITION + a] - center[a]; square += e * e; }
        if (p->guide == PATH) more += half * s->weight * square;
        else {
            V f = square - s->radius[k] * s->radius[k];
            more += tgco_if(f > SET(0.0), half * s->weight * f * f);
        }
    }
#endif
    *added = more;
    return total;
}

/* Adds gradient g (S) and upper triangle H (S, S) of all terms of knot k. */
static inline void knot_expand(const Lanes *s, int64_t k, const V *x, const V *u, V *g, V *H) {
    const Problem *p = s->of;
    V ex[NX], eu[NU];
    int last = k == p->N;
    const V *ref = last ? s->xf_ref : at(s->x_ref, &p->x_ref, k), *Q = last ? s->Qf : at(s->Q, &p->Q, k);
    for (int i = 0; i < NX; i++) ex[i] = x[i] - ref[i];
#if QUADRATIC_FULL
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) {
        g[i] += Q[i * NX + j] * ex[j];
        if (j >= i) H[i * S + j] += Q[i * NX + j];
    }
#else
    for (int i = 0; i < NX; i++) { g[i] += Q[i] * ex[i]; H[i * S + i] += Q[i]; }
#endif
    const V *q = last ? (p->qf.data ? s->qf : 0) : (p->q.data ? at(s->q, &p->q, k) : 0);
    if (q) for (int i = 0; i < NX; i++) g[i] += q[i];
    if (!last) {
        const V *u_ref = at(s->u_ref, &p->u_ref, k), *R = at(s->R, &p->R, k);
        for (int i = 0; i < NU; i++) eu[i] = u[i] - u_ref[i];
#if QUADRATIC_FULL
        for (int i = 0; i < NU; i++) for (int j = 0; j < NU; j++) {
            g[NX + i] += R[i * NU + j] * eu[j];
            if (j >= i) H[(NX + i) * S + NX + j] += R[i * NU + j];
        }
#else
        for (int i = 0; i < NU; i++) { g[NX + i] += R[i] * eu[i]; H[(NX + i) * S + NX + i] += R[i]; }
#endif
        if (p->r.data) for (int i = 0; i < NU; i++) g[NX + i] += at(s->r, &p->r, k)[i];
        if (p->cross.data) {
            const V *C = at(s->cross, &p->cross, k);
            for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) {
                g[NX + i] += C[i * NX + j] * ex[j];
                g[j] += C[i * NX + j] * eu[i];
                H[j * S + NX + i] += C[i * NX + j];
            }
        }
    }
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (con->place[k] < 0) continue;
        const V *lam = s->lam[i] + con->place[k] * con->rows;
        if (con->kind == BOX) {
            for (int j = 0; j < con->rows; j++) {
                int v = con->variable[j];
                V sign = SET(con->sign[j]), rho;
                V c = sign * ((v < NX ? x[v] : u[v - NX]) - s->bound[i][j]), gradient = pull(p, 0, c, lam[j], s->mu, &rho);
                g[v] += sign * gradient;
                H[v * S + v] += rho;
            }
#if DIM > 0
        } else if (con->kind == SPHERES) {
            for (int j = 0; j < con->rows; j++) {
                V away[DIM], c, rho;
                sphere(s, i, j, x, k, away, &c);
                if (!any((c > SET(0.0)) | (lam[j] != SET(0.0)) | (c != c))) continue;
                V gradient = pull(p, 0, c, lam[j], s->mu, &rho);
                for (int a = 0; a < DIM; a++) {
                    g[POSITION + a] -= SET(2.0) * gradient * away[a];
                    for (int b = a; b < DIM; b++)
                        H[(POSITION + a) * S + POSITION + b] += SET(4.0) * rho * away[a] * away[b];
                }
            }
#endif
        } else {
            V c[MAX_ROWS], gradient[MAX_ROWS], rho[MAX_ROWS];
            tgco_rows((int)i, x, u, c);
            for (int j = 0; j < con->rows; j++) gradient[j] = pull(p, con->equality, c[j], lam[j], s->mu, rho + j);
            tgco_add_rows((int)i, x, u, gradient, rho, g, H);
        }
    }
#if DIM > 0
    if (p->guide != NO_GUIDE) {
        const V *center = s->center + k * DIM;
        V e[DIM], square = SET(0.0);
        for (int a = 0; a < DIM; a++) { e[a] = x[POSITION + a] - center[a]; square += e[a] * e[a]; }
        if (p->guide == PATH) {
            for (int a = 0; a < DIM; a++) {
                g[POSITION + a] += s->weight * e[a];
                H[(POSITION + a) * S + POSITION + a] += s->weight;
            }
        } else {
            V f = square - s->radius[k] * s->radius[k];
            V rho = tgco_if(f > SET(0.0), s->weight), pulls = tgco_if(f > SET(0.0), s->weight * f * SET(2.0));
            for (int a = 0; a < DIM; a++) {
                g[POSITION + a] += pulls * e[a];
                for (int b = a; b < DIM; b++)
                    H[(POSITION + a) * S + POSITION + b] += SET(4.0) * rho * e[a] * e[b];
            }
        }
    }
#endif
}

/* Passes ----------------------------------------------------------------------------------------------------------- */

__attribute__((noinline)) static void model_step(const V *x, const V *u, const V *parameters, V *next) {
    tgco_step(x, u, parameters, next);
}

/* The forward pass (line 16) from the nominal X, U along G with step lengths alpha; writes Xn, Un, J_var and L_M. */
static void roll(Lanes *s, V alpha, V *cost, V *merit) {
    const Problem *p = s->of;
    V total = SET(0.0), more = SET(0.0), part;
    memcpy(s->Xn, s->X, NX * sizeof(V));
    for (int64_t k = 0; k < p->N; k++) {
        const V *X = s->X + k * NX, *G = s->G + k * NU * NZ;
        V *x = s->Xn + k * NX, *u = s->Un + k * NU, dx[NX];
        for (int i = 0; i < NX; i++) dx[i] = x[i] - X[i];
        for (int j = 0; j < NU; j++) {
            V step = alpha * G[j * NZ + NX];
            for (int i = 0; i < NX; i++) step += G[j * NZ + i] * dx[i];
            u[j] = s->U[k * NU + j] + step;
        }
        total += knot_value(s, k, x, u, &part);
        more += part;
        model_step(x, u, s->parameters, x + NX);
    }
    total += knot_value(s, p->N, s->Xn + p->N * NX, 0, &part);
    *cost = total;
    *merit = total + (more + part);
}

/* The backward pass (lines 4-13): gains into G; the expected change's two sums, and the smallest pivot. */
static void backward(Lanes *s, V *linear, V *squares, V *lowest) {
    const Problem *p = s->of;
    V P[NX * NX], vector[NX], g[S], H[S * S], T[S * NX], f[NJ ? NJ : 1], L[NU * NU], Y[NU * NZ];
    V sum = SET(0.0), square = SET(0.0), least = SET(__builtin_inf());
    int regular = any(s->mu_r > SET(0.0));
    memset(g, 0, sizeof g); memset(H, 0, sizeof H);
    knot_expand(s, p->N, s->X + p->N * NX, 0, g, H);
    for (int i = 0; i < NX; i++) {
        vector[i] = g[i];
        for (int j = 0; j < NX; j++) P[i * NX + j] = i <= j ? H[i * S + j] : H[j * S + i];
    }
    for (int64_t k = p->N - 1; k >= 0; k--) {
        const V *x = s->X + k * NX, *u = s->U + k * NU;
        V *G = s->G + k * NU * NZ;
        tgco_jacobian(x, u, s->parameters, f);
        tgco_gather(P, f, T);
        tgco_product(f, T, H);
        tgco_pull_back(vector, f, g);
        knot_expand(s, k, x, u, g, H);
        /* Cholesky factor L of Quu + mu_r I (diagonal inverted), Y = L^-1 [Qux Qu], [K d] = -L^-T Y. */
        for (int j = 0; j < NU; j++) {
            V *row = Y + j * NZ, pivot = H[(NX + j) * S + NX + j] + s->mu_r;
            for (int i = 0; i < j; i++) pivot -= L[j * NU + i] * L[j * NU + i];
            least = tgco_choose((pivot < least) | (pivot != pivot), pivot, least);
            V inverse = SET(1.0) / tgco_sqrt(pivot);
            L[j * NU + j] = inverse;
            for (int i = j + 1; i < NU; i++) {
                V entry = H[(NX + j) * S + NX + i];
                for (int a = 0; a < j; a++) entry -= L[i * NU + a] * L[j * NU + a];
                L[i * NU + j] = entry * inverse;
            }
            for (int i = 0; i < NX; i++) row[i] = H[i * S + NX + j];
            row[NX] = g[NX + j];
            for (int a = 0; a < j; a++) for (int i = 0; i < NZ; i++) row[i] -= L[j * NU + a] * Y[a * NZ + i];
            for (int i = 0; i < NZ; i++) row[i] *= inverse;
        }
        for (int j = NU - 1; j >= 0; j--) {
            V *row = G + j * NZ;
            for (int i = 0; i < NZ; i++) row[i] = -Y[j * NZ + i];
            for (int a = j + 1; a < NU; a++) for (int i = 0; i < NZ; i++) row[i] -= L[a * NU + j] * G[a * NZ + i];
            for (int i = 0; i < NZ; i++) row[i] *= L[j * NU + j];
        }
        for (int j = 0; j < NU; j++) {
            sum += g[NX + j] * G[j * NZ + NX];
            square += G[j * NZ + NX] * G[j * NZ + NX];
        }
        /* V = Qzz - Y'Y - mu_r G'G */
        for (int i = 0; i < NX; i++) {
            V value = g[i];
            for (int j = 0; j < NU; j++) value -= Y[j * NZ + i] * Y[j * NZ + NX];
            if (regular) for (int j = 0; j < NU; j++) value -= s->mu_r * G[j * NZ + i] * G[j * NZ + NX];
            vector[i] = value;
            for (int l = i; l < NX; l++) {
                V entry = H[i * S + l];
                for (int j = 0; j < NU; j++) entry -= Y[j * NZ + i] * Y[j * NZ + l];
                if (regular) for (int j = 0; j < NU; j++) entry -= s->mu_r * G[j * NZ + i] * G[j * NZ + l];
                P[i * NX + l] = P[l * NX + i] = entry;
            }
        }
    }
    *linear = sum; *squares = square; *lowest = least;
}

/* Whether all that the backward pass reads is finite. */
static I is_finite(const Lanes *s) {
    const Problem *p = s->of;
    V g[S], H[S * S], f[NJ ? NJ : 1], sum = SET(0.0);
    for (int64_t k = 0; k <= p->N; k++) {
        const V *x = s->X + k * NX, *u = s->U + k * NU;
        memset(g, 0, sizeof g); memset(H, 0, sizeof H);
        knot_expand(s, k, x, u, g, H);
        for (int i = 0; i < S; i++) sum += SET(0.0) * g[i];
        for (int i = 0; i < S * S; i++) sum += SET(0.0) * H[i];
        if (k == p->N) break;
        tgco_jacobian(x, u, s->parameters, f);
        for (int i = 0; i < NJ; i++) sum += SET(0.0) * f[i];
    }
    return sum == SET(0.0);
}

/* One iteration of all lanes -------------------------------------------------------------------------------------- */

/* Commit the trial of lane from[l] to lane l where `won`. */
static void commit(Lanes *s, I won, const int *from, V alpha, V cost, V merit) {
    int64_t N = s->of->N;
    I index;
    for (int l = 0; l < LANES; l++) index[l] = from[l];
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->X[i] = tgco_choose(won, __builtin_shuffle(s->Xn[i], index), s->X[i]);
    for (int64_t i = 0; i < N * NU; i++) s->U[i] = tgco_choose(won, __builtin_shuffle(s->Un[i], index), s->U[i]);
    s->cost = tgco_choose(won, __builtin_shuffle(cost, index), s->cost);
    s->merit = tgco_choose(won, __builtin_shuffle(merit, index), s->merit);
    s->alpha = tgco_choose(won, __builtin_shuffle(alpha, index), s->alpha);
}

/* The line search (lines 14-24) of the lanes `moving`. Lanes of one element, `replicas` of them, try rungs side by side. */
static I search(Lanes *s, I moving, V linear, V quadratic, V *shortest) {
    const Problem *p = s->of;
    int replicas = p->replicas;
    I open = moving, done = moving & ~moving;
    *shortest = SET(0.0);
    for (int64_t first = 0; first < p->rungs && any(open); first += replicas) {
        V alpha, cost, merit;
        for (int l = 0; l < LANES; l++) {
            int64_t rung = first + l % replicas;
            alpha[l] = p->ladder[rung < p->rungs ? rung : p->rungs - 1];
        }
        roll(s, alpha, &cost, &merit);
        V ratio = (merit - s->merit) / (alpha * linear + SET(0.5) * alpha * alpha * quadratic);
        I good = (ratio >= SET(p->ratio_min)) & (ratio <= SET(p->ratio_max));
        if (p->accept_last) good |= alpha < SET(p->smallest);
        good &= finite(merit) & open;
        *shortest = tgco_choose(open, merit, *shortest);
        int from[LANES];
        I won;
        for (int e = 0; e < LANES; e += replicas) {
            int winner = -1;
            for (int l = e; l < e + replicas && winner < 0; l++) if (good[l]) winner = l;
            for (int l = e; l < e + replicas; l++) {
                from[l] = winner < 0 ? l : winner;
                won[l] = winner < 0 ? 0 : -1;
            }
            /* The last rung of an element that refuses all is in its last lane. */
            for (int l = e; l < e + replicas; l++) (*shortest)[l] = (*shortest)[e + replicas - 1];
        }
        if (any(won)) commit(s, won, from, alpha, cost, merit);
        open &= ~won;
        done |= won;
    }
    return done;
}

/* Returns the lanes that are done: their status, and whether they converged, were refused, or lost their way. */
static I iterate(Lanes *s, I running, int32_t *status, I *converged, I *refused, I *lost) {
    const Problem *p = s->of;
    V linear, squares, lowest, zero = SET(0.0), old = s->merit, shortest;
    s->alpha = zero;
    s->used = s->mu_r;
    backward(s, &linear, &squares, &lowest);
    V quadratic = -linear - s->mu_r * squares, before = s->mu_r;
    I failed = ~(lowest > zero) & running;
    V expected = tgco_fabs(linear + SET(0.5) * quadratic);
    I settled = expected <= SET(p->rounding) * tgco_fabs(old);
    I moving = running & ~failed & ~settled;
    for (int l = 0; l < LANES; l++) status[l] = GOING;
    if (any(failed)) {
        V higher = s->mu_r * SET(p->growth);
        higher = tgco_choose(higher < SET(p->first), SET(p->first), higher);
        s->mu_r = tgco_choose(failed, higher, s->mu_r);
        I sound = is_finite(s);
        for (int l = 0; l < LANES; l++) if (failed[l]) {
            if (s->mu_r[l] > p->most) status[l] = NOT_POSITIVE_DEFINITE;
            if (!sound[l]) status[l] = NON_FINITE;
        }
    }
    I accepted = search(s, moving, linear, quadratic, &shortest);
    *refused = moving & ~accepted;
    s->inner += tgco_truth(running & ~failed);
    s->made += tgco_truth(running & ~failed);
    /* mu_r of the next iteration */
    V next = zero;
    if (p->damping > 0) {
        V up = SET(10.0) * before, down = before / SET(3.0);
        up = tgco_choose(up < SET(p->damping), SET(p->damping), up);
        up = tgco_choose(up > SET(p->most), zero, up);
        next = tgco_choose(*refused, up, tgco_choose(down < SET(p->damping), zero, down));
    }
    s->mu_r = tgco_choose(failed | ~running, s->mu_r, next);
    I stuck = *refused & (s->mu_r == zero);
    V change = tgco_fabs(s->merit - old);
    V larger = tgco_choose(change > expected, change, expected);
    I flat = (larger <= SET(p->tolerance) * tgco_fabs(s->merit)) & ~(before > SET(p->damping));
    *converged = running & ~failed & (settled | (moving & ~*refused & (flat | (change < SET(p->absolute_tolerance)))));
    *lost = *refused & ~(shortest <= SET(p->lost_beyond) * tgco_fabs(old));
    *lost &= s->inner <= SET(1.0);
    if (p->damping == 0) *lost = *lost & ~*lost;
    I over = running & ~failed & (*converged | stuck | (s->inner >= SET((double)p->max_iterations)));
    *refused = stuck;
    for (int l = 0; l < LANES; l++) if (over[l]) status[l] = ENDED;
    I limit = running & (*lost | (s->made >= SET((double)p->limit)));
    for (int l = 0; l < LANES; l++) if (status[l] != GOING) limit[l] = -1;
    return limit & running;
}

/* Elements first, first + 1, ..., last - 1: up to `limit` iterations of each inner solve. Returns 0 without memory. */
int tgco_ilqr(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    int replicas = p->replicas;
    I running = SET(0.0) != SET(0.0);
    int64_t next = first;
    for (int e = 0; e < LANES; e += replicas) {
        /* Lanes without an element repeat the first one, so that no work is done on what isn't finite. */
        int64_t element = next < last ? next : first;
        for (int l = e; l < e + replicas; l++) {
            enter(s, l, element);
            running[l] = next < last ? -1 : 0;
        }
        if (next < last) next++;
    }
    while (any(running)) {
        int32_t status[LANES];
        I converged, refused, lost, ended;
        ended = iterate(s, running, status, &converged, &refused, &lost);
        for (int e = 0; e < LANES; e += replicas) {
            if (!ended[e]) continue;
            leave(s, e, status[e], converged[e] != 0, refused[e] != 0, lost[e] != 0);
            for (int l = e; l < e + replicas; l++) {
                if (next < last) enter(s, l, next);
                else running[l] = 0;
            }
            if (next < last) next++;
        }
    }
    finish(s);
    return 1;
}

/* J_var and L_M of given trajectories. */
int tgco_value(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) enter(s, l, e + l < last ? e + l : e);
        V total = SET(0.0), more = SET(0.0), part;
        for (int64_t k = 0; k <= p->N; k++) {
            total += knot_value(s, k, s->X + k * NX, k < p->N ? s->U + k * NU : 0, &part);
            more += part;
        }
        for (int l = 0; l < LANES && e + l < last; l++) {
            p->cost[e + l] = total[l];
            p->merit[e + l] = total[l] + more[l];
        }
    }
    finish(s);
    return 1;
}

/* One backward pass along given trajectories: gains (E, N, NU, NZ) and the two sums of the expected change. */
int tgco_gains(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) enter(s, l, e + l < last ? e + l : e);
        V linear, squares, lowest;
        backward(s, &linear, &squares, &lowest);
        V quadratic = -linear - s->mu_r * squares;
        for (int l = 0; l < LANES && e + l < last; l++) {
            p->cost[e + l] = linear[l];
            p->merit[e + l] = quadratic[l];
            p->status[e + l] = !(lowest[l] > 0);
            for (int64_t i = 0; i < p->N * NU * NZ; i++) p->gains[(e + l) * p->N * NU * NZ + i] = s->G[i][l];
        }
    }
    finish(s);
    return 1;
}

/* Rollout of U from the first knot of X. */
int tgco_open_loop(const Problem *p, int64_t first, int64_t last) {
    int64_t N = p->N;
    V parameters[NP ? NP : 1], x[2 * NX], u[NU];
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) {
            int64_t element = e + l < last ? e + l : e;
            fill(parameters, &p->parameters, 1, l, element);
            for (int i = 0; i < NX; i++) x[i][l] = p->X[element * (N + 1) * NX + i];
        }
        for (int64_t k = 0; k < N; k++) {
            for (int l = 0; l < LANES; l++) {
                int64_t element = e + l < last ? e + l : e;
                for (int j = 0; j < NU; j++) u[j][l] = p->U[(element * N + k) * NU + j];
            }
            model_step(x, u, parameters, x + NX);
            memcpy(x, x + NX, NX * sizeof(V));
            for (int l = 0; l < LANES && e + l < last; l++)
                for (int i = 0; i < NX; i++) p->X[((e + l) * (N + 1) + k + 1) * NX + i] = x[i][l];
        }
    }
    return 1;
}
