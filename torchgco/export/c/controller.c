/* The controller ------------------------------------------------------------------------------------------------ */

static double seconds_of(const void *arena) {
    double (*seconds)(void) = ((const Arena *)arena)->seconds;
    return seconds ? seconds() : 0;
}

static int all_finite(const double *values, int count) {
    double sum = 0;
    for (int i = 0; i < count; i++) sum += 0 * values[i];
    return sum == 0;
}

/* The place of the numbers of knot k `by` stages later: the last one beyond the end, the knot's own where there is none. */
static int later_place(const int32_t *place, int last, int k, int by) {
    if (k + by > last) return place ? place[last] : last;
    if (!place) return k + by;
    return place[k + by] == NOWHERE ? place[k] : place[k + by];
}

/* Numbers at `count` knots, or at those that `place` says, begin `by` stages later; parts of a stage take the straight line
   between what whole stages give. */
static void shift(double *values, const int32_t *place, int count, int width, double by) {
    int last = count - 1, whole = by < count ? (int)by : count;
    double share = by - floor(by);
    while (place && last > 0 && place[last] == NOWHERE) last--;
    for (int k = 0; k <= last; k++) { /* what is read has a later place: nothing is overwritten too early */
        if (place && place[k] == NOWHERE) continue;
        double *to = values + (place ? place[k] : k) * width;
        memmove(to, values + later_place(place, last, k, whole) * width, width * sizeof *values);
    }
    for (int k = 0; share > 0 && k <= last; k++) {
        if (place && place[k] == NOWHERE) continue;
        double *now = values + (place ? place[k] : k) * width, *next = values + later_place(place, last, k, 1) * width;
        for (int i = 0; i < width; i++) {
            double later = next[i] * share, before = (1 - share) * now[i];
            now[i] = later + before;
        }
    }
}

/* A whole number of stages where it is one but for rounding. */
static double rounded(double stages) {
    double whole = floor(stages + 0.5), size = stages > 1 ? stages : 1;
    return fabs(stages - whole) <= STAGE_ROUNDING * size ? whole : stages;
}

/* The bounds of variable v by constraint `con` at knot k; infinite where there are none. */
static void bounds_at(const Constraint *con, int64_t k, int v, double *lower, double *upper) {
    const double *limit = con->bound.data + (con->bound.knot ? con->place[k] * con->bound.size : 0);
    *lower = -INFINITY; *upper = INFINITY;
    for (int j = 0; j < con->rows; j++) {
        if (con->variable[j] != v || fabs(limit[j]) >= LOOSE) continue;
        *(con->sign[j] > 0 ? upper : lower) = limit[j];
    }
}

/* The first `count` controls u within their bounds at knot k, but for those that cross; what is no number becomes 0
   first. */
static void clamp(const Solve *b, int64_t k, int count, double *u) {
    const Problem *p = &b->problem;
    for (int j = 0; j < count; j++) if (u[j] != u[j]) u[j] = 0;
    for (int side = -1; side <= 1; side += 2)
        for (int64_t i = 0; i < p->constraints; i++) {
            const Constraint *con = p->constraint + i;
            if (!is_kind(con, BOUNDS) || con->place[k] == NOWHERE) continue;
            for (int j = 0; j < count; j++) {
                double lower, upper;
                bounds_at(con, k, NX + j, &lower, &upper);
                if (lower > upper) continue;
                if (side < 0 ? u[j] < lower : u[j] > upper) u[j] = side < 0 ? lower : upper;
            }
        }
}

