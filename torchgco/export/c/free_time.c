/* A free time: factors of the stages' length among the states and controls of the solver, and plans some seconds later. */

typedef char NAME_has_room_for_plans[
    ROOM_NUMBERS >= (N + 1) * (2 * USER_NX + 2 * USER_NU + 5 + NX) + 2 * N * NU + MOST_MULTIPLIERS ? 1 : -1];

/* The segment of stage k; the last knot counts to the last stage. */
static int segment_of(int k) {
    int s = 0;
    while (s + 1 < SEGMENTS && first_stage[s + 1] <= k) s++;
    return s;
}

/* The bounds of the factor of segment s: of the first in the start, of others where they are chosen. */
static void factor_bounds(const Solve *b, int s, double *least, double *most) {
    *least = 0; *most = INFINITY;
    for (int64_t i = USER_CONSTRAINTS; i < b->problem.constraints; i++) {
        double lower, upper;
        int k = s ? first_stage[s] - 1 : 0;
        const Constraint *con = b->problem.constraint + i;
        if (!is_kind(con, BOUNDS) || con->place[k] == NOWHERE) continue;
        bounds_at(con, k, s ? NX + USER_NU : USER_NX, &lower, &upper);
        if (lower > *least) *least = lower;
        if (upper < *most) *most = upper;
    }
}

/* A factor within its bounds; what is no number becomes the least. */
static double within_factors(const Solve *b, int s, double factor) {
    double least, most;
    factor_bounds(b, s, &least, &most);
    return factor > most ? most : factor >= least ? factor : least;
}

/* The factors in states x of the solver. */
static void factors_in(const double *x, double *factor) {
    for (int s = 0; s < SEGMENTS; s++) factor[s] = x[first_stage[s] * NX + USER_NX];
}

/* Factors into states and controls of the solver. */
static void put_factors(double *x, double *u, const double *factor) {
    for (int k = 0; k <= N; k++) x[k * NX + USER_NX] = factor[segment_of(k < N ? k : N - 1)];
    for (int k = 0; k < N && NU > USER_NU; k++) {
        int s = segment_of(k), next = segment_of(k + 1 < N ? k + 1 : k);
        u[k * NU + NU - 1] = next == s ? 1 : factor[next];
    }
}

/* The times of the knots. */
static void times_of(const double *factor, double *t) {
    t[0] = 0;
    for (int k = 0; k < N; k++) t[k + 1] = t[k] + STAGE * factor[segment_of(k)];
}

/* The factors of the times of knots. */
static void factors_of(const Solve *b, const double *t, double *factor) {
    for (int s = 0; s < SEGMENTS; s++) {
        int first = first_stage[s], last = first_stage[s + 1];
        factor[s] = within_factors(b, s, (t[last] - t[first]) / (STAGE * (last - first)));
    }
}

/* Knots of what is left of a plan after some seconds: where each lies among the knots of before, the length of its stage
   as a multiple of that of the one that it lies in, and the factors. */
typedef struct { double factor[SEGMENTS], *t, *place, *length; } Left;

static Left left_of(Solve *b, const double *factor, double seconds) {
    const Problem *p = &b->problem;
    Left left;
    double ends[SEGMENTS], end = 0, *later;
    int under_way = 0;
    left.t = take(p, (N + 1) * sizeof *left.t); left.place = take(p, (N + 1) * sizeof *left.t);
    left.length = take(p, (N + 1) * sizeof *left.t); later = take(p, (N + 1) * sizeof *later);
    for (int s = 0; s < SEGMENTS; s++) {
        ends[s] = end += STAGE * (first_stage[s + 1] - first_stage[s]) * factor[s];
        if (end <= seconds && s + 1 < SEGMENTS) under_way = s + 1;
    }
    double rest = ends[under_way] - seconds, even = (rest > 0 ? rest : 0) / (STAGE * first_stage[under_way + 1]);
    for (int s = 0; s < SEGMENTS; s++) left.factor[s] = s <= under_way ? even : factor[s];
    times_of(factor, left.t);
    times_of(left.factor, later);
    for (int k = 0; k <= N; k++) later[k] = seconds + later[k];
    for (int k = 0; k <= N; k++) {
        int at = 0;
        while (at + 1 < N && left.t[at + 1] <= later[k]) at++;
        double stage = left.t[at + 1] - left.t[at], share = (later[k] - left.t[at]) / stage;
        left.place[k] = at + (share > 0 ? share < 1 ? share : 1 : 0);
        left.length[k] = (k < N ? later[k + 1] - later[k] : later[N] - later[N - 1]) / stage;
    }
    for (int s = 0; s < SEGMENTS; s++) left.factor[s] = within_factors(b, s, left.factor[s]);
    return left;
}

/* The factors of what is left of the plan that is flown. */
static void factors_left(const NAME_workspace *w, Solve *b, double *left) {
    double factor[SEGMENTS];
    factors_of(b, w->t, factor);
    b->arena.next = b->arena_begin;
    Left now = left_of(b, factor, w->age);
    memcpy(left, now.factor, sizeof factor);
}

