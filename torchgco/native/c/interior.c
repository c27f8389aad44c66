/* A primal-dual interior point with a filter (Waechter and Biegler 2006) for problems side by side: states, controls and
   slacks move together, and the lanes are kept filled. solvers/interior says what it does; names are those of the
   paper: theta is the sum of all residuals, phi the cost less mu times the logarithms of the slacks. */

typedef struct { double theta, phi; } Pair;

/* What the globalisation remembers of each lane. */
typedef struct {
    V theta, phi, highest, lowest, last, forced, made, entered, slope, alpha;
    Pair filter[LANES][PAIRS];
    int pairs[LANES], failures[LANES], shortened[LANES], ahead[LANES];
    I restoring, crawls, watching; /* watching: a step was taken on trial; theta, phi, slope and alpha are those before it */
} Track;

static int64_t shape(Barrier *t, V *memory) {
    const Problem *p = t->lanes.of;
    int64_t N = p->N, rows = t->rows;
    V *m = memory;
    t->y = cut(&m, (N + 1) * NX); t->yn = cut(&m, (N + 1) * NX);
    t->gap = cut(&m, N * NX); t->gapn = cut(&m, N * NX); t->aim = cut(&m, N * NX);
    t->H = cut(&m, (N + 1) * S * S); t->f = cut(&m, N * NJ + 1);
    t->cost_slope = cut(&m, (N + 1) * S);
    for (int part = 0; part < PARTS; part++) t->g[part] = cut(&m, (N + 1) * S);
    t->P = cut(&m, (N + 1) * NX * NX); t->p = cut(&m, (N + 1) * NX); t->L = cut(&m, N * NU * NU);
    t->dx = cut(&m, (N + 1) * NX); t->du = cut(&m, N * NU);
    t->c = cut(&m, rows); t->cn = cut(&m, rows); t->s = cut(&m, rows); t->sn = cut(&m, rows); t->z = cut(&m, rows);
    t->r = cut(&m, rows); t->ds = cut(&m, rows); t->dz = cut(&m, rows);
    t->kept = cut(&m, 2 * (N + 1) * NX + N * (NU + NX) + 3 * rows);
    return m - memory;
}

static void finish_barrier(Barrier *t) { free(t->memory); free(t->first); finish(&t->lanes); }

static int start_barrier(Barrier *t, const Interior *how) {
    const Problem *p = how->of;
    memset(t, 0, sizeof *t);
    t->how = how;
    if (!start(&t->lanes, p)) return 0;
    t->first = calloc(p->constraints + 1, sizeof *t->first);
    if (!t->first) { finish(&t->lanes); return 0; }
    for (int64_t i = 0; i < p->constraints; i++) {
        t->first[i] = t->rows;
        t->rows += p->constraint[i].knots * p->constraint[i].rows;
    }
    int64_t count = shape(t, 0);
    t->memory = aligned_alloc(sizeof(V), (count + 1) * sizeof(V));
    if (!t->memory) { finish_barrier(t); return 0; }
    memset(t->memory, 0, (count + 1) * sizeof(V));
    shape(t, t->memory);
    return 1;
}

static inline V most(V a, V b) { return tgco_choose((a > b) | (a != a), a, b); } /* NaN stays */
static inline V least(V a, V b) { return tgco_choose(a < b, a, b); }

/* The statement for every row q of an inequality, or of an equality. */
#define ROWS(t, sense, ...) \
    for (int64_t i_ = 0, q = 0; i_ < (t)->lanes.of->constraints; i_++) { \
        const Constraint *con_ = (t)->lanes.of->constraint + i_; \
        int64_t end_ = q + con_->knots * con_->rows; \
        if (con_->equality != (sense)) { q = end_; continue; } \
        for (; q < end_; q++) { __VA_ARGS__; } \
    }

