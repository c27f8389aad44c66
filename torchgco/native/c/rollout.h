/* Rollouts of problems side by side. */
#pragma once
#include "memory.h"

/* Rollout from the first knot of X, in place: of U, or with feedback of U + K (x - X), in place of U, too. */
TGCO_INLINE int roll_out(const Problem *p, int64_t first, int64_t last, int feedback) {
    int64_t N = p->N;
    V parameters[NP ? NP : 1], x[2 * NX], u[NU];
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) {
            int64_t element = e + l < last ? e + l : e;
            fill_stage(parameters, &p->parameters, 0, l, numbers_of(p, element));
            for (int i = 0; i < NX; i++) LANE(x[i], l) = p->X[element * (N + 1) * NX + i];
        }
        for (int64_t k = 0; k < N; k++) {
            for (int l = 0; l < LANES; l++) {
                int64_t element = e + l < last ? e + l : e;
                if (p->parameters.knot) fill_stage(parameters, &p->parameters, k, l, numbers_of(p, element));
                double *X = p->X + (element * (N + 1) + k) * NX, *U = p->U + (element * N + k) * NU;
                const double *K = feedback ? p->gains + (element * N + k) * NU * NZ : NULL;
                for (int j = 0; j < NU; j++) {
                    LANE(u[j], l) = U[j];
                    for (int i = 0; feedback && i < NX; i++) LANE(u[j], l) += K[j * NZ + i] * (LANE(x[i], l) - X[i]);
                }
            }
            for (int l = 0; l < LANES && e + l < last; l++) {
                for (int j = 0; feedback && j < NU; j++) p->U[((e + l) * N + k) * NU + j] = LANE(u[j], l);
                for (int i = 0; i < NX; i++) p->X[((e + l) * (N + 1) + k) * NX + i] = LANE(x[i], l);
            }
            model_step(x, u, parameters, p->shared, x + NX);
            memcpy(x, x + NX, NX * sizeof(V));
        }
        for (int l = 0; l < LANES && e + l < last; l++)
            for (int i = 0; i < NX; i++) p->X[((e + l) * (N + 1) + N) * NX + i] = LANE(x[i], l);
    }
    return 1;
}