/* Number i of `width` at a place among `count` knots, on the straight line between two. */
static double between(const double *values, int count, int width, int i, double place) {
    int k = (int)place, last = count > 1 ? count - 2 : 0;
    if (k > last) k = last;
    double share = place - k;
    return (1 - share) * values[k * width + i] + share * values[(k + 1) * width + i];
}

/* States x and controls u of the solver at the knots of what is left; controls are means over its stages. */
static void move(const Left *left, const Problem *p, double *x, double *u) {
    double *old = take(p, (N + 1) * USER_NX * sizeof *old), *held = take(p, N * USER_NU * sizeof *held);
    double *added = take(p, (N + 1) * USER_NU * sizeof *added), *over = take(p, (N + 1) * sizeof *over);
    for (int k = 0; k <= N; k++) for (int i = 0; i < USER_NX; i++) old[k * USER_NX + i] = x[k * NX + i];
    for (int k = 0; k <= N; k++)
        for (int i = 0; i < USER_NX; i++) x[k * NX + i] = between(old, N + 1, USER_NX, i, left->place[k]);
    for (int k = 0; k < N; k++) for (int j = 0; j < USER_NU; j++) {
        int to = (k + 1) * USER_NU + j;
        held[k * USER_NU + j] = u[k * NU + j];
        added[to] = added[to - USER_NU] + u[k * NU + j] * (left->t[k + 1] - left->t[k]);
    }
    for (int k = 0; k < N; k++) over[k + 1] = over[k] + (left->t[k + 1] - left->t[k]);
    for (int k = 0; k < N; k++) {
        double from = left->place[k], to = left->place[k + 1];
        double lasts = between(over, N + 1, 1, 0, to) - between(over, N + 1, 1, 0, from);
        int stage = from < N - 1 ? (int)from : N - 1;
        for (int j = 0; j < USER_NU; j++) {
            double sum = between(added, N + 1, USER_NU, j, to) - between(added, N + 1, USER_NU, j, from);
            u[k * NU + j] = lasts > 0 ? sum / lasts : held[stage * USER_NU + j];
        }
    }
}

/* Multipliers of rows whose knots follow each other, as those of the same times; they are of the lengths of the stages. */
static void move_multipliers(const Left *left, Solve *b, const Constraint *con) {
    int first = 0, count = (int)con->knots, width = con->rows;
    while (first < N && con->place[first] == NOWHERE) first++;
    if (count < 2 || width == 0) return;
    for (int j = 0; j < count; j++) if (first + j > N || con->place[first + j] != j) return;
    unsigned char *next = b->arena.next;
    double *old = take(&b->problem, count * width * sizeof *old);
    memcpy(old, con->lam, count * width * sizeof *old);
    for (int j = 0; j < count; j++) {
        double place = left->place[first + j] - first;
        place = place > 0 ? place < count - 1 ? place : count - 1 : 0;
        for (int i = 0; i < width; i++)
            con->lam[j * width + i] = left->length[first + j] * between(old, count, width, i, place);
    }
    b->arena.next = next;
}

/* The iterate and its multipliers begin so many seconds later. */
static void elapse(NAME_workspace *w, Solve *b, double seconds) {
    double factor[SEGMENTS];
    b->arena.next = b->arena_begin;
    factors_in(w->x, factor);
    Left left = left_of(b, factor, seconds);
    move(&left, &b->problem, w->x, w->u);
    put_factors(w->x, w->u, left.factor);
#if CARRIED
    carry(b, w->x, w->u);
#endif
    for (int i = 0; i < USER_CONSTRAINTS; i++) move_multipliers(&left, b, b->constraints + i);
}

/* The states of the plan that is flown at its age, after part of stage *k, which is given back. */
static void planned_states(const NAME_workspace *w, const Solve *b, double *x, int *k) {
    const Problem *p = &b->problem;
    V parameters[NP ? NP : 1], state[2 * NX], u[NU];
    *k = 0;
    while (*k + 1 < N && w->t[*k + 1] <= w->age) ++*k;
    double stage = w->t[*k + 1] - w->t[*k], share = (w->age - w->t[*k]) / stage;
    if (share > 1 - KNOT_ROUNDING && *k + 1 < N) { ++*k; share = 0; }
    share = share > KNOT_ROUNDING ? share < 1 ? share : 1 : 0;
    for (int i = 0; i < NX; i++) LANE(state[i], 0) = i < USER_NX ? w->X[*k * USER_NX + i] : share * (stage / STAGE);
    for (int j = 0; j < NU; j++) LANE(u[j], 0) = j < USER_NU ? w->U[*k * USER_NU + j] : 1;
    fill_stage(parameters, &p->parameters, p->parameters.knot ? *k : 0, 0, 0);
    if (share > 0) model_step(state, u, parameters, p->shared, state + NX);
    for (int i = 0; i < USER_NX; i++) x[i] = LANE(state[(share > 0 ? NX : 0) + i], 0);
}