@CARRIED@
/* Whether one of the numbers is one that the problem can't have; 2: a bound is. */
static int has_bad_number(const NAME_workspace *w, const Solve *b) {
    const double *numbers = (const double *)(const void *)&w->numbers;
    const double *exported = (const double *)(const void *)(exported_numbers + ELEMENT(w));
    if (!HAS_ELEMENT(w)) return 2;
    for (int i = 0; i < (int)(sizeof checks / sizeof *checks); i++)
        for (int j = checks[i].first; j < checks[i].first + checks[i].count; j++) {
            int kind = checks[i].kind, is_finite_number = numbers[j] - numbers[j] == 0;
            /* Free parts of a goal, and bounds that were infinite, have no rows. */
            if (exported[j] != exported[j] && numbers[j] != numbers[j]) continue;
            if (exported[j] - exported[j] != 0 && numbers[j] != exported[j]) return kind == BOUND ? 2 : 1;
            if (numbers[j] != numbers[j] || (kind != BOUND && !is_finite_number)) return kind == BOUND ? 2 : 1;
            if ((kind == AT_LEAST_ZERO && numbers[j] < 0) || (kind == ABOVE_ZERO && numbers[j] <= 0)) return 1;
        }
#if SEGMENTS
    for (int i = 0; i < (int)(sizeof steady / sizeof *steady); i++)
        for (int j = steady[i].width; j < N * steady[i].width; j++)
            if (numbers[steady[i].first + j] != numbers[steady[i].first + j - steady[i].width]) return 1;
#endif
#if CARRIED
    if (rates_cross(b)) return 2;
#endif
    for (int64_t i = 0; i < b->problem.constraints; i++) {
        const Constraint *con = b->problem.constraint + i;
        if (!is_kind(con, BOUNDS)) continue;
        for (int64_t k = 0; k < (con->bound.knot ? con->knots : 1); k++) {
            const double *limit = con->bound.data + k * con->bound.knot;
            for (int j = 0; j < con->rows; j++) for (int l = j + 1; l < con->rows; l++)
                if (are_a_pair(con, j, l) && limit[j] < limit[l]) return 2;
        }
    }
    return 0;
}

/* What is done with a variable at a knot, z, that has bounds. */
typedef void Within(double *z, double lower, double upper);

static void each_bounded(const Problem *p, int controls_alone, Within *within, double *X, double *U) {
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        for (int64_t k = 0; is_kind(con, BOUNDS) && k <= p->N; k++) {
            if (con->place[k] == NOWHERE) continue;
            for (int v = controls_alone ? NX : 0; v < NX + NU; v++) {
                double lower, upper;
                bounds_at(con, k, v, &lower, &upper);
                if (lower > -INFINITY || upper < INFINITY)
                    within(v < NX ? X + k * NX + v : U + k * NU + v - NX, lower, upper);
            }
        }
    }
}

/* Moves a variable inside of its bounds, by a share of its size or range at most. */
static void push_inside(double *z, double lower, double upper) {
    double half = 0.5 * (upper - lower), a = fabs(lower) > 1 ? fabs(lower) : 1, c = fabs(upper) > 1 ? fabs(upper) : 1;
    double low = lower == -INFINITY ? 0 : COLD_PUSH * (a < half ? a : half);
    double high = upper == INFINITY ? 0 : COLD_PUSH * (c < half ? c : half);
    if (*z < lower + low) *z = lower + low;
    if (*z > upper - high) *z = upper - high;
}

/* The middle of two bounds, and within one. */
static void to_middle(double *z, double lower, double upper) {
    if (lower > -INFINITY && upper < INFINITY) *z = 0.5 * (lower + upper);
    else if (*z < lower) *z = lower;
    else if (*z > upper) *z = upper;
}

/* What a trajectory X, U costs, and by how much it violates the constraints; returns 0 without memory. */
static int judge(Solve *b, double *X, double *U, double *cost, double *violation) {
    I caught;
    b->follow.X = X; b->follow.U = U;
    b->arena.next = b->arena_begin;
    LOCAL(Lanes, s, &b->follow);
    if (!s || !start(s, &b->follow)) return 0;
    enter_iterate(s, 0, 0);
    *violation = swept(s, 0, 0, SET(0.0), &caught).violation;
    *cost = 0;
    for (int64_t k = 0; k <= N; k++) *cost += cost_value(s, k, s->X + k * NX, k < N ? s->U + k * NU : 0);
    finish(s);
    return 1;
}

/* What is given of the first states X is that of x, and what is carried. */
static void set_start(const Solve *b, double *X, const double *x) {
    for (int i = 0; i < USER_NX; i++) if (!b->how.free_start || b->how.free_start[i] == 0) X[i] = x[i];
#if CARRIED
    memcpy(X + NX - CARRIED, b->carried, CARRIED * sizeof *X);
#endif
}

/* `count` rows of so many numbers, of which arrays have more or fewer. */
static void copy_rows(double *to, int width, const double *from, int from_width, int count) {
    for (int k = 0; k < count; k++)
        for (int i = 0; i < width && i < from_width; i++) to[k * width + i] = from[k * from_width + i];
}

