/* What returned trajectories are judged by: violations, clearance, gains and what a step could still save, costates, and the
   rollouts that solves stand for. Functions return 0 without memory. */
#include "cholesky.h"
#include "lifted.h"
#include "sweep.h"

/* The largest violation of given trajectories, into `merit`. */
static void put_violation(Lanes *s, int64_t e, int used) {
    I caught;
    V violation = swept(s, 0, 0, SET(0.0), &caught).violation;
    for (int l = 0; l < used; l++) s->of->merit[e + l] = LANE(violation, l);
}
int tgco_violation(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter_iterate), CALLED(put_violation));
}

/* The same of rows of obstacles alone. */
static void put_penetration(Lanes *s, int64_t e, int used) {
    I caught;
    V violation = swept(s, 1, 0, SET(0.0), &caught).violation;
    for (int l = 0; l < used; l++) s->of->merit[e + l] = LANE(violation, l);
}
int tgco_penetration(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter_iterate), CALLED(put_penetration));
}

/* Whether slightly other controls lead to other states than rounding would. */
TGCO_LARGE I is_sensitive(const Lanes *s) {
    const Problem *p = s->of;
    V largest[NU], x[2 * NX], u[NU], apart = SET(0.0), size = SET(0.0);
    for (int j = 0; j < NU; j++) largest[j] = SET(0.0);
    for (int64_t i = 0; i < p->N * NU; i++) largest[i % NU] = tgco_maximum(largest[i % NU], tgco_fabs(s->U[i]));
    for (int64_t i = 0; i < (p->N + 1) * NX; i++) size = tgco_maximum(size, tgco_fabs(s->X[i]));
    memcpy(x, s->X, NX * sizeof(V));
    for (int64_t k = 0; k < p->N; k++) {
        for (int j = 0; j < NU; j++) u[j] = s->U[k * NU + j] + SET(p->nudge) * largest[j];
        model_step(x, u, model_at(s, k), p->shared, x + NX);
        for (int i = 0; i < NX; i++) apart = tgco_maximum(apart, tgco_fabs(x[NX + i] - s->X[(k + 1) * NX + i]));
        memcpy(x, x + NX, NX * sizeof(V));
    }
    return NOT(apart <= SET(p->gain) * tgco_choose(size < SET(p->nudge), SET(p->nudge), size));
}

/* One backward pass along given trajectories: gains (E, N, NU, NZ) and the two sums of the expected change. Where they are
   asked for also the largest violation, the sum of |lam c| over inequalities with c < 0, and whether the trajectory is
   sensitive. */
static void put_gains(Lanes *s, int64_t e, int used) {
    const Problem *p = s->of;
    int64_t size = p->N * NU * NZ;
    V linear, squares, lowest;
    I caught, sensitive = SET(0.0) != SET(0.0);
    Sweep sweep = {SET(0.0), SET(0.0), SET(0.0), 0};
    if (p->sensitive) sensitive = is_sensitive(s);
    if (p->slack) sweep = swept(s, 0, 0, SET(0.0), &caught);
    backward(s, CALLED(knot_expand), NONE, &linear, &squares, &lowest);
    V quadratic = -linear - s->mu_r * squares;
    for (int l = 0; l < used; l++) {
        p->cost[e + l] = LANE(linear, l);
        p->merit[e + l] = LANE(quadratic, l);
        p->status[e + l] = LANE(lowest, l) > 0 ? RUNNING : NOT_POSITIVE_DEFINITE;
        if (p->slack) { p->slack[e + l] = LANE(sweep.slack, l); p->violation[e + l] = LANE(sweep.violation, l); }
        if (p->sensitive) p->sensitive[e + l] = LANE(sensitive, l) != 0;
        for (int64_t i = 0; i < size; i++) p->gains[(e + l) * size + i] = LANE(s->G[i], l);
    }
}
int tgco_gains(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter), CALLED(put_gains));
}

