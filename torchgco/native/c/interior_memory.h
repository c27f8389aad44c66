/* What the interior point remembers of each lane, its multipliers, and the test of its end. Names are those of the
   paper (Waechter and Biegler 2006): theta is the sum of all residuals, phi the cost less mu times the logarithms of
   the slacks. */
#pragma once
#include "interior_step.h"
#include "memory.h"

typedef struct { double theta, phi; } Pair;

/* What the globalisation remembers of each lane. */
typedef struct {
    V theta, phi, highest, lowest, last, forced, made, entered, slope, alpha;
    V least, idle; /* the smallest error of the end test so far, and the iterations since it fell by half */
    V left;        /* the smallest complementarity so far, of those that counted */
    Pair filter[LANES][PAIRS];
    int pairs[LANES], failures[LANES], shortened[LANES], ahead[LANES];
    I restoring, crawls;
    I presses; /* mu falls further than the tolerance asks for: see barrier_counts */
    I watching; /* a step was taken on trial; theta, phi, slope and alpha are those before it */
} Track;

/* The first constraint from i on that holds equalities, 1, or inequalities, 0. */
static inline int64_t next_of(const Barrier *t, int equality, int64_t i) {
    const Problem *p = t->lanes.of;
    while (i < p->constraints && p->constraint[i].equality != equality) i++;
    return i;
}

/* Those of all rows, where an exported solver has them. */
static const double *multipliers_of(const Problem *p) {
    for (int64_t i = 0; i < p->constraints; i++) if (p->constraint[i].lam) return p->constraint[i].lam;
    return NULL;
}

/* The model of an iterate and the step that it leads to take turns with the same memory: H and g[0] have been read when there
   is a step, and all of the model before a trial is made; what needs the model again calls `expand`. */
static void lay_out_turns(Barrier *t, Cut *m) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N, rows = t->rows;
    Cut step = *m;
    t->H = cut(m, (N + 1) * TRIANGLE(S)); t->g[0] = cut(m, (N + 1) * S);
    t->f = cut(m, N * NJ + 1);
    for (int part = 1; part < PARTS; part++) t->g[part] = cut(m, (N + 1) * S);
    t->dx = cut(&step, (N + 1) * NX); t->du = cut(&step, N * NU);
    t->yn = cut(&step, (N + 1) * NX); t->p = s->Xn = cut(&step, (N + 1) * NX); /* before f: 3 NX + NU <= S (S + 3) / 2 */
    s->Un = cut(&step, N * NU); t->gapn = cut(&step, N * NX);
    t->cn = cut(&step, rows); t->sn = cut(&step, rows); t->ds = t->moves = cut(&step, rows); t->dz = cut(&step, rows);
    if (step.used > m->used) m->used = step.used;
}

static int64_t shape(Barrier *t, Numbers memory) {
    const Problem *p = t->lanes.of;
    int64_t N = p->N, rows = t->rows;
    Cut m = {memory, 0};
    t->y = cut(&m, (N + 1) * NX);
    t->gap = cut(&m, N * NX); t->aim = cut(&m, N * NX);
    t->cost_slope = cut(&m, (N + 1) * S);
    t->P = cut(&m, (N + 1) * TRIANGLE(NX)); t->L = cut(&m, N * TRIANGLE(NU));
    if (t->how->free_start) { t->is_free = cut(&m, NX); t->L_start = cut(&m, TRIANGLE(NX)); }
    t->c = cut(&m, rows); t->s = cut(&m, rows); t->r = cut(&m, rows);
    t->z = cut_at(&m, p, multipliers_of(p), rows);
    for (int i = 0; i < 3; i++) t->across[i] = cut(&m, t->widest);
    t->room = cut(&m, rows); t->role = cut(&m, rows);
    if (next_of(t, 1, 0) < p->constraints) t->gives = cut(&m, rows);
    t->kept = cut(&m, 2 * (N + 1) * NX + N * NU + 2 * rows);
    lay_out_turns(t, &m);
    return m.used;
}

