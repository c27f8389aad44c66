/* What rows of two knots carry along, as the last states of the solver: controls before, whose changes have bounds. */

/* The controls u at knot k so far from those `before` as the bounds of rates allow; pace: the stage's length. Bounds from
   what is no number, and those that cross, don't count. */
static void clamp_rates(const Solve *b, int64_t k, const double *before, double pace, double *u) {
#if RATED
    const int64_t at = b->problem.constraint[RATES].place[k];
    for (int r = 0; r < RATED && at != NOWHERE; r++) {
        int j = rated[r];
        double from = k ? before[j] : b->carried[FIRST_RATED + r];
        double low = from + pace * b->fall[at * FALL_KNOT + j], high = from + pace * b->rise[at * RISE_KNOT + j];
        if (!(low <= high) || low == INFINITY || high == -INFINITY) continue;
        u[j] = u[j] < low ? low : u[j] > high ? high : u[j];
    }
#else
    (void)b; (void)k; (void)before; (void)pace; (void)u;
#endif
}

/* Whether bounds of rates cross. */
static int rates_cross(const Solve *b) {
#if RATED
    for (int64_t k = 0; k < b->problem.constraint[RATES].knots; k++)
        for (int j = 0; j < USER_NU; j++) if (b->fall[k * FALL_KNOT + j] > b->rise[k * RISE_KNOT + j]) return 1;
#else
    (void)b;
#endif
    return 0;
}

/* What is carried along states x whose first ones are known, with controls u. */
static void carry(const Solve *b, double *x, const double *u) {
    const Problem *p = &b->problem;
    V parameters[NP ? NP : 1], state[2 * NX], held[NU];
    memcpy(x + NX - CARRIED, b->carried, CARRIED * sizeof *x);
    for (int64_t k = 0; k < N; k++, x += NX) {
        for (int i = 0; i < NX; i++) LANE(state[i], 0) = x[i];
        for (int j = 0; j < NU; j++) LANE(held[j], 0) = u[k * NU + j];
        fill_stage(parameters, &p->parameters, p->parameters.knot ? k : 0, 0, 0);
        model_step(state, held, parameters, p->shared, state + NX);
        for (int i = NX - CARRIED; i < NX; i++) x[NX + i] = LANE(state[NX + i], 0);
    }
}