/* Rollout of U, or with feedback of U + K (x - X), into b->X, b->U, from the states x. */
static void follow(Solve *b, const double *x, const double *X, const double *U, int feedback) {
    memcpy(b->X, X, (N + 1) * NX * sizeof *X); memcpy(b->U, U, N * NU * sizeof *U);
    set_start(b, b->X, x);
    b->follow.X = b->X; b->follow.U = b->U;
    roll_out(&b->follow, 0, 1, feedback);
}

/* Whether trajectories are one, up to rounding along the stages. */
static int is_rounding(const double *old, const double *new) {
    for (int i = 0; i < NX; i++) {
        double most = 0;
        for (int k = 0; k <= N; k++) if (fabs(old[k * NX + i]) > most) most = fabs(old[k * NX + i]);
        for (int k = 0; k <= N; k++)
            if (!(fabs(new[k * NX + i] - old[k * NX + i]) <= ROUNDINGS * LAST_BIT * most)) return 0;
    }
    return 1;
}

@FREE_TIME@
static int is_finite_rollout(const Solve *b) { return all_finite(b->X, (N + 1) * NX) && all_finite(b->U, N * NU); }

/* How a solve is to be made. */
typedef struct { double mu, push; int warm, minimum; } How;
static const How FROM_PLAN = {WARM_MU, WARM_PUSH, 1, 0}, FROM_GUESS = {COLD_MU, WARM_PUSH, 1, 0};
static const How FROM_REST = {COLD_MU, COLD_PUSH, 0, 1};

/* One solve from the iterate w->x, w->u and its multipliers, in place: b->X, b->U is the rollout that it stands for, and
   w->violation its. Returns whether it is a solution. */
static int run(NAME_workspace *w, Solve *b, How how, double until) {
    int left = w->max_iterations > 0 ? w->max_iterations - w->iterations : b->most;
    double cost;
    b->how.max_iter = left < b->most ? left : b->most;
    b->how.seconds = until - seconds_of(&b->arena);
    b->how.bound_push = how.push; b->how.warm = how.warm; b->how.minimum = how.minimum;
    b->mu = how.mu; b->iterations = 0; b->status = RUNNING; b->falls = 0;
    b->arena.next = b->arena_begin;
    memset(b->gains, 0, sizeof b->gains);
    b->arena.end = b->arena_end;
    if (!tgco_interior(&b->how, 0, 1)) b->status = NON_FINITE;
    b->arena.end = (unsigned char *)b->X;
    w->iterations += (int)b->iterations;
    if (b->status == MAX_ITERATIONS && w->max_iterations > 0 && w->iterations >= w->max_iterations) b->status = TIME_LIMIT;
    for (int i = 0; i < N * NU * NZ; i++) if (!(b->gains[i] - b->gains[i] == 0)) b->gains[i] = 0;
    follow(b, w->x, w->x, w->u, 1);
    if (!how.warm && !is_rounding(w->x, b->X)) { /* stiff rows: rounding decides on the gains */
        follow(b, w->x, w->x, w->u, 0);
        if (!is_rounding(w->x, b->X)) follow(b, w->x, w->x, w->u, 1);
    }
    if (!judge(b, b->X, b->U, &cost, &w->violation)) b->status = NON_FINITE;
    b->cost = cost;
    return b->status == CONVERGED && w->violation <= VIOLATION && is_finite_rollout(b);
}

static void no_multipliers(NAME_workspace *w) {
@NO_MULTIPLIERS@
}

/* Whether no time or iteration of the step is left. */
static int is_over(const NAME_workspace *w, const Solve *b, double until) {
    return !(until - seconds_of(&b->arena) > 0) || (w->max_iterations > 0 && w->iterations >= w->max_iterations);
}

/* What was found is the plan from now on. */
static void fly(NAME_workspace *w, const Solve *b) {
    copy_rows(w->X, USER_NX, b->X, NX, N + 1); copy_rows(w->U, USER_NU, b->U, NU, N);
    for (int k = 0; k < N; k++) copy_rows(w->K + k * USER_NU * USER_NX, USER_NX, b->gains + k * NU * NZ, NZ, USER_NU);
#if SEGMENTS
    double factor[SEGMENTS];
    factors_in(b->X, factor);
    times_of(factor, w->t);
#endif
    w->age = 0;
}

