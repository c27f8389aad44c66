/* The outer loop of the augmented Lagrangian (Algorithm 1): inner solves of all problems, then multipliers, penalties
   and the tests of the end, until each has ended. solvers/augmented_lagrangian.py does the same in PyTorch. */
#include "lifted.h"
#include "sweep.h"

/* Whether a trajectory of problem e counts as feasible and arrived. */
static int arrived(const Outer *o, int64_t e, double violation, const double *X) {
    double square = 0;
    if (!o->near || !(violation <= o->tolerance)) return 0;
#if DIM > 0
    const double *last = X + (e * (o->of->N + 1) + o->of->N) * NX + POSITION;
    for (int a = 0; a < DIM; a++) square += (last[a] - o->goal[e * DIM + a]) * (last[a] - o->goal[e * DIM + a]);
#endif
    return sqrt(square) <= o->near[e];
}

/* Whether the iterate of problem e replaces its best: `is_preferred` in lagrangian/quality.py. */
static int preferred(const Outer *o, int64_t e, double violation) {
    double cost = o->of->cost[e], before = o->best_violation[e];
    int fits = violation <= o->tolerance, did = before <= o->tolerance;
    int now = arrived(o, e, violation, o->of->X), then = arrived(o, e, before, o->best_X);
    if (now != then) return now;
    return fits ? !did || cost < o->best_cost[e] : !did && violation < before;
}

TGCO_LARGE void keep(const Outer *o, int64_t e, double violation) {
    const Problem *p = o->of;
    int64_t N = p->N;
    memcpy(o->best_X + e * (N + 1) * NX, p->X + e * (N + 1) * NX, (N + 1) * NX * sizeof(double));
    memcpy(o->best_U + e * N * NU, p->U + e * N * NU, N * NU * sizeof(double));
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *c = p->constraint + i;
        int64_t size = c->knots * c->rows;
        memcpy(c->best + e * size, c->lam + e * size, size * sizeof(double));
    }
    o->best_mu[e] = p->mu[e]; o->best_cost[e] = p->cost[e]; o->best_violation[e] = violation;
}

/* Why problem e ends after an inner solve that left `violation`; RUNNING where it goes on. */
static int64_t tested(const Outer *o, int64_t e, double violation, int caught) {
    const Problem *p = o->of;
    double cost = p->cost[e];
    int fits = violation <= o->tolerance;
    int64_t why = RUNNING;
    if (o->outer[e] >= o->max_outer) why = p->refused[e] ? LINE_SEARCH_FAILED : MAX_ITERATIONS;
    int settled = fabs(cost - o->last_cost[e]) <= o->settled * fabs(cost);
    if (o->ends && p->converged[e] && settled && fits) why = CONVERGED;
    return why == RUNNING && o->stops && caught ? STOPPED : why;
}

/* Multipliers, penalty, best iterate and the tests of the end of up to LANES problems; then L_M of the next inner solve.
   A problem that has failed only gets its violation. */