/* Costates along given trajectories, (E, N+1, NX), by which J_var + lam'c is stationary in the states; into `slopes`. */
static void put_costates(Lanes *s, int64_t e, int used) {
    const Problem *p = s->of;
    int64_t N = p->N;
    V y[NX], g[S], H[S * S], f[NJ ? NJ : 1];
    for (int64_t k = N; k > 0; k--) {
        IN x = s->X + k * NX; IN u = k < N ? s->U + k * NU : 0;
        memset(g, 0, sizeof g); memset(H, 0, sizeof H);
        if (k < N) {
            model_jacobian(x, u, model_at(s, k), p->shared, f);
            model_pull_back(y, f, g);
        }
        cost_expand(s, k, x, u, g, H);
        knot_expand(s, k, x, u, g, H);
        memcpy(y, g, sizeof y);
        for (int l = 0; l < used; l++)
            for (int i = 0; i < NX; i++) p->slopes[((e + l) * (N + 1) + k) * NX + i] = LANE(y[i], l);
    }
}
int tgco_costates(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter), CALLED(put_costates));
}

/* Gains G of the controls by the states, 0 where there is no regulator, and Y of P = H_xx - Y'Y. */
TGCO_LARGE void regulator(IN H, OUT G, OUT Y) {
    V L[TRIANGLE(NU)], pivots[NU];
    I definite = SET(0.0) == SET(0.0);
    factor_controls(H, L, pivots);
    for (int j = 0; j < NU; j++) {
        definite &= pivots[j] > SET(0.0);
        for (int i = 0; i < NX; i++) Y[j * NX + i] = H[i * S + NX + j];
    }
    solve_lower(L, Y, NX, NX);
    for (int i = 0; i < NU * NX; i++) G[i] = -Y[i];
    solve_upper(L, G, NX, NX);
    for (int i = 0; i < NU * NX; i++) { G[i] = tgco_if(definite, G[i]); Y[i] = tgco_if(definite, Y[i]); }
}

/* By how much differences of steps change J_var + lam'c, to first and to second order, into `cost` and `merit`. Of
   [x, 1, t, u] `halves` are steps (E, N, NX+2, S+2) that t times the differences lead elsewhere. Controls answer by the gains
   of the regulator; at stages that have none they stay. What follows the last knot says its slopes, those in `slopes`
   (E, N+1, NX). */
static void put_regulated(Lanes *s, int64_t e, int used) {
    const Problem *p = s->of;
    V P[NX * NX], F[NX * S], T[S], H[S * S], held[S * S], G[NU * NX], Y[NU * NX], away[NX], g[S], by_t[S], v[NX], r[NX];
    V first = SET(0.0), second = SET(0.0);
    for (int64_t k = p->N; k >= 0; k--) {
        IN x = s->X + k * NX; IN u = k < p->N ? s->U + k * NU : 0;
        memset(g, 0, sizeof g); memset(H, 0, sizeof H); memset(held, 0, sizeof held);
        cost_expand(s, k, x, u, g, H);
        knot_expand(s, k, x, u, g, held);
        for (int i = NX; i < S; i++) for (int j = i; j < S; j++) H[i * S + j] += held[i * S + j];
        for (int c = 0; c < S; c++) by_t[c] = SET(0.0);
        for (int i = 0; i < NX; i++) {
            for (int l = 0; l < LANES; l++) {
                int64_t knot = s->element[l] * (p->N + 1) + k;
                const double *row = p->halves + ((knot - s->element[l]) * (NX + 2) + i) * (S + 2);
                if (k == p->N) { LANE(g[i], l) = p->slopes[knot * NX + i]; continue; }
                LANE(away[i], l) = row[NX + 1];
                for (int c = 0; c < S; c++) LANE(F[i * S + c], l) = row[c < NX ? c : c + 2];
            }
        }
        for (int i = 0; k < p->N && i < NX; i++) {
            V push = r[i];
            for (int c = 0; c < S; c++) T[c] = SET(0.0);
            for (int a = 0; a < NX; a++) {
                ADD(push, P[i * NX + a], away[a]);
                for (int c = 0; c < S; c++) ADD(T[c], P[i * NX + a], F[a * S + c]);
            }
            ADD(first, v[i], away[i]);
            ADD(second, SET(0.5) * (r[i] + push), away[i]);
            for (int a = 0; a < S; a++) {
                ADD(g[a], F[i * S + a], v[i]);
                ADD(by_t[a], F[i * S + a], push);
                for (int c = a; c < S; c++) ADD(H[a * S + c], F[i * S + a], T[c]);
            }
        }
        for (int i = 0; i < NU * NX; i++) G[i] = Y[i] = SET(0.0);
        if (k < p->N) regulator(H, G, Y);
        for (int i = 0; i < NX; i++) {
            v[i] = g[i];
            r[i] = by_t[i];
            for (int j = 0; j < NU; j++) { ADD(v[i], G[j * NX + i], g[NX + j]); ADD(r[i], G[j * NX + i], by_t[NX + j]); }
            for (int a = i; a < NX; a++) {
                P[i * NX + a] = H[i * S + a];
                for (int j = 0; j < NU; j++) SUBTRACT(P[i * NX + a], Y[j * NX + i], Y[j * NX + a]);
                P[a * NX + i] = P[i * NX + a];
            }
        }
    }
    for (int l = 0; l < used; l++) { p->cost[e + l] = LANE(first, l); p->merit[e + l] = LANE(second, l); }
}
int tgco_regulated(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter), CALLED(put_regulated));
}