/* Sum of the logarithms of the slacks, by their product: one logarithm for all rows. */
static V logarithms(const Barrier *t, const V *s) {
    V product = SET(1.0), exponents = SET(0.0);
    int count = 0;
    ROWS(t, 0, {
        product *= s[q];
        if (++count % 8 == 0) {
            I bits = (I)product, exponent = ((bits >> 52) & 0x7ff) - 1023;
            exponents += __builtin_convertvector(exponent, V);
            product = (V)((bits & 0x000fffffffffffffLL) | 0x3ff0000000000000LL);
        }
    })
    return tgco_log(product) + SET(0x1.62e42fefa39efp-1) * exponents;
}

static V size_of(const Barrier *t, const V *gap, const V *r) {
    V sum = SET(0.0);
    for (int64_t i = 0; i < t->lanes.of->N * NX; i++) sum += tgco_fabs(gap[i]);
    for (int64_t q = 0; q < t->rows; q++) sum += tgco_fabs(r[q]);
    return sum;
}

/* Multipliers ---------------------------------------------------------------------------------------------------- */

/* Costates of the lanes `of` that make the Lagrangian stationary in the states; none where they are too large. */
static void adjoin(Barrier *t, I of) {
    const Problem *p = t->lanes.of;
    V largest = SET(0.0), q[S];
    memset(t->yn, 0, (p->N + 1) * NX * sizeof(V));
    for (int64_t k = p->N; k > 0; k--) {
        V *y = t->yn + k * NX;
        for (int i = 0; i < S; i++) q[i] = SET(0.0);
        if (k < p->N) tgco_pull_back(y + NX, t->f + k * NJ, q);
        for (int i = 0; i < NX; i++) {
            y[i] = q[i] + t->g[0][k * S + i];
            largest = most(tgco_fabs(y[i]), largest);
        }
    }
    I sound = largest <= SET(t->how->largest_multiplier);
    for (int64_t i = 0; i < (p->N + 1) * NX; i++) t->y[i] = tgco_choose(of, tgco_if(sound, t->yn[i]), t->y[i]);
}

/* Multipliers anew for the lanes `of`: those of the central path, and none of equalities. */
static void renew(Barrier *t, I of) {
    ROWS(t, 0, t->z[q] = tgco_choose(of, t->mu / t->s[q], t->z[q]))
    ROWS(t, 1, t->z[q] = tgco_choose(of, SET(0.0), t->z[q]))
    V objective = t->objective;
    t->objective = tgco_choose(of, SET(1.0), objective);
    expand(t);
    adjoin(t, of);
    t->objective = objective;
}

/* The end test: largest slopes of the Lagrangian and residuals, both scaled as in the paper. */
static void errors(Barrier *t, V *dual, V *primal, V *scale_z) {
    const Problem *p = t->lanes.of;
    V slope = SET(0.0), gap = SET(0.0), sum_y = SET(0.0), sum_z = SET(0.0), q[S];
    for (int64_t k = 0; k <= p->N; k++) {
        for (int i = 0; i < S; i++) q[i] = SET(0.0);
        if (k < p->N) tgco_pull_back(t->y + (k + 1) * NX, t->f + k * NJ, q);
        for (int i = k ? 0 : NX; i < (k < p->N ? S : NX); i++) {
            V entry = q[i] + t->g[0][k * S + i];
            if (i < NX) { entry -= t->y[k * NX + i]; sum_y += tgco_fabs(t->y[k * NX + i]); }
            slope = most(tgco_fabs(entry), slope);
        }
    }
    for (int64_t i = 0; i < p->N * NX; i++) gap = most(tgco_fabs(t->gap[i]), gap);
    for (int64_t q = 0; q < t->rows; q++) { gap = most(tgco_fabs(t->r[q]), gap); sum_z += tgco_fabs(t->z[q]); }
    V usual = SET(t->how->usual_multiplier), count = SET((double)(p->N * NX + t->rows));
    V mean = (sum_y + sum_z) / count, mean_z = sum_z / SET((double)(t->rows ? t->rows : 1));
    *dual = slope * usual / most(mean, usual);
    *primal = gap;
    *scale_z = usual / most(mean_z, usual);
}

static V complementarity(const Barrier *t, V mu) {
    V worst = SET(0.0);
    ROWS(t, 0, worst = most(tgco_fabs(t->s[q] * t->z[q] - mu), worst))
    return worst;
}

