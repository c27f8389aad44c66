/* Functions that Python calls on the problems first, ..., last - 1 with given trajectories: values, expansions,
   rollouts, `lift`, and inner solves. They return 0 without memory. */
#include "lifted.h"
#include "rollout.h"

/* J_var and L_M of given trajectories. */
static void put_values(Lanes *s, int64_t e, int used) {
    V total, merit = merit_of(s, &total);
    for (int l = 0; l < used; l++) {
        s->of->cost[e + l] = LANE(total, l);
        s->of->merit[e + l] = LANE(merit, l);
    }
}
int tgco_value(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter), CALLED(put_values));
}

/* Rollout of U from the first knot of X. */
int tgco_open_loop(const Problem *p, int64_t first, int64_t last) { return roll_out(p, first, last, 0); }

/* Rollout of U + K (x - X) from the first knot of X, in place of X and U; gains (E, N, NU, NZ), of which K is used. */
int tgco_closed_loop(const Problem *p, int64_t first, int64_t last) { return roll_out(p, first, last, 1); }

/* The same, and J_var and L_M along it. */
int tgco_begin(const Problem *p, int64_t first, int64_t last) {
    return roll_out(p, first, last, 0) && tgco_value(p, first, last);
}

/* Gradients (E, N+1, S) and upper triangles of the Hessians (E, N+1, S, S) of all terms. */
static void put_expansion(Lanes *s, int64_t e, int used) {
    const Problem *p = s->of;
    for (int64_t k = 0; k <= p->N; k++) {
        V g[S], H[S * S];
        memset(g, 0, sizeof g); memset(H, 0, sizeof H);
        IN x = s->X + k * NX; IN u = k < p->N ? s->U + k * NU : 0;
        cost_expand(s, k, x, u, g, H);
        knot_expand(s, k, x, u, g, H);
        for (int l = 0; l < used; l++) {
            int64_t at = (e + l) * (p->N + 1) + k;
            for (int i = 0; i < S; i++) p->slopes[at * S + i] = LANE(g[i], l);
            for (int i = 0; i < S * S; i++) p->curvatures[at * S * S + i] = LANE(H[i], l);
        }
    }
}
int tgco_expand(const Problem *p, int64_t first, int64_t last) {
    return put_all(p, first, last, CALLED(enter), CALLED(put_expansion));
}

/* How many numbers of a lane these functions and tgco_outer have room for. */
int64_t tgco_solver_room(const Problem *p) {
    Lanes lanes, *s = &lanes;
    memset(s, 0, sizeof *s);
    s->of = p;
    return lay_out(s, 0) + 1 + p->N * NX; /* with the gaps of `lift` */
}

/* Up to `limit` iterations of inner solves. */
int tgco_ilqr(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    int64_t *number = in_order(p, first, last);
    if (!number || !start(s, p)) { give(p, number); return 0; }
    inner_solves(s, number, last - first);
    give(p, number);
    finish(s);
    return 1;
}

/* The same from the rollout of U, where that is finite. */
int tgco_descend(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    int64_t size = (p->N + 1) * NX, count = 0, *number = in_order(p, first, last);
    if (!number || !tgco_begin(p, first, last) || !start(s, p)) { give(p, number); return 0; }
    for (int64_t e = first; e < last; e++) {
        double sum = 0 * p->merit[e];
        for (int64_t i = 0; i < size; i++) sum += 0 * p->X[e * size + i];
        if (sum == 0) number[count++] = e;
        else p->status[e] = NON_FINITE;
    }
    if (count) inner_solves(s, number, count);
    give(p, number);
    finish(s);
    return 1;
}

/* `lift` of problems first, ..., last - 1. */
int tgco_lift(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    int64_t *number = in_order(p, first, last);
    if (!number || !start(s, p)) { give(p, number); return 0; }
    int done = lift(s, number, last - first, p->limit, p->gain);
    give(p, number);
    finish(s);
    return done;
}