/* The states that a solve from rest begins with: x, also where the start is free, and the factors of time. */
static void guess_start(NAME_workspace *w, const Solve *b, const double *x) {
    memcpy(w->x, x, USER_NX * sizeof *x);
#if SEGMENTS
    put_factors(w->x, w->u, b->factor);
#else
    (void)b;
#endif
}

/* Controls at rest, within their bounds, into w->u, and where they lead to from x, into w->x. */
static void rest(NAME_workspace *w, Solve *b, const double *x) {
    memcpy(w->u, b->rest, sizeof w->u); memcpy(b->beside, w->u, sizeof w->u);
    each_bounded(&b->problem, 1, to_middle, w->x, b->beside);
    guess_start(w, b, x);
    int middle = 0;
    for (int64_t k = 0; k < N; k++) {
        double held[NU];
        memcpy(held, w->u + k * NU, sizeof held);
        clamp(b, k, NU, held);
        for (int j = 0; j < NU; j++) middle |= held[j] != w->u[k * NU + j];
    }
    follow(b, x, w->x, w->u, 0);
    if (middle || !is_finite_rollout(b)) {
        memcpy(w->u, b->beside, sizeof w->u);
        guess_start(w, b, x);
        follow(b, x, w->x, w->u, 0);
    }
    memcpy(w->x, b->X, sizeof w->x);
}

/* A solve from the controls w->u without multipliers, whose rollout is w->x. */
static int cold(NAME_workspace *w, Solve *b, const double *x, double until) {
    no_multipliers(w);
    each_bounded(&b->problem, 0, push_inside, w->x, w->u);
    set_start(b, w->x, x);
    return run(w, b, FROM_REST, until);
}

@CONTACT@
/* Controls beside a saddle point, by an uneven share of their size or range. */
static void step_beside(const Solve *b, double share, double *u) {
    for (int j = 0; j < NU; j++) {
        double size = 1, lower, upper, range = -INFINITY;
        for (int k = 0; k < N; k++) if (fabs(u[k * NU + j]) > size) size = fabs(u[k * NU + j]);
        for (int64_t i = 0; i < b->problem.constraints; i++) {
            const Constraint *con = b->problem.constraint + i;
            for (int64_t k = 0; is_kind(con, BOUNDS) && k < N; k++) {
                if (con->place[k] == NOWHERE) continue;
                bounds_at(con, k, NX + j, &lower, &upper);
                if (upper - lower > range) range = upper - lower;
            }
        }
        double half = range >= 0 && range < INFINITY ? 0.5 * range : size;
        for (int k = 0; k < N; k++) {
            double part = GOLDEN * (k * NU + j + 1);
            u[k * NU + j] += share * half * (2 * (part - floor(part)) - 1);
        }
    }
}

/* From rest; where the conditions of first order hold but the cost falls to second order, from beside, too. Returns the
   status of what is found, in b->X and b->U. */
static int from_rest_once(NAME_workspace *w, Solve *b, const double *x, double until) {
    static const double shares[] = {SADDLE_FIRST, SADDLE_LAST};
    double guess_cost, guess_violation, cost, largest = 0;
    if (starts_inside(b, x)) return INVALID_START;
    rest(w, b, x);
    if (!judge(b, w->x, w->u, &guess_cost, &guess_violation)) return NON_FINITE;
    int solved = cold(w, b, x, until), again = 0;
    cost = b->cost;
    for (int i = 0; i < 2 && solved && b->falls > 0; i++) {
        memcpy(b->beside, b->U, sizeof w->u);
        step_beside(b, shares[i], b->beside);
        guess_start(w, b, x);
        memcpy(w->u, b->beside, sizeof w->u);
        follow(b, x, w->x, w->u, 0);
        memcpy(w->x, b->X, sizeof w->x);
        again = !(cold(w, b, x, until) && b->cost < cost - STATIONARY * fabs(cost));
        if (!again) { cost = b->cost; continue; }
        rest(w, b, x); /* the first solution once more: to solve again takes no memory */
        solved = cold(w, b, x, until);
    }
    if (solved) return CONVERGED;
    for (int i = 0; i < N * NU; i++) if (fabs(b->U[i]) > largest) largest = fabs(b->U[i]);
    double violation = w->violation <= LAST_BIT * largest ? 0 : w->violation;
    int sound = b->cost - b->cost == 0 && violation - violation == 0 && is_finite_rollout(b), status = b->status;
    int fits = sound && violation <= VIOLATION, guess_fits = guess_violation <= VIOLATION;
    int better = guess_fits ? !fits || guess_cost < b->cost : !fits && guess_violation < violation;
    if (guess_cost - guess_cost == 0 && guess_violation - guess_violation == 0 && (better || !sound)) {
        rest(w, b, x);
        no_multipliers(w);
        memset(b->gains, 0, sizeof b->gains);
        w->violation = guess_violation;
        fits = guess_fits;
    } else if (!sound) return NON_FINITE;
    if (status == CONVERGED) status = MAX_ITERATIONS; /* but for its violation */
    return (fits || w->violation <= ADMITTED) && CONSTRAINED ? FEASIBLE : status;
}