/* The filter ------------------------------------------------------------------------------------------------------ */

static int is_refused(const Track *k, int l, double theta, double phi) {
    if (!(theta <= k->highest[l])) return 1;
    for (int i = 0; i < k->pairs[l]; i++)
        if (theta >= k->filter[l][i].theta && phi >= k->filter[l][i].phi) return 1;
    return 0;
}

static void remember(const Barrier *t, Track *k, int l) {
    const Interior *how = t->how;
    Pair pair = {(1 - how->gain_theta) * k->theta[l], k->phi[l] - how->gain_phi * k->theta[l]};
    int count = 0;
    for (int i = 0; i < k->pairs[l]; i++)
        if (k->filter[l][i].theta < pair.theta || k->filter[l][i].phi < pair.phi) k->filter[l][count++] = k->filter[l][i];
    if (count == PAIRS) { /* the oldest one is given up */
        memmove(k->filter[l], k->filter[l] + 1, (PAIRS - 1) * sizeof(Pair));
        count--;
    }
    k->filter[l][count] = pair;
    k->pairs[l] = count + 1;
}

/* Whether a trial of lane l is accepted; `descends` where it is by the Armijo condition. `slope` is that of phi. */
static int is_good(const Barrier *t, const Track *k, int l, double alpha, double slope, double theta, double phi, int *descends) {
    const Interior *how = t->how;
    double old = k->theta[l], noise = 10 * __DBL_EPSILON__ * __builtin_fabs(k->phi[l]);
    *descends = 0;
    if (!(theta - theta == 0) || !(phi - phi == 0)) return 0;
    if (k->restoring[l]) return theta <= (1 - how->armijo * alpha) * old;
    if (is_refused(k, l, theta, phi)) return 0;
    int switches = slope < 0 && alpha * __builtin_pow(-slope, how->power_phi) > how->switching * __builtin_pow(old, how->power_theta);
    if (old <= k->lowest[l] && switches) {
        *descends = 1;
        return phi - k->phi[l] - noise <= how->armijo * alpha * slope;
    }
    return theta <= (1 - how->gain_theta) * old || phi - noise <= k->phi[l] - how->gain_phi * old;
}

/* The line search ------------------------------------------------------------------------------------------------- */

/* The longest steps that leave a share 1 - tau of slacks and multipliers. */
static void longest(const Barrier *t, V tau, V *primal, V *dual) {
    *primal = *dual = SET(1.0);
    ROWS(t, 0, {
        V a = -tau * t->s[q] / t->ds[q], b = -tau * t->z[q] / t->dz[q];
        *primal = tgco_choose((t->ds[q] < SET(0.0)) & (a < *primal), a, *primal);
        *dual = tgco_choose((t->dz[q] < SET(0.0)) & (b < *dual), b, *dual);
    })
}

/* The trial at step lengths alpha: its theta and phi. */
static void attempt(Barrier *t, V alpha, V *theta, V *phi) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->Xn[i] = s->X[i] + alpha * t->dx[i];
    for (int64_t i = 0; i < N * NU; i++) s->Un[i] = s->U[i] + alpha * t->du[i];
    V cost = values(t, s->Xn, s->Un, t->cn, t->gapn);
    /* A slack that the row leaves more room for takes it: theta and phi fall both. */
    ROWS(t, 0, { V moved = t->s[q] + alpha * t->ds[q]; t->sn[q] = tgco_choose(-t->cn[q] > moved, -t->cn[q], moved); })
    V sum = SET(0.0);
    for (int64_t i = 0; i < N * NX; i++) sum += tgco_fabs(t->gapn[i]);
    ROWS(t, 0, sum += tgco_fabs(t->cn[q] + t->sn[q]))
    ROWS(t, 1, sum += tgco_fabs(t->cn[q]))
    *theta = sum;
    *phi = cost - t->mu * logarithms(t, t->sn);
}