static void finish_barrier(Barrier *t) {
    const Problem *p = t->how->of;
    give(p, t->memory); give(p, t->rows_asked); give(p, t->first);
    finish(&t->lanes);
}

static int start_barrier(Barrier *t, const Interior *how) {
    const Problem *p = how->of;
    memset(t, 0, sizeof *t);
    t->how = how;
    t->lanes.of = p; t->lanes.of_barrier = 1;
    if (!take_lanes(&t->lanes)) return 0;
    t->first = (int64_t *)take(p, (p->constraints + 1) * sizeof *t->first);
    t->rows_asked = (double **)take(p, (p->constraints + 1) * sizeof *t->rows_asked);
    if (!t->first || !t->rows_asked) { finish_barrier(t); return 0; }
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        t->first[i + 1] = t->rows += con->knots * con->rows;
        if (con->rows > t->widest) t->widest = con->rows;
        t->rows_asked[i] = ADDRESS(t->lanes.rows[i].bound);
    }
    int64_t count = shape(t, 0);
    t->memory = take_numbers(p, count + 1);
    if (!t->memory) { finish_barrier(t); return 0; }
    shape(t, t->memory);
    for (int64_t i = 0; i < p->constraints; i++) t->lanes.rows[i].lam = t->z + t->first[i];
    for (int64_t q = 0; t->gives && q < t->rows; q++) t->gives[q] = SET(1.0);
    return 1;
}

/* How many numbers of a lane that takes. */
static int64_t room_of(const Interior *how) {
    Barrier barrier, *t = &barrier;
    if (!start_barrier(t, how)) return 0;
    int64_t count = lay_out(&t->lanes, 0) + shape(t, 0) + 2;
    finish_barrier(t);
    return count;
}

TGCO_LARGE void enter_barrier(Barrier *t, int lane, int64_t e) {
    enter_iterate(&t->lanes, lane, e);
    if (t->is_free) for (int i = 0; i < NX; i++) LANE(t->is_free[i], lane) = t->how->free_start[e * NX + i];
}

static inline V most(V a, V b) { return tgco_choose((a > b) | (a != a), a, b); } /* NaN stays */
static inline V least(V a, V b) { return tgco_choose(a < b, a, b); }

/* For every row q of them. */
#define EACH_ROW(t, equality, q) \
    for (int64_t i_ = next_of(t, equality, 0); i_ < (t)->lanes.of->constraints; i_ = next_of(t, equality, i_ + 1)) \
        for (int64_t q = (t)->first[i_], end_ = (t)->first[i_ + 1]; q < end_; q++)

/* Sum of the logarithms of the slacks, by their product: one logarithm for all rows. */
TGCO_LARGE V logarithms(const Barrier *t, IN s) {
    V product = SET(1.0), exponents = SET(0.0);
    int count = 0;
    EACH_ROW(t, 0, q) {
        product *= s[q];
        if (++count % TGCO_FACTORS == 0) {
            exponents += tgco_exponent(product);
            product = tgco_mantissa(product);
        }
    }
    return tgco_log(product) + SET(0x1.62e42fefa39efp-1) * exponents;
}

TGCO_LARGE V size_of(const Barrier *t, IN gap, IN r) {
    V sum = SET(0.0);
    for (int64_t i = 0; i < t->lanes.of->N * NX; i++) sum += tgco_fabs(gap[i]);
    for (int64_t q = 0; q < t->rows; q++) sum += tgco_fabs(r[q]);
    return sum;
}

/* Multipliers ---------------------------------------------------------------------------------------------------- */

/* Costates of the lanes `of` that make the Lagrangian stationary in the states; none where they are too large. With
   `gains` stationary along the feedback u + G (x - X): where it is stationary in the controls these are the same, but
   unstable dynamics don't magnify rounding from stage to stage. */