#if SEGMENTS
/* At the time that the solve begins with, roughly; then it is free. Freed at once it may shrink until no trajectory is
   left. Returns the status of what is found, in b->X and b->U. */
static int from_held_time(NAME_workspace *w, Solve *b, const double *x, double until) {
    for (int again = 0; again < 2; again++) {
        double tolerance = b->how.tol;
        rest(w, b, x);
        b->free_start[USER_NX] = 0; b->how.tol = ROUGH; b->most = FEW;
        cold(w, b, x, until);
        b->free_start[USER_NX] = 1; b->how.tol = tolerance; b->most = MAX_SOLVE_ITERATIONS;
        if (!(w->violation <= VIOLATION) || !is_finite_rollout(b)) return b->status == CONVERGED ? MAX_ITERATIONS : b->status;
        if (again) return FEASIBLE; /* for this time alone */
        memcpy(w->x, b->X, sizeof w->x); memcpy(w->u, b->U, sizeof w->u);
        if (cold(w, b, x, until)) return CONVERGED;
    }
    return b->status;
}
#endif

/* The same; where the time is free and nothing is found, with the time held at first, and with twice the time. */
static int from_rest(NAME_workspace *w, Solve *b, const double *x, double until) {
#if SEGMENTS
    memcpy(b->factor, b->first_factor, sizeof b->factor);
    if (w->age >= 0) {
        factors_left(w, b, b->factor);
        for (int s = 0; s < SEGMENTS; s++) b->factor[s] *= LONGER;
    }
    for (int s = 0; s < SEGMENTS; s++) b->factor[s] = within_factors(b, s, b->factor[s]);
    for (;;) {
        int longer = 0, status;
        b->most = FEW;
        status = from_rest_once(w, b, x, until);
        b->most = MAX_SOLVE_ITERATIONS;
        if (status == CONVERGED || status == INVALID_START || is_over(w, b, until)) return status;
        status = from_held_time(w, b, x, until);
        if (status == CONVERGED || status == FEASIBLE || is_over(w, b, until)) return status;
        for (int s = 0; s < SEGMENTS; s++) {
            double twice = within_factors(b, s, 2 * b->factor[s]);
            longer |= twice > b->factor[s];
            b->factor[s] = twice;
        }
        if (!longer) return status;
    }
#else
    return from_rest_once(w, b, x, until);
#endif
}

/* The plan that is flown as the iterate, from now on, with its feedback in b->gains. */
static void plan_before(NAME_workspace *w, Solve *b) {
    memset(b->gains, 0, sizeof b->gains); memset(w->x, 0, sizeof w->x);
    copy_rows(w->x, NX, w->X, USER_NX, N + 1); copy_rows(w->u, NU, w->U, USER_NU, N);
#if SEGMENTS
    double factor[SEGMENTS];
    factors_of(b, w->t, factor);
    put_factors(w->x, w->u, factor);
    b->arena.next = b->arena_begin;
    Left left = left_of(b, factor, w->age);
    move(&left, &b->problem, w->x, w->u);
    put_factors(w->x, w->u, left.factor);
    for (int k = 0; k < N; k++) for (int j = 0; j < USER_NU; j++) for (int i = 0; i < USER_NX; i++)
        b->gains[(k * NU + j) * NZ + i] = between(w->K, N, USER_NU * USER_NX, j * USER_NX + i, left.place[k]);
#else
    double age = rounded(w->age);
    copy_rows(b->gains, NZ, w->K, USER_NX, N * NU);
    shift(w->x, 0, N + 1, NX, age); shift(w->u, 0, N, NU, age); shift(b->gains, 0, N, NU * NZ, age);
#endif
}

