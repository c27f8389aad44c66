/* MPPI (Algorithm 3): all rounds of sampled controls, problem by problem, with LANES samples side by side. */
#include "memory.h"
#include "noise.h" /* or cuda/c/noise.h */
#include "solids.h"

/* Sums over samples begin as this many, of every SUMS-th sample, so that no bit depends on the number of lanes. */
#define SUMS (TGCO_IS_DOUBLE ? 8 : 16)
#define BUNDLES (SUMS / LANES)

/* The working data of one problem, which all lanes of `s` hold; BUNDLES sums of a control lie side by side. */
typedef struct {
    const Sampling *of;
    Lanes s;
    Numbers mean, z, sum, lower, upper, spread, deviation;
    double *score;
    uint64_t key; /* of the noise of samples first, ... in this round */
    int64_t first;
    Numbers memory;
} Samples;

/* Noise and controls of stage k. */
static inline void draw(const Samples *q, int64_t k, OUT eps, OUT u) {
    const Sampling *o = q->of;
    IN lower = at(q->lower, &o->lower, k); IN upper = at(q->upper, &o->upper, k);
    for (int j = 0; j < NU; j++) {
        int64_t row = (o->knots > 0 ? o->left[k] : k) * NU + j;
        V z = NOISE(q, row);
        if (o->knots > 0) z = z + SET(o->share[k]) * (NOISE(q, row + NU) - z);
        eps[j] = z * q->deviation[j];
        V v = q->mean[k * NU + j] + eps[j];
        u[j] = tgco_fmin(tgco_fmax(v, lower[j]), upper[j]);
    }
}

#if DIM > 0
/* How many obstacles of a kind each sample touches at knot k. */
static inline V touched_solids(const Constraint *con, const Rows *rows, int64_t k, IN x) {
    V count = SET(0.0);
    if (is_kind(con, SPHERES)) {
        for (int j = 0; j < con->rows; j++) {
            V away[DIM], c = sphere(con, rows, j, k, x, away);
            count += tgco_truth(c >= SET(0.0));
        }
    } else if (is_kind(con, BOXES)) {
        for (int j = 0; j < con->rows; j++)
            if (any(is_near(con, rows, j, x))) count += tgco_truth(solid(con, rows, j, k, x, NONE) >= SET(0.0));
    } else if (!is_far_from_map(con, rows, x)) count += tgco_truth(field_row(con, rows, k, x, NONE, NONE) >= SET(0.0));
    return count;
}
#endif

/* The number of obstacles that each sample touches at knot k; of a body, by each of its balls. */
static V hits(const Samples *q, int64_t k, IN x) {
    const Problem *p = q->of->of;
    V count = SET(0.0);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (!q->of->geometric[i] || con->place[k] == NOWHERE) continue;
#if DIM > 0
        if (is_kind(con, BODY)) {
            V centers[MAX_ROWS];
            Ball ball;
            ball_centers(&q->s, i, k, x, centers);
            for (int b = 0; b < con->balls; b++) {
                ball_at(con, q->s.rows + i, b, k, centers + b * DIM, &ball);
                count += touched_solids(&ball.con, &ball.rows, k, ball.x);
            }
            continue;
        }
        if (!is_kind(con, FUNCTION)) {
            count += touched_solids(con, q->s.rows + i, k, x);
            continue;
        }
#endif
        V c[MAX_ROWS], u[NU];
        memset(u, 0, sizeof u); /* a geometric constraint reads x alone */
        model_rows((int)i, x, u, at(q->s.rows[i].bound, &con->bound, con->place[k]), con->shared, c);
        for (int j = 0; j < con->rows; j++) count += tgco_truth(c[j] >= SET(0.0));
    }
    return count;
}

/* Costs of the samples in the lanes (lines 5-11), into score[first], ... */
static void fly(Samples *q) {
    const Sampling *o = q->of;
    const Problem *p = o->of;
    V x[2 * NX], u[NU], eps[NU], cost = SET(0.0), touched = SET(0.0), likelihood = SET(0.0);
    memcpy(x, q->s.X, NX * sizeof(V));
    for (int64_t k = 0; k < p->N; k++) {
        draw(q, k, eps, u);
        cost += cost_value(&q->s, k, x, u);
        model_step(x, u, model_at(&q->s, k), p->shared, x + NX);
        memcpy(x, x + NX, NX * sizeof(V));
        touched += hits(q, k + 1, x);
        if (o->knots == 0)
            for (int j = 0; j < NU; j++)
                likelihood += q->mean[k * NU + j] / (q->deviation[j] * q->deviation[j]) * eps[j];
    }
    cost += cost_value(&q->s, p->N, x, NONE);
    if (o->dwell_cost > 0) cost += SET(o->dwell_cost * p->N) * cost_value(&q->s, p->N - 1, x, u);
    cost += SET(o->temperature) * likelihood;
    for (int l = 0; l < LANES && q->first + l < o->samples; l++) {
        double score = (double)LANE(cost, l) + o->collision_penalty * (double)LANE(touched, l);
        /* A sample that isn't finite must not spoil the others. */
        q->score[q->first + l] = score - score == 0 ? score : DBL_MAX;
    }
}

/* Keep the `most` smallest gaps so far, in order, of which there are `held`. */
static int64_t keep_smallest(double *best, int64_t held, int64_t most, double gap) {
    if (held == most && !(gap < best[held - 1])) return held;
    int64_t at = held < most ? held++ : held - 1;
    for (; at > 0 && best[at - 1] > gap; at--) best[at] = best[at - 1];
    best[at] = gap;
    return held;
}