TGCO_LARGE void adjoin(Barrier *t, I of, IN gains) {
    const Problem *p = t->lanes.of;
    V largest = SET(0.0), q[S];
    for (int64_t k = p->N; k > 0; k--) { /* no step aims at anything yet */
        OUT y = t->aim + (k - 1) * NX;
        for (int i = 0; i < S; i++) q[i] = SET(0.0);
        if (k < p->N) model_pull_back(y + NX, t->f + k * NJ, q);
        for (int i = 0; i < NX; i++) {
            y[i] = q[i] + t->g[0][k * S + i];
            if (gains && k < p->N)
                for (int j = 0; j < NU; j++) ADD(y[i], gains[(k * NU + j) * NZ + i], q[NX + j] + t->g[0][k * S + NX + j]);
            largest = most(tgco_fabs(y[i]), largest);
        }
    }
    I sound = largest <= SET(t->how->constr_mult_init_max) * t->raised;
    for (int i = 0; i < NX; i++) t->y[i] = tgco_choose(of, SET(0.0), t->y[i]);
    for (int64_t i = 0; i < p->N * NX; i++) t->y[NX + i] = tgco_choose(of, tgco_if(sound, t->aim[i]), t->y[NX + i]);
}

/* Multipliers anew for the lanes `of`: those of the central path, and none of equalities. */
TGCO_LARGE void renew(Barrier *t, I of) {
    EACH_ROW(t, 0, q) t->z[q] = tgco_choose(of, by_role(t, q, t->mu / t->s[q], SET(0.0)), t->z[q]);
    EACH_ROW(t, 1, q) t->z[q] = tgco_choose(of, SET(0.0), t->z[q]);
    V objective = t->objective;
    t->objective = tgco_choose(of, SET(1.0), objective);
    expand(t);
    adjoin(t, of, NONE);
    t->objective = objective;
}

/* The end test: largest slopes of the Lagrangian and residuals, both scaled as in the paper. */
TGCO_LARGE void errors(Barrier *t, V *dual, V *primal, V *scale_z) {
    const Problem *p = t->lanes.of;
    V slope = SET(0.0), gap = SET(0.0), sum_y = SET(0.0), sum_z = SET(0.0), q[S];
    for (int64_t k = 0; k <= p->N; k++) {
        for (int i = 0; i < S; i++) q[i] = SET(0.0);
        if (k < p->N) model_pull_back(t->y + (k + 1) * NX, t->f + k * NJ, q);
        for (int i = k || t->is_free ? 0 : NX; i < (k < p->N ? S : NX); i++) {
            V entry = q[i] + t->g[0][k * S + i];
            if (!k && i < NX) entry = tgco_if(tgco_is(t->is_free[i]), entry); /* the start has no costate */
            else if (i < NX) { entry -= t->y[k * NX + i]; sum_y += tgco_fabs(t->y[k * NX + i]); }
            slope = most(tgco_fabs(entry), slope);
        }
    }
    for (int64_t i = 0; i < p->N * NX; i++) gap = most(tgco_fabs(t->gap[i]), gap);
    for (int64_t q = 0; q < t->rows; q++) {
        gap = most(tgco_fabs(t->r[q]), gap);
        sum_z += least(tgco_fabs(t->z[q]), SET(t->how->explodes) * t->raised); /* one that explodes says nothing of the others */
    }
    V usual = SET(t->how->s_max), count = SET((double)(p->N * NX + t->rows));
    V mean = (sum_y + sum_z) / count, mean_z = sum_z / SET((double)(t->rows ? t->rows : 1));
    *dual = slope * usual / most(mean, usual);
    *primal = gap;
    *scale_z = usual / most(mean_z, usual);
}

TGCO_LARGE V complementarity(const Barrier *t, V mu) {
    V worst = SET(0.0);
    EACH_ROW(t, 0, q) worst = most(by_role(t, q, tgco_fabs(t->s[q] * t->z[q] - mu), SET(0.0)), worst);
    return worst;
}

