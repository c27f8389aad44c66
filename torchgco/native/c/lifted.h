/* The search that lifts rollouts which diverge (ilqr/lifted.py). */
#pragma once
#include "ilqr.h"

/* Up to `rounds` Gauss-Newton steps in states and controls together, where rollouts diverge (solvers/lifted.py). The
   first rollout that lowers L_M by the share `gain` replaces the iterate; `converged` says whether there was one. */
TGCO_LARGE int lift(Lanes *s, const int64_t *number, int64_t count, int64_t rounds, double gain) {
    const Problem *p = s->of;
    int64_t N = p->N;
    Numbers gap = take_numbers(p, N * NX);
    if (!gap) return 0;
    for (int64_t first = 0; first < count; first += LANES) {
        int used = count - first < LANES ? (int)(count - first) : LANES;
        for (int l = 0; l < LANES; l++) enter(s, l, number[first + (l < used ? l : 0)]);
        s->mu_r = SET(0.0);
        I open = SET(0.0) == SET(0.0);
        for (int64_t round = 0; round < rounds && any(open); round++) {
            V linear, squares, lowest, cost, merit, sum = SET(0.0);
            gaps(s, gap);
            backward(s, CALLED(knot_expand), gap, &linear, &squares, &lowest);
            if (round > 0) { /* the first gains are those that failed */
                roll(s, CALLED(knot_value), SET(1.0), SET(INFINITY), &cost, &merit);
                I low = open & tgco_finite(merit) & (merit < s->merit - SET(gain) * tgco_fabs(s->merit));
                for (int l = 0; l < used; l++) if (LANE(low, l)) {
                    int64_t e = s->element[l];
                    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = LANE(s->Xn[i], l);
                    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = LANE(s->Un[i], l);
                    p->cost[e] = LANE(cost, l); p->merit[e] = LANE(merit, l); p->converged[e] = 1;
                }
                open &= NOT(low);
            }
            linear_step(s, gap);
            for (int64_t i = 0; i < (N + 1) * NX; i++) sum += SET(0.0) * s->X[i];
            open &= (lowest > SET(0.0)) & (sum == SET(0.0));
        }
    }
    give(p, gap);
    return 1;
}
