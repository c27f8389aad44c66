/* Functions that Python calls on given trajectories: values, expansions, gains, rollouts, and `lift`. */

/* J_var and L_M of given trajectories. */
int tgco_value(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) enter(s, l, e + l < last ? e + l : e);
        V total = SET(0.0), more = SET(0.0);
        for (int64_t k = 0; k <= p->N; k++) {
            const V *x = s->X + k * NX, *u = k < p->N ? s->U + k * NU : 0;
            total += cost_value(s, k, x, u);
            more += knot_value(s, k, x, u);
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
        backward(s, knot_expand, NULL, &linear, &squares, &lowest);
        V quadratic = -linear - s->mu_r * squares;
        for (int l = 0; l < LANES && e + l < last; l++) {
            p->cost[e + l] = linear[l];
            p->merit[e + l] = quadratic[l];
            p->status[e + l] = lowest[l] > 0 ? RUNNING : NOT_POSITIVE_DEFINITE;
            for (int64_t i = 0; i < p->N * NU * NZ; i++) p->gains[(e + l) * p->N * NU * NZ + i] = s->G[i][l];
        }
    }
    finish(s);
    return 1;
}

/* Rollout from the first knot of X, in place: of U, or with feedback of U + K (x - X), in place of U, too. */
static inline __attribute__((always_inline)) int roll_out(const Problem *p, int64_t first, int64_t last, int feedback) {
    int64_t N = p->N;
    V parameters[NP ? NP : 1], x[2 * NX], u[NU];
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) {
            int64_t element = e + l < last ? e + l : e;
            fill_stage(parameters, &p->parameters, 0, l, element);
            for (int i = 0; i < NX; i++) x[i][l] = p->X[element * (N + 1) * NX + i];
        }
        for (int64_t k = 0; k < N; k++) {
            for (int l = 0; l < LANES; l++) {
                int64_t element = e + l < last ? e + l : e;
                if (p->parameters.knot) fill_stage(parameters, &p->parameters, k, l, element);
                double *X = p->X + (element * (N + 1) + k) * NX, *U = p->U + (element * N + k) * NU;
                const double *K = feedback ? p->gains + (element * N + k) * NU * NZ : NULL;
                for (int j = 0; j < NU; j++) {
                    u[j][l] = U[j];
                    for (int i = 0; feedback && i < NX; i++) u[j][l] += K[j * NZ + i] * (x[i][l] - X[i]);
                }
            }
            for (int l = 0; l < LANES && e + l < last; l++) {
                for (int j = 0; feedback && j < NU; j++) p->U[((e + l) * N + k) * NU + j] = u[j][l];
                for (int i = 0; i < NX; i++) p->X[((e + l) * (N + 1) + k) * NX + i] = x[i][l];
            }
            model_step(x, u, parameters, p->shared, x + NX);
            memcpy(x, x + NX, NX * sizeof(V));
        }
        for (int l = 0; l < LANES && e + l < last; l++)
            for (int i = 0; i < NX; i++) p->X[((e + l) * (N + 1) + N) * NX + i] = x[i][l];
    }
    return 1;
}

/* Rollout of U from the first knot of X. */
int tgco_open_loop(const Problem *p, int64_t first, int64_t last) { return roll_out(p, first, last, 0); }

/* Rollout of U + K (x - X) from the first knot of X, in place of X and U; gains (E, N, NU, NZ), of which K is used. */
int tgco_closed_loop(const Problem *p, int64_t first, int64_t last) { return roll_out(p, first, last, 1); }

/* Gradients (E, N+1, S) and upper triangles of the Hessians (E, N+1, S, S) of all terms. */
int tgco_expand(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    if (!start(s, p)) return 0;
    for (int64_t e = first; e < last; e += LANES) {
        for (int l = 0; l < LANES; l++) enter(s, l, e + l < last ? e + l : e);
        for (int64_t k = 0; k <= p->N; k++) {
            V g[S], H[S * S];
            memset(g, 0, sizeof g); memset(H, 0, sizeof H);
            const V *x = s->X + k * NX, *u = k < p->N ? s->U + k * NU : 0;
            cost_expand(s, k, x, u, g, H);
            knot_expand(s, k, x, u, g, H);
            for (int l = 0; l < LANES && e + l < last; l++) {
                int64_t at = (e + l) * (p->N + 1) + k;
                for (int i = 0; i < S; i++) p->slopes[at * S + i] = g[i][l];
                for (int i = 0; i < S * S; i++) p->curvatures[at * S * S + i] = H[i][l];
            }
        }
    }
    finish(s);
    return 1;
}

/* Up to `rounds` Gauss-Newton steps in states and controls together, where rollouts diverge (solvers/lifted.py). The
   first rollout that lowers L_M by the share `gain` replaces the iterate; `converged` says whether there was one. */
static int lift(Lanes *s, const int64_t *number, int64_t count, int64_t rounds, double gain) {
    const Problem *p = s->of;
    int64_t N = p->N;
    V *gap = aligned_alloc(sizeof(V), N * NX * sizeof(V));
    if (!gap) return 0;
    for (int64_t first = 0; first < count; first += LANES) {
        int used = count - first < LANES ? (int)(count - first) : LANES;
        for (int l = 0; l < LANES; l++) enter(s, l, number[first + (l < used ? l : 0)]);
        s->mu_r = SET(0.0);
        I open = SET(0.0) == SET(0.0);
        for (int64_t round = 0; round < rounds && any(open); round++) {
            V linear, squares, lowest, cost, merit, sum = SET(0.0);
            gaps(s, gap);
            backward(s, knot_expand, gap, &linear, &squares, &lowest);
            if (round > 0) { /* the first gains are those that failed */
                roll(s, knot_value, SET(1.0), SET(__builtin_inf()), &cost, &merit);
                I low = open & finite(merit) & (merit < s->merit - SET(gain) * tgco_fabs(s->merit));
                for (int l = 0; l < used; l++) if (low[l]) {
                    int64_t e = s->element[l];
                    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = s->Xn[i][l];
                    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = s->Un[i][l];
                    p->cost[e] = cost[l]; p->merit[e] = merit[l]; p->converged[e] = 1;
                }
                open &= ~low;
            }
            linear_step(s, gap);
            for (int64_t i = 0; i < (N + 1) * NX; i++) sum += SET(0.0) * s->X[i];
            open &= (lowest > SET(0.0)) & (sum == SET(0.0));
        }
    }
    free(gap);
    return 1;
}

/* The same of problems first, ..., last - 1. */
int tgco_lift(const Problem *p, int64_t first, int64_t last) {
    Lanes lanes, *s = &lanes;
    int64_t *number = in_order(first, last);
    if (!number || !start(s, p)) { free(number); return 0; }
    int done = lift(s, number, last - first, p->limit, p->gain);
    free(number);
    finish(s);
    return done;
}