TGCO_LARGE void outer_update(Lanes *s, const Outer *o, const int64_t *number, int count, int failed) {
    const Problem *p = s->of;
    V least, total;
    I caught;
    for (int l = 0; l < LANES; l++) {
        int64_t e = number[l < count ? l : 0];
        enter(s, l, e);
        LANE(least, l) = o->single_after >= 0 && o->base[e] + o->outer[e] + 1 >= o->single_after ? 1 : 2;
    }
    V violation = swept(s, 0, !failed, least, &caught).violation;
    for (int l = 0; l < count && !failed; l++) {
        int64_t e = number[l];
        double growth = o->growth;
        if (o->ends && LANE(violation, l) <= o->tolerance) growth = 1;
        LANE(s->mu, l) *= growth;
        if (LANE(s->mu, l) > o->penalty_max) LANE(s->mu, l) = o->penalty_max;
        LANE(s->inverse_mu, l) = 1 / LANE(s->mu, l);
        p->mu[e] = LANE(s->mu, l);
        for (int64_t i = 0; i < p->constraints; i++) {
            const Constraint *c = p->constraint + i;
            double *lam = c->lam + e * c->knots * c->rows;
            for (int64_t k = 0; k < c->knots; k++, lam += c->rows) {
                IN next = s->rows[i].lam + k * c->rows;
                if (LANE(s->rows[i].pushed[k], l)) for (int j = 0; j < c->rows; j++) lam[j] = LANE(next[j], l);
                else memset(lam, 0, c->rows * sizeof *lam);
            }
        }
        if (preferred(o, e, LANE(violation, l))) keep(o, e, LANE(violation, l));
        o->outer[e]++;
        o->outcome[e] = tested(o, e, LANE(violation, l), LANE(caught, l) != 0);
        o->last_cost[e] = p->cost[e];
    }
    int going = 0;
    for (int l = 0; l < count; l++) {
        int64_t e = number[l];
        going |= o->outcome[e] == RUNNING;
        if (o->outcome[e] != RUNNING && !(o->best_violation[e] <= DBL_MAX)) keep(o, e, LANE(violation, l));
    }
    if (!going) return;
    V merit = merit_of(s, &total);
    for (int l = 0; l < count; l++) {
        int64_t e = number[l];
        p->cost[e] = LANE(total, l); p->merit[e] = LANE(merit, l);
        p->regularisation[e] = 0; p->inner[e] = p->rung[e] = 0;
    }
}

/* Inner solves of the `count` running problems, lifted where rollouts diverge; `some` has room for as many numbers.
   Returns 0 without memory. */
static int solve_all(Lanes *s, const Outer *o, const int64_t *running, int64_t count, int64_t *some) {
    const Problem *p = s->of;
    int64_t lost = 0;
    inner_solves(s, running, count);
    for (int64_t i = 0; i < count; i++) if (p->lost[running[i]]) some[lost++] = running[i];
    if (lost && !lift(s, some, lost, o->lifted_steps, o->lifted_gain)) return 0;
    for (int64_t i = 0; i < lost; i++) {
        int64_t e = some[i];
        if (!p->converged[e]) continue;
        p->converged[e] = 0; p->regularisation[e] = 0;
        if (p->inner[e] >= p->options.max_iterations) p->status[e] = ENDED;
    }
    return 1;
}

/* Outer iterations of the problems whose inner solve has ended, and the end of those where it failed. */
static void update_all(Lanes *s, const Outer *o, const int64_t *running, int64_t count, int64_t *some) {
    const Problem *p = s->of;
    for (int failed = 0; failed < 2; failed++) {
        int64_t chosen = 0;
        for (int64_t i = 0; i < count; i++) {
            int64_t e = running[i];
            if (p->status[e] == RUNNING || (p->status[e] != ENDED) != failed) continue;
            if (failed) o->outcome[e] = p->status[e];
            some[chosen++] = e;
        }
        for (int64_t i = 0; i < chosen; i += LANES)
            outer_update(s, o, some + i, chosen - i < LANES ? (int)(chosen - i) : LANES, failed);
    }
}

/* Up to `passes` passes over the problems first, ..., last - 1 that have no outcome yet. Returns 0 without memory. */
int tgco_outer(const Outer *o, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    Problem problem = *o->of;
    int64_t *running = in_order(o->of, first, last), *some = in_order(o->of, first, last);
    int begun = running && some && start(s, &problem), done = begun;
    for (int64_t pass = 0; done && pass < o->passes; pass++) {
        int64_t count = 0;
        for (int64_t e = first; e < last; e++) if (o->outcome[e] == RUNNING) running[count++] = e;
        if (count == 0) break;
        problem.replicas = 1;
        while (problem.replicas * 2 * count <= LANES) problem.replicas *= 2;
        if (o->solves) done = solve_all(s, o, running, count, some);
        if (o->updates && done) update_all(s, o, running, count, some);
    }
    if (begun) finish(s);
    give(o->of, some); give(o->of, running);
    return done;
}