/* The slope of phi along the step. */
static V descent(const Barrier *t) {
    const Problem *p = t->lanes.of;
    V sum = SET(0.0);
    for (int64_t k = 0; k <= p->N; k++) {
        const V *slope = t->cost_slope + k * S;
        for (int i = 0; i < NX; i++) sum += slope[i] * t->dx[k * NX + i];
        if (k < p->N) for (int j = 0; j < NU; j++) sum += slope[NX + j] * t->du[k * NU + j];
    }
    ROWS(t, 0, sum -= t->mu * t->ds[q] / t->s[q])
    return sum;
}

/* Second-order correction of the lanes `of`: a step that closes what the trial at alpha left, too. */
static void correct(Barrier *t, I of, V alpha) {
    for (int64_t i = 0; i < t->lanes.of->N * NX; i++)
        t->aim[i] = tgco_choose(of, alpha * t->aim[i] + t->gapn[i], t->aim[i]);
    ROWS(t, 0, t->r[q] = tgco_choose(of, alpha * t->r[q] + t->cn[q] + t->sn[q], t->r[q]))
    ROWS(t, 1, t->r[q] = tgco_choose(of, alpha * t->r[q] + t->cn[q], t->r[q]))
    expand(t);
    solve(t);
    solve_rows(t);
}

/* Back to the step for the iterate's own residuals. */
static void uncorrect(Barrier *t) {
    memcpy(t->aim, t->gap, t->lanes.of->N * NX * sizeof(V));
    residuals(t, t->c, t->s, t->r);
    expand(t);
    solve(t);
    solve_rows(t);
}

static void accept(Barrier *t, I won, V alpha, V dual) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V bound = SET(t->how->central), step = alpha;
    for (int64_t i = 0; i < (N + 1) * NX; i++) {
        s->X[i] = tgco_choose(won, s->Xn[i], s->X[i]);
        t->y[i] = tgco_choose(won, t->y[i] + step * (t->yn[i] - t->y[i]), t->y[i]);
    }
    for (int64_t i = 0; i < N * NU; i++) s->U[i] = tgco_choose(won, s->Un[i], s->U[i]);
    for (int64_t i = 0; i < N * NX; i++) t->gap[i] = tgco_choose(won, t->gapn[i], t->gap[i]);
    ROWS(t, 1, t->z[q] = tgco_choose(won, t->z[q] + step * t->dz[q], t->z[q]))
    ROWS(t, 0, {
        V z = t->z[q] + dual * t->dz[q], center = t->mu / t->sn[q];
        z = most(least(z, bound * center), center / bound);
        t->z[q] = tgco_choose(won, z, t->z[q]);
        t->s[q] = tgco_choose(won, t->sn[q], t->s[q]);
    })
    for (int64_t q = 0; q < t->rows; q++) t->c[q] = tgco_choose(won, t->cn[q], t->c[q]);
}

/* Keeps the iterate of the lanes `of`, or goes back to it. */
static void keep(Barrier *t, I of, int back) {
    const Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V *kept = t->kept;
    struct { V *values; int64_t count; } parts[] = {
        {s->X, (N + 1) * NX}, {t->y, (N + 1) * NX}, {s->U, N * NU}, {t->gap, N * NX},
        {t->c, t->rows}, {t->s, t->rows}, {t->z, t->rows}};
    for (int part = 0; part < (int)(sizeof parts / sizeof *parts); part++) {
        V *values = parts[part].values;
        for (int64_t i = 0; i < parts[part].count; i++, kept++)
            if (back) values[i] = tgco_choose(of, *kept, values[i]); else *kept = tgco_choose(of, values[i], *kept);
    }
}

/* Lanes whose steps have been short for long take some full ones on trial (the paper's watchdog). */
static void watch(Barrier *t, Track *k, I moving, V slope, V full) {
    I begins = moving & ~moving;
    for (int l = 0; l < LANES; l++) {
        if (!moving[l] || k->watching[l] || k->restoring[l] || k->shortened[l] < t->how->patience) continue;
        begins[l] = k->watching[l] = -1;
        k->slope[l] = slope[l]; k->alpha[l] = full[l];
        k->ahead[l] = 0;
    }
    if (any(begins)) keep(t, begins, 0);
}