/* Scores to weights w = softmax(-(S - min S) / lambda), in place. */
static void weigh(const Sampling *o, double *score) {
    int64_t count = o->samples, held = 0;
    double least = DBL_MAX, temperature = o->temperature, sum = 0, *best = score + count;
    SHARED(i, count) if (score[i] < least) least = score[i];
    least = LEAST_OF_ALL(least);
    SHARED(i, count) score[i] -= least;
    ALL_DONE;
    if (o->elite > 0) IN_ORDER(i, score, count) if (IS_FIRST) held = keep_smallest(best, held, o->elite, STAGED(score, i));
    ALL_DONE;
    if (o->elite > 0 && best[o->elite - 1] > temperature) temperature = best[o->elite - 1];
    SHARED(i, count) score[i] = exp(-score[i] / temperature);
    ALL_DONE;
    IN_ORDER(i, score, count) sum += STAGED(score, i);
    ALL_DONE;
    SHARED(i, count) score[i] /= sum;
}

/* The weighted mean of a control from its partial sums. */
static V mean_of(const Samples *q, int64_t i) {
    double total = 0;
    for (int l = 0; l < SUMS; l++) total += (double)LANE(q->sum[i * BUNDLES + l / LANES], l % LANES);
    return SET(total);
}

/* The weighted mean of all samples' controls: they are drawn again, not stored, and only where a weight isn't 0. */
static void average(Samples *q, int64_t rows) {
    const Sampling *o = q->of;
    int64_t N = o->of->N;
    memset(q->sum, 0, N * NU * BUNDLES * sizeof(V));
    for (int64_t first = 0; first < o->samples; first += LANES) {
        OUT sum = q->sum + first / LANES % BUNDLES;
        V weight = SET(0.0), eps[NU], u[NU];
        for (int l = 0; l < LANES && first + l < o->samples; l++) LANE(weight, l) = (REAL)q->score[first + l];
        if (!any(weight > SET(0.0))) continue;
        normal(q->key, first, rows, q->z);
        for (int64_t k = 0; k < N; k++) {
            draw(q, k, eps, u);
            for (int j = 0; j < NU; j++) ADD(sum[(k * NU + j) * BUNDLES], weight, u[j]);
        }
    }
    for (int64_t i = 0; i < N * NU; i++) q->mean[i] = mean_of(q, i);
}

static void leave_samples(Samples *q) {
    give(q->of->of, q->score); give(q->of->of, q->memory);
    finish(&q->s);
}

TGCO_LARGE int begin(Samples *q, const Sampling *o) {
    memset(q, 0, sizeof *q);
    q->of = o;
    int64_t N = o->of->N, rows = (o->knots ? o->knots : N) * NU;
    int64_t bounds = length(&o->lower, N) + length(&o->upper, N);
    if (!start(&q->s, o->of)) return 0;
    q->memory = take_numbers(o->of, (1 + BUNDLES) * N * NU + rows + bounds + 2 * NU);
    q->score = (double *)take(o->of, (o->samples + o->elite) * sizeof(double));
    if (!q->memory || !q->score) { leave_samples(q); return 0; }
    q->mean = q->memory; q->sum = q->mean + N * NU; q->z = q->sum + BUNDLES * N * NU;
    q->lower = q->z + rows; q->upper = q->lower + length(&o->lower, N);
    q->spread = q->upper + length(&o->upper, N); q->deviation = q->spread + NU;
    return 1;
}

/* How many numbers of a single lane that takes. */
int64_t tgco_sampler_room(const Sampling *o) {
    int64_t N = o->of->N, rows = (o->knots ? o->knots : N) * NU;
    Lanes lanes, *s = &lanes;
    memset(s, 0, sizeof *s);
    s->of = o->of;
    return lay_out(s, 0) + 2 + (1 + SUMS) * N * NU + rows + length(&o->lower, N) + length(&o->upper, N) + 2 * NU;
}

/* All lanes get problem e. */
static void load(Samples *q, int64_t e) {
    const Sampling *o = q->of;
    int64_t size = o->of->N * NU;
    for (int l = 0; l < LANES; l++) {
        enter_problem(&q->s, l, e);
        fill(q->spread, &o->deviation, 1, l, e);
        fill(q->lower, &o->lower, o->of->N, l, e);
        fill(q->upper, &o->upper, o->of->N, l, e);
    }
    for (int64_t i = 0; i < size; i++) q->mean[i] = SET(o->mean[e * size + i]);
}

/* What a round of problem e draws, with noise that all rounds before have shrunk. */
static void begin_round(Samples *q, int64_t e, int64_t round) {
    const Sampling *o = q->of;
    double shrunk = 1;
    for (int64_t i = 0; i < round; i++) shrunk *= o->decay;
    q->key = o->keys[e * o->rounds + round];
    for (int j = 0; j < NU; j++) q->deviation[j] = SET(shrunk) * q->spread[j];
}

/* Problems first, first + 1, ..., last - 1: all rounds. Returns 0 without memory. */
int tgco_sample(const Sampling *o, int64_t first, int64_t last) {
    Samples samples, *q = &samples;
    if (!begin(q, o)) return 0;
    int64_t size = o->of->N * NU, rows = (o->knots ? o->knots : o->of->N) * NU;
    for (int64_t e = first; e < last; e++) {
        load(q, e);
        for (int64_t round = 0; round < o->rounds; round++) {
            begin_round(q, e, round);
            for (q->first = 0; q->first < o->samples; q->first += LANES) {
                normal(q->key, q->first, rows, q->z);
                fly(q);
            }
            weigh(o, q->score);
            average(q, rows);
        }
        for (int64_t i = 0; i < size; i++) o->mean[e * size + i] = (double)LANE(q->mean[i], 0);
    }
    leave_samples(q);
    return 1;
}