/* What the states and controls of a solve stand for: the rollout U + K (x - X) from the first knot of X, in place, by
   finite gains (E, N, NU, NZ), of which K is used; or that of U alone, where it is X up to rounding and the first isn't.
   Active rows may be so stiff that rounding decides on gains, which then make a change that counts of one in the last
   bit. Its violation into `merit`. */
static I is_rounding(const Lanes *s) {
    int64_t N = s->of->N;
    I same = SET(0.0) == SET(0.0);
    for (int i = 0; i < NX; i++) {
        V size = SET(0.0);
        for (int64_t k = 0; k <= N; k++) size = tgco_maximum(size, tgco_fabs(s->X[k * NX + i]));
        size *= SET(ROUNDINGS * DBL_EPSILON);
        for (int64_t k = 0; k <= N; k++) same &= tgco_fabs(s->Xn[k * NX + i] - s->X[k * NX + i]) <= size;
    }
    return same;
}

TGCO_LARGE void follow(Lanes *s, I by_gains) {
    const Problem *p = s->of;
    memcpy(s->Xn, s->X, NX * sizeof(V));
    for (int64_t k = 0; k < p->N; k++) {
        OUT x = s->Xn + k * NX; OUT u = s->Un + k * NU;
        IN K = s->G + k * NU * NZ;
        for (int j = 0; j < NU; j++) {
            u[j] = k ? s->U[k * NU + j] : s->U[j] + SET(0.0); /* no -0.0 */
            for (int i = 0; i < NX; i++) u[j] += tgco_if(by_gains, K[j * NZ + i]) * (x[i] - s->X[k * NX + i]);
        }
        model_step(x, u, model_at(s, k), p->shared, x + NX);
    }
}

static void enter_followed(Lanes *s, int lane, int64_t e) {
    const Problem *p = s->of;
    int64_t size = p->N * NU * NZ;
    enter_iterate(s, lane, e);
    for (int64_t i = 0; i < size; i++) {
        double K = p->gains[e * size + i];
        LANE(s->G[i], lane) = K - K == 0 ? K : 0;
    }
}

static void put_followed(Lanes *s, int64_t e, int used) {
    int64_t N = s->of->N;
    I all = SET(0.0) == SET(0.0), alone = all;
    follow(s, all);
    alone = NOT(is_rounding(s));
    if (any(alone)) {
        follow(s, NOT(all));
        alone &= is_rounding(s);
        follow(s, NOT(alone));
    }
    memcpy(s->X, s->Xn, (N + 1) * NX * sizeof(V));
    memcpy(s->U, s->Un, N * NU * sizeof(V));
    put_violation(s, e, used);
    for (int l = 0; l < used; l++) {
        for (int64_t i = 0; i < (N + 1) * NX; i++) s->of->X[(e + l) * (N + 1) * NX + i] = LANE(s->Xn[i], l);
        for (int64_t i = 0; i < N * NU; i++) s->of->U[(e + l) * N * NU + i] = LANE(s->Un[i], l);
    }
}
int tgco_follow(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter_followed), CALLED(put_followed));
}