static void go_back(Barrier *t, Track *k, I of) {
    keep(t, of, 1);
    for (int l = 0; l < LANES; l++) if (of[l]) k->watching[l] = k->shortened[l] = 0;
}

/* Moves the lanes `moving` along their steps; returns those that found a step length. A lane moves as soon as it has
   found it; what is computed for it from there on is not used. */
static I search(Barrier *t, Track *k, I moving, V tau) {
    const Interior *how = t->how;
    V full, alpha, dual, theta, phi, slope = descent(t);
    longest(t, tau, &full, &dual);
    I none = moving & ~moving, open = moving, won = none, corrected = none;
    alpha = full;
    watch(t, k, moving, slope, full);
    for (int tries = 0; any(open); tries++) {
        attempt(t, alpha, &theta, &phi);
        I good = none, again = none, undo = none, back = none;
        for (int l = 0; l < LANES; l++) {
            int descends, watching = k->watching[l] != 0;
            if (!open[l]) continue;
            double from = watching ? k->slope[l] : slope[l], length = watching ? k->alpha[l] : alpha[l];
            int accepted = is_good(t, k, l, length, from, theta[l], phi[l], &descends);
            if (watching && !accepted) {
                if (theta[l] <= k->highest[l] && phi[l] - phi[l] == 0 && k->ahead[l]++ < how->trials) good[l] = -1, k->crawls[l] = 0;
                else back[l] = -1;
                continue;
            }
            if (accepted) {
                if (watching) k->watching[l] = 0;
                if (!descends && !k->restoring[l]) remember(t, k, l);
                k->theta[l] = theta[l]; k->phi[l] = phi[l];
                good[l] = -1;
                k->crawls[l] = alpha[l] < how->crawl * full[l] && !watching ? -1 : 0;
                k->shortened[l] = alpha[l] < full[l] && !watching ? k->shortened[l] + 1 : 0;
            } else if (tries == 0 && how->corrects && !k->restoring[l] && theta[l] >= k->theta[l]) {
                again[l] = -1;
            } else {
                undo[l] = corrected[l];
                alpha[l] = 0.5 * (corrected[l] ? full[l] : alpha[l]);
                if (alpha[l] < how->smallest) open[l] = 0;
            }
        }
        if (any(good)) accept(t, good, alpha, dual);
        if (any(back)) go_back(t, k, back);
        won |= good | back;
        open &= ~won;
        if (!any(again) && !any(undo)) continue;
        V p, d;
        if (any(again)) correct(t, again, alpha); else uncorrect(t);
        longest(t, tau, &p, &d);
        alpha = tgco_choose(again, p, alpha);
        dual = tgco_choose(again | undo, d, dual);
        corrected = again;
    }
    return won;
}

/* The loop -------------------------------------------------------------------------------------------------------- */

/* Values and an empty filter of the lanes `of`; `anew`: slacks, too. */
static void settle(Barrier *t, Track *k, I of, int anew) {
    const Interior *how = t->how;
    Lanes *s = &t->lanes;
    V cost = values(t, s->X, s->U, t->c, t->gap);
    if (anew) ROWS(t, 0, t->s[q] = tgco_choose(of, most(-t->c[q], SET(how->push)), t->s[q]))
    residuals(t, t->c, t->s, t->r);
    V theta = size_of(t, t->gap, t->r), phi = cost - t->mu * logarithms(t, t->s);
    k->theta = tgco_choose(of, theta, k->theta);
    k->phi = tgco_choose(of, phi, k->phi);
    V one = SET(1.0), base = most(theta, one);
    k->highest = tgco_choose(of, SET(how->highest) * base, k->highest);
    k->lowest = tgco_choose(of, SET(how->lowest) * base, k->lowest);
    for (int l = 0; l < LANES; l++) if (of[l]) k->pairs[l] = 0;
}

/* The largest slope or curvature of the cost in any one variable. */
static V steepest(const Barrier *t) {
    const Lanes *s = &t->lanes;
    V largest = SET(0.0), g[S], H[S * S];
    for (int64_t k = 0; k <= s->of->N; k++) {
        memset(g, 0, sizeof g); memset(H, 0, sizeof H);
        cost_expand(s, k, s->X + k * NX, k < s->of->N ? s->U + k * NU : 0, g, H);
        for (int i = 0; i < S; i++) largest = most(most(tgco_fabs(g[i]), tgco_fabs(H[i * S + i])), largest);
    }
    return largest;
}