/* Again from what the plan before leads to now, as far as it keeps the constraints. */
static int from_plan_before(NAME_workspace *w, Solve *b, const double *x, double until) {
    double cost, violation;
    if (w->age < 0) return 0;
    plan_before(w, b);
    if (!RATED) { /* feedback could break the bounds of rates */
        follow(b, x, w->x, w->u, 1);
        memcpy(w->u, b->U, sizeof w->u);
    }
    for (int64_t k = 0; k < N; k++) {
        clamp(b, k, NU, w->u + k * NU);
#if CARRIED
        clamp_rates(b, k, w->u + (k ? k - 1 : 0) * NU, SEGMENTS ? w->x[k * NX + USER_NX] : 1, w->u + k * NU);
#endif
    }
    follow(b, x, w->x, w->u, 0);
    memcpy(w->x, b->X, sizeof w->x);
    no_multipliers(w);
    if (!judge(b, w->x, w->u, &cost, &violation) || !(violation <= ADMITTED)) return 0;
    return run(w, b, FROM_GUESS, until);
}

@MEANS@
/* The controls for the next period of the plan that was found. */
static void flown(const NAME_workspace *w, const Solve *b, double *u) {
    mean_controls(w, 0, w->period, u);
    clamp(b, 0, USER_NU, u);
}

/* The controls of the plan before with feedback on x, where x is known; without a plan, those at rest. */
static void hold(const NAME_workspace *w, const Solve *b, const double *x, double *u) {
#if SEGMENTS
    int k = 0;
    memcpy(u, b->rest, USER_NU * sizeof *u);
    if (w->age >= 0) {
        double planned[USER_NX];
        planned_states(w, b, planned, &k);
        mean_controls(w, w->age, w->period, u);
        if (w->period <= 0) memcpy(u, w->U + k * USER_NU, USER_NU * sizeof *u);
        for (int j = 0; x && j < USER_NU; j++)
            for (int i = 0; i < USER_NX; i++) u[j] += w->K[(k * USER_NU + j) * USER_NX + i] * (x[i] - planned[i]);
    }
#else
    double age = rounded(w->age), share = age - (int)age, means[USER_NU];
    int k = age < N - 1 ? (int)age : N - 1, later = k + 1 < N ? k + 1 : N - 1;
    int knot = age < N ? (int)age : N, next = knot + 1 < N + 1 ? knot + 1 : N;
    int several = w->age >= 0 && w->period > knot_time(w, 1); /* stages are flown in a period */
    if (several) mean_controls(w, age * knot_time(w, 1), w->period, means);
    for (int j = 0; j < NU; j++) {
        u[j] = b->rest[j];
        if (w->age < 0) continue;
        u[j] = several ? means[j] : w->U[k * NU + j];
        if (!several && share > 0) u[j] = w->U[later * NU + j] * share + (1 - share) * u[j];
        for (int i = 0; x && !RATED && i < USER_NX; i++) {
            double K = w->K[(k * NU + j) * USER_NX + i], X = w->X[knot * USER_NX + i];
            if (share > 0) {
                K = w->K[(later * NU + j) * USER_NX + i] * share + (1 - share) * K;
                X = w->X[next * USER_NX + i] * share + (1 - share) * X;
            }
            u[j] += K * (x[i] - X);
        }
    }
#endif
    if (w->age >= 0) clamp(b, k, USER_NU, u);
#if CARRIED && !SEGMENTS
    clamp_rates(b, 0, 0, 1, u);
#endif
    clamp(b, 0, USER_NU, u);
}

/* The iterate begins as much later as time has gone on: stages, or seconds where the time is free. */
static void go_on(NAME_workspace *w, Solve *b, double moved) {
#if SEGMENTS
    elapse(w, b, moved);
#else
    double by = rounded(moved);
    (void)b;
    shift(w->x, 0, N + 1, NX, by); shift(w->u, 0, N, NU, by);
@SHIFTS@
#endif
}