#if DIM > 0
/* Squared distance of the origin from the segment that begins at a and goes along. */
static inline V from_segment(IN a, IN along) {
    V length = SET(0.0), toward = SET(0.0), square = SET(0.0);
    for (int i = 0; i < DIM; i++) { ADD(length, along[i], along[i]); SUBTRACT(toward, a[i], along[i]); }
    V share = tgco_choose(length > SET(0.0), toward / length, SET(0.0));
    share = tgco_choose(share < SET(0.0), SET(0.0), tgco_choose(share > SET(1.0), SET(1.0), share));
    for (int i = 0; i < DIM; i++) { V gap = a[i] + share * along[i]; ADD(square, gap, gap); }
    return square;
}

/* The smallest distance of the straight lines between knots from spheres whose radii are scaled by `gain`, into `merit`;
   infinite without one. Here the lanes are knots: a problem alone takes as long as one of many. */
int tgco_chords(const Problem *p, int64_t first, int64_t last) {
    int64_t N = p->N, blocks = (N + LANES - 1) / LANES;
    Numbers points = take_numbers(p, 2 * DIM * blocks); /* the first and the last one of each line */
    if (!points) return 0;
    for (int64_t e = first; e < last; e++) {
        V least = SET(INFINITY), knot;
        int64_t own = numbers_of(p, e);
        for (int64_t i = 0; i < 2 * DIM * blocks; i++)
            for (int l = 0; l < LANES; l++) {
                int64_t k = i / (2 * DIM) * LANES + l, end = i / DIM % 2;
                LANE(points[i], l) = p->X[(e * (N + 1) + (k < N ? k : N - 1) + end) * NX + POSITION + i % DIM];
            }
        for (int64_t i = 0; i < p->constraints; i++) {
            const Constraint *con = p->constraint + i;
            if (!is_kind(con, SPHERES) || con->moved) continue;
            const double *o = con->bound.data + own * con->bound.element;
            const double *squares = con->squares.data + own * con->squares.element;
            const double *v = con->velocities.data ? con->velocities.data + own * con->velocities.element : NULL;
            double stop = con->stops.data ? con->stops.data[own * con->stops.element] : INFINITY;
            for (int64_t j = 0; j < con->rows; j++, o += DIM, v += v ? DIM : 0) {
                if (!(squares[j] >= 0)) continue;
                V radius = SET(p->gain * sqrt(squares[j])), a[DIM], along[DIM];
                for (int64_t block = 0; block < blocks; block++) {
                    IN from = points + 2 * DIM * block; IN to = from + DIM;
                    for (int l = 0; l < LANES; l++) LANE(knot, l) = block * LANES + l < N ? block * LANES + l : N - 1;
                    for (int d = 0; d < DIM; d++) {
                        V b = to[d] - SET(o[d]);
                        a[d] = from[d] - SET(o[d]);
                        if (v) {
                            SUBTRACT(a[d], knot * SET(con->dt), SET(v[d]));
                            SUBTRACT(b, (knot + SET(1.0)) * SET(con->dt), SET(v[d]));
                        }
                        along[d] = b - a[d];
                    }
                    V gap = tgco_sqrt(from_segment(a, along)) - radius;
                    I closer = ((gap < least) | (gap != gap)) & (knot + SET(1.0) <= SET(stop)); /* NaN stays */
                    least = tgco_choose(closer, gap, least);
                }
            }
        }
        p->merit[e] = LANE(least, 0);
        for (int l = 1; l < LANES; l++) if (LANE(least, l) < p->merit[e] || LANE(least, l) != LANE(least, l)) p->merit[e] = LANE(least, l);
    }
    give(p, points);
    return 1;
}
#endif