/* Lanes `of` have just been loaded: the scale of their cost, slacks and multipliers. */
static void begin(Barrier *t, Track *k, I of) {
    V one = SET(1.0), zero = SET(0.0), largest;
    const Interior *how = t->how;
    const Problem *p = t->lanes.of;
    t->scale = tgco_choose(of, one, t->scale);
    t->objective = tgco_choose(of, one, t->objective);
    k->last = tgco_choose(of, zero, k->last); k->forced = tgco_choose(of, zero, k->forced);
    k->made = tgco_choose(of, zero, k->made);
    k->restoring &= ~of; k->watching &= ~of;
    t->soft = tgco_choose(of, SET(how->soft), t->soft);
    for (int l = 0; l < LANES; l++) if (of[l]) k->failures[l] = k->shortened[l] = 0;
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        for (int64_t j = 0; j < con->knots * con->rows; j++)
            for (int l = 0; l < LANES; l++)
                if (of[l]) t->z[t->first[i] + j][l] = con->lam[t->lanes.element[l] * con->knots * con->rows + j];
    }
    for (int l = 0; l < LANES; l++) if (of[l]) t->mu[l] = how->barrier[t->lanes.element[l]];
    largest = steepest(t);
    V scale = SET(how->steepest) / largest;
    t->scale = tgco_choose(of & finite(scale) & (largest > zero), scale, t->scale);
    settle(t, k, of, 1);
    if (how->warm) {
        ROWS(t, 0, t->z[q] = tgco_choose(of, most(t->scale * t->z[q], t->mu / (SET(how->central) * t->s[q])), t->z[q]))
        ROWS(t, 1, t->z[q] = tgco_choose(of, t->scale * t->z[q], t->z[q]))
        expand(t);
        adjoin(t, of);
    } else {
        renew(t, of);
    }
}

/* The next mu of the lanes whose barrier problem is solved well enough; their filter begins anew. */
static void lower_barrier(Barrier *t, Track *k, I running, V dual, V primal, V scale_z) {
    const Interior *how = t->how;
    V smallest = SET(how->tolerance * how->barrier_floor), base = most(dual, primal);
    I lowered = running & ~running;
    for (int tries = 0; tries < LONGEST_FALL; tries++) {
        V error = most(base, complementarity(t, t->mu) * scale_z);
        I low = running & ~k->restoring & ~k->watching & (error <= SET(how->barrier_error) * t->mu) & (t->mu > smallest);
        if (!any(low)) break;
        V slow = SET(how->barrier_share) * t->mu, fast = t->mu * tgco_sqrt(t->mu);
        V next = most(smallest, least(slow, fast));
        t->mu = tgco_choose(low, next, t->mu);
        lowered |= low;
    }
    if (!any(lowered)) return;
    V cost = values(t, t->lanes.X, t->lanes.U, t->cn, t->gapn);
    k->phi = tgco_choose(lowered, cost - t->mu * logarithms(t, t->s), k->phi);
    for (int l = 0; l < LANES; l++) if (lowered[l]) k->pairs[l] = 0;
}

/* Factors of all lanes, their curvature shifted where it must be, those of the lanes `anew` from the least shift on;
   lanes that no shift helps leave `running`. */
static I factor_shifted(Barrier *t, const Track *k, I running, I anew) {
    const Interior *how = t->how;
    t->shift = tgco_choose(anew, k->forced, t->shift);
    I lost = running & ~running;
    for (;;) {
        I bad = running & ~factor(t, 1) & ~lost;
        if (!any(bad)) break;
        V before = k->last, first = SET(how->shift_first), floor = SET(how->shift_least);
        V start = tgco_choose(before == SET(0.0), first, most(floor, before * SET(how->shift_decay)));
        V growth = tgco_choose(before == SET(0.0), SET(how->shift_growth_first), SET(how->shift_growth));
        V next = tgco_choose(t->shift == SET(0.0), start, growth * t->shift);
        t->shift = tgco_choose(bad, next, t->shift);
        lost |= bad & (t->shift > SET(how->shift_max));
    }
    return running & ~lost;
}