void NAME_reset(NAME_workspace *w) {
    memset(w->X, 0, sizeof w->X); memset(w->U, 0, sizeof w->U); memset(w->K, 0, sizeof w->K);
#if SEGMENTS
    memset(w->t, 0, sizeof w->t);
#endif
    memset(w->x, 0, sizeof w->x); memset(w->u, 0, sizeof w->u);
    no_multipliers(w);
    w->age = -1;
    w->begun = w->able = 0;
    w->status = RUNNING; w->held = w->warm = w->iterations = 0; w->violation = 0;
#ifdef PREVIOUS
    const double *exported = (const double *)(const void *)(exported_numbers + unknown(ELEMENT(w)));
    memcpy((double *)(void *)&w->numbers + PREVIOUS, exported + PREVIOUS, sizeof w->before);
#endif
#if HAS_PLAN
    int e = ELEMENT(w);
    NAME_guess(w, plan_X + e * (N + 1) * USER_NX, plan_U + e * N * USER_NU, plan_t + e * (N + 1));
#endif
}

void NAME_init(NAME_workspace *w@OF_ELEMENT@) {
    memset(w, 0, sizeof *w);
@OWN@
    int e = unknown(ELEMENT(w));
    memcpy(&w->numbers, exported_numbers + e, sizeof w->numbers);
    NAME_reset(w);
}

void NAME_guess(NAME_workspace *w, const double *X, const double *U@OF_TIMES@) {
    copy_rows(w->x, NX, X, USER_NX, N + 1); copy_rows(w->u, NU, U, USER_NU, N);
#if SEGMENTS || CARRIED
    Solve *b = (Solve *)(void *)w->room;
    bind(w, b);
#endif
#if SEGMENTS
    double factor[SEGMENTS];
    factors_of(b, t, factor);
    put_factors(w->x, w->u, factor);
#endif
#if CARRIED
    carry(b, w->x, w->u);
#endif
    no_multipliers(w);
    w->able = 2;
}

static int stepped(NAME_workspace *w, const double *x, double moved, double max_seconds, double *u) {
    Solve *b = (Solve *)(void *)w->room;
    bind(w, b);
    double until = seconds_of(&b->arena) + max_seconds;
    int good = 0, late = 0, guessed = w->able == 2, fits = moved >= 0 && moved - moved == 0;
    int bad = has_bad_number(w, b);
    int status = !fits || !all_finite(x, USER_NX) ? NAME_BAD_STATE : bad ? NAME_BAD_NUMBER : RUNNING;
    w->warm = w->iterations = 0;
    if (fits && w->age >= 0) w->age += moved;
    if (fits && w->begun && !guessed && moved > 0) go_on(w, b, moved);
    if (status < 0) {
        hold(w, b, status == NAME_BAD_STATE || bad == 2 ? 0 : x, u); /* without bounds feedback has no end */
        w->held = 1;
        return status;
    }
    set_start(b, w->x, x);
    if (w->able && !(guessed && starts_inside(b, x))) {
        w->warm = good = run(w, b, guessed ? FROM_GUESS : FROM_PLAN, until);
        status = good ? CONVERGED : b->status;
        late = status == TIME_LIMIT && is_finite_rollout(b);
    }
    if (!good && !late && w->begun && from_plan_before(w, b, x, until)) { good = 1; status = CONVERGED; }
    if (!good && !late && w->begun && is_over(w, b, until)) status = TIME_LIMIT;
    else if (!good && !late) {
        status = from_rest(w, b, x, until);
        good = status == CONVERGED || status == FEASIBLE;
        memcpy(w->x, b->X, sizeof w->x); memcpy(w->u, b->U, sizeof w->u);
    }
    w->begun = 1;
    w->able = good || status == TIME_LIMIT;
    w->held = !good;
    if (good) { fly(w, b); flown(w, b, u); }
    else hold(w, b, x, u);
    return status;
}

int NAME_step(NAME_workspace *w, const double x[USER_NX], double moved, double max_seconds, double u[USER_NU]) {
#ifdef PREVIOUS
    double *previous = (double *)(void *)&w->numbers + PREVIOUS;
    if (moved == 0 && w->begun) memcpy(previous, w->before, sizeof w->before); /* once more for the same time */
    else memcpy(w->before, previous, sizeof w->before);
#endif
    w->status = stepped(w, x, moved, max_seconds, u);
#ifdef PREVIOUS
    memcpy(previous, u, sizeof w->before);
#endif
    return w->status;
}