/* Where equalities contradict each other to first order, their multipliers explode: a softer step is taken there. */
static I soften(Barrier *t, const Track *k, I moving) {
    const Interior *how = t->how;
    for (;;) {
        V largest = SET(0.0);
        ROWS(t, 1, largest = most(tgco_fabs(t->z[q] + t->dz[q]), largest))
        I large = moving & (largest > SET(how->explodes)) & (t->soft < SET(how->softest));
        if (!any(large)) return moving;
        t->soft = tgco_choose(large, SET(100.0) * t->soft, t->soft);
        expand(t);
        moving = factor_shifted(t, k, moving, large);
        solve(t);
        solve_rows(t);
    }
}

/* Lanes whose line search failed look for feasibility alone: steps of least length that close residuals. Where there is
   nothing to close, they start anew with new multipliers and a shift. Returns the lanes that give up. */
static I recover(Barrier *t, Track *k, I failed) {
    const Interior *how = t->how;
    I renewed = failed & ~failed, lost = renewed;
    for (int l = 0; l < LANES; l++) {
        if (!failed[l]) continue;
        if (++k->failures[l] > how->failures) { lost[l] = -1; continue; }
        int seeks = k->theta[l] > how->violation && !k->restoring[l];
        double harder = 10 * k->forced[l];
        k->forced[l] = harder < how->shift_recovery ? how->shift_recovery : harder;
        if (seeks) { k->restoring[l] = -1; k->entered[l] = k->theta[l]; t->objective[l] = 0; }
        else { k->restoring[l] = 0; t->objective[l] = 1; }
        renewed[l] = -1;
    }
    if (any(renewed)) { renew(t, renewed); settle(t, k, renewed, 0); }
    return lost;
}

/* Lanes that have become feasible enough go on with the cost. */
static void resume(Barrier *t, Track *k) {
    I done = k->restoring & ((k->theta <= SET(t->how->restored) * k->entered) | (k->theta <= SET(t->how->violation)));
    if (!any(done)) return;
    k->restoring &= ~done;
    t->objective = tgco_choose(done, SET(1.0), t->objective);
    renew(t, done);
    settle(t, k, done, 0);
}

/* One iteration of the lanes `running`; returns those that end, with their status. */
static I iterate(Barrier *t, Track *k, I running, int32_t *status, V *error) {
    const Interior *how = t->how;
    V dual, primal, scale_z;
    residuals(t, t->c, t->s, t->r);
    memcpy(t->aim, t->gap, t->lanes.of->N * NX * sizeof(V));
    expand(t);
    errors(t, &dual, &primal, &scale_z);
    *error = most(most(dual, primal), complementarity(t, SET(0.0)) * scale_z);
    I ended = running & ~running, astray = running & k->watching & ~finite(*error);
    if (any(astray)) go_back(t, k, astray);
    for (int l = 0; l < LANES; l++) {
        if (!running[l] || astray[l]) continue;
        if (!k->restoring[l] && (*error)[l] <= how->tolerance && primal[l] <= how->violation) status[l] = CONVERGED;
        else if (!((*error)[l] - (*error)[l] == 0)) status[l] = NON_FINITE;
        else if (k->made[l] >= how->max_iterations) status[l] = MAX_ITERATIONS;
        else continue;
        ended[l] = -1;
    }
    running &= ~ended & ~astray;
    if (!any(running)) return ended;
    lower_barrier(t, k, running, dual, primal, scale_z);
    I moving = factor_shifted(t, k, running, running);
    solve(t);
    solve_rows(t);
    moving = soften(t, k, moving);
    k->last = tgco_choose(moving & (t->shift > SET(0.0)), t->shift, k->last);
    astray = running & ~moving & k->watching;
    if (any(astray)) go_back(t, k, astray);
    for (int l = 0; l < LANES; l++)
        if (running[l] && !moving[l] && !astray[l]) { status[l] = NOT_POSITIVE_DEFINITE; ended[l] = -1; }
    V tau = most(SET(how->boundary), SET(1.0) - t->mu);
    I won = search(t, k, moving, tau);
    k->made += tgco_truth(running);
    /* Where only short steps are accepted, the model reaches less far than the step: more curvature makes it shorter. */
    V floor = SET(how->shift_crawl), lower = k->forced * SET(how->recovery_decay);
    V higher = tgco_choose(t->shift > floor, SET(how->recovery_growth) * t->shift, most(floor, k->last));
    lower = tgco_if(lower >= floor, lower);
    k->forced = tgco_choose(won & ~k->restoring, tgco_choose(k->crawls, higher, lower), k->forced);
    t->soft = tgco_choose(won, most(SET(how->soft), SET(0.1) * t->soft), t->soft);
    residuals(t, t->c, t->s, t->r);
    for (int l = 0; l < LANES; l++) if (won[l] && !k->restoring[l] && k->forced[l] == 0) k->failures[l] = 0;
    I lost = recover(t, k, moving & ~won);
    for (int l = 0; l < LANES; l++) if (lost[l]) { status[l] = LINE_SEARCH_FAILED; ended[l] = -1; }
    resume(t, k);
    return ended;
}

static void leave_barrier(Barrier *t, const Track *k, int lane, int32_t status, double error) {
    const Problem *p = t->lanes.of;
    int64_t N = p->N, e = t->lanes.element[lane];
    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = t->lanes.X[i][lane];
    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = t->lanes.U[i][lane];
    for (int64_t i = 0; i < N * NU * NZ; i++) p->gains[e * N * NU * NZ + i] = t->lanes.G[i][lane];
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        for (int64_t j = 0; j < con->knots * con->rows; j++)
            con->lam[e * con->knots * con->rows + j] = t->z[t->first[i] + j][lane] / t->scale[lane];
    }
    t->how->barrier[e] = t->mu[lane];
    t->how->error[e] = error;
    t->how->theta[e] = k->theta[lane];
    p->iterations[e] += (int64_t)k->made[lane];
    p->status[e] = status;
}

static void enter_barrier(Barrier *t, int lane, int64_t e) {
    const Problem *p = t->lanes.of;
    enter_problem(&t->lanes, lane, e);
    for (int64_t i = 0; i < (p->N + 1) * NX; i++) t->lanes.X[i][lane] = p->X[e * (p->N + 1) * NX + i];
    for (int64_t i = 0; i < p->N * NU; i++) t->lanes.U[i][lane] = p->U[e * p->N * NU + i];
}

/* Problems first, first + 1, ..., last - 1. Returns 0 without memory. */
int tgco_interior(const Interior *how, int64_t first, int64_t last) {
    Barrier barrier, *t = &barrier;
    Track track, *k = &track;
    if (!start_barrier(t, how)) return 0;
    memset(k, 0, sizeof *k);
    I running = SET(0.0) != SET(0.0), fresh = ~running;
    int64_t next = first;
    for (int l = 0; l < LANES; l++) {
        /* Lanes without a problem repeat the first problem, so that all lanes hold finite numbers. */
        enter_barrier(t, l, next < last ? next : first);
        running[l] = next < last ? -1 : 0;
        if (next < last) next++;
    }
    begin(t, k, fresh);
    while (any(running)) {
        int32_t status[LANES];
        V error;
        I ended = iterate(t, k, running, status, &error);
        fresh &= ~fresh;
        if (any(ended)) { /* gains along the trajectories that leave, whatever the other lanes do */
            expand(t);
            factor(t, 0);
        }
        for (int l = 0; l < LANES; l++) {
            if (!ended[l]) continue;
            leave_barrier(t, k, l, status[l], error[l]);
            if (next < last) { enter_barrier(t, l, next++); fresh[l] = -1; }
            else running[l] = 0;
        }
        if (any(fresh)) begin(t, k, fresh);
    }
    finish_barrier(t);
    return 1;
}
