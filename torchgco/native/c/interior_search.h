/* The interior point's filter and its line search (Waechter and Biegler 2006), with second-order corrections and a
   watchdog. */
#pragma once
#include "interior_memory.h"

/* The filter ------------------------------------------------------------------------------------------------------ */

static int is_refused(const Track *k, int l, double theta, double phi) {
    if (!(theta <= LANE(k->highest, l))) return 1;
    for (int i = 0; i < k->pairs[l]; i++)
        if (theta >= k->filter[l][i].theta && phi >= k->filter[l][i].phi) return 1;
    return 0;
}

static void remember(const Barrier *t, Track *k, int l) {
    const Interior *how = t->how;
    Pair pair = {(1 - how->gamma_theta) * LANE(k->theta, l), LANE(k->phi, l) - how->gamma_phi * LANE(k->theta, l)};
    int count = 0;
    for (int i = 0; i < k->pairs[l]; i++) {
        Pair old = k->filter[l][i];
        if (old.theta < pair.theta || old.phi < pair.phi) k->filter[l][count++] = old;
    }
    if (count == PAIRS) { /* the oldest one is given up */
        memmove(k->filter[l], k->filter[l] + 1, (PAIRS - 1) * sizeof(Pair));
        count--;
    }
    k->filter[l][count] = pair;
    k->pairs[l] = count + 1;
}

/* Whether a trial of lane l is accepted; `descends` where it is by the Armijo condition. `slope` is that of phi. */
static int is_good(
    const Barrier *t, const Track *k, int l, double alpha, double slope, double theta, double phi, int *descends) {
    const Interior *how = t->how;
    double old = LANE(k->theta, l), noise = how->noise * how->last_bit * fabs(LANE(k->phi, l));
    *descends = 0;
    if (!(theta - theta == 0) || !(phi - phi == 0)) return 0;
    if (LANE(k->restoring, l)) return theta <= (1 - how->eta_phi * alpha) * old;
    if (is_refused(k, l, theta, phi)) return 0;
    double gain = slope < 0 ? alpha * pow(-slope, how->s_phi) : 0;
    int switches = gain > how->delta * pow(old, how->s_theta);
    if (old <= LANE(k->lowest, l) && switches) {
        *descends = 1;
        return phi - LANE(k->phi, l) - noise <= how->eta_phi * alpha * slope;
    }
    return theta <= (1 - how->gamma_theta) * old || phi - noise <= LANE(k->phi, l) - how->gamma_phi * old;
}

/* The line search ------------------------------------------------------------------------------------------------- */

/* The longest steps that leave a share 1 - tau of slacks and multipliers. */
TGCO_LARGE void longest(const Barrier *t, V tau, V *primal, V *dual) {
    *primal = *dual = SET(1.0);
    EACH_ROW(t, 0, q) {
        V a = -tau * t->s[q] / t->ds[q], b = -tau * t->z[q] / t->dz[q];
        *primal = tgco_choose((t->ds[q] < SET(0.0)) & (a < *primal), a, *primal);
        I falls = t->dz[q] < SET(0.0);
        if (t->some_out) falls &= NOT(is_out(t, q));
        *dual = tgco_choose(falls & (b < *dual), b, *dual);
    }
}

/* The trial of the lanes `of` at step lengths alpha: its theta and phi. */
TGCO_LARGE void attempt(Barrier *t, I of, V alpha, V *theta, V *phi) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->Xn[i] = s->X[i] + alpha * t->dx[i];
    for (int64_t i = 0; i < N * NU; i++) s->Un[i] = s->U[i] + alpha * t->du[i];
    V cost = values(t, of, s->Xn, s->Un, t->cn, t->gapn);
    /* A slack that the row leaves more room for takes it: theta and phi fall both. */
    EACH_ROW(t, 0, q) {
        V moved = t->s[q] + alpha * t->ds[q], roomy = tgco_choose(-t->cn[q] > moved, -t->cn[q], moved);
        t->sn[q] = t->some_out ? tgco_choose(is_out(t, q), t->s[q], roomy) : roomy;
    }
    V sum = SET(0.0);
    for (int64_t i = 0; i < N * NX; i++) sum += tgco_fabs(t->gapn[i]);
    EACH_ROW(t, 0, q) sum += tgco_fabs(by_role(t, q, t->cn[q] + t->sn[q], t->cn[q]));
    EACH_ROW(t, 1, q) sum += tgco_fabs(t->cn[q]);
    *theta = sum;
    *phi = cost - t->mu * logarithms(t, t->sn);
}

/* The slope of phi along the step. */
TGCO_LARGE V descent(const Barrier *t) {
    const Problem *p = t->lanes.of;
    V sum = SET(0.0);
    for (int64_t k = 0; k <= p->N; k++) {
        IN slope = t->cost_slope + k * S;
        for (int i = 0; i < NX; i++) ADD(sum, slope[i], t->dx[k * NX + i]);
        if (k < p->N) for (int j = 0; j < NU; j++) ADD(sum, slope[NX + j], t->du[k * NU + j]);
    }
    EACH_ROW(t, 0, q) sum -= t->mu * t->ds[q] / t->s[q];
    return sum;
}

/* Second-order correction of the lanes `of`: a step that closes what the trial at alpha left, too. */
TGCO_LARGE void correct(Barrier *t, I of, V alpha) {
    for (int64_t i = 0; i < t->lanes.of->N * NX; i++)
        t->aim[i] = tgco_choose(of, alpha * t->aim[i] + t->gapn[i], t->aim[i]);
    EACH_ROW(t, 0, q) {
        V left = alpha * t->r[q] + t->cn[q];
        t->r[q] = tgco_choose(of, by_role(t, q, left + t->sn[q], left), t->r[q]);
    }
    EACH_ROW(t, 1, q) t->r[q] = tgco_choose(of, alpha * t->r[q] + t->cn[q], t->r[q]);
    expand(t);
    solve(t);
    solve_rows(t);
}

/* Back to the step for the iterate's own residuals. */
TGCO_LARGE void uncorrect(Barrier *t) {
    memcpy(t->aim, t->gap, t->lanes.of->N * NX * sizeof(V));
    residuals(t, t->c, t->s, t->r);
    expand(t);
    solve(t);
    solve_rows(t);
}

TGCO_LARGE void accept(Barrier *t, I won, V alpha, V dual) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V bound = SET(t->how->kappa_sigma), step = alpha;
    for (int64_t i = 0; i < (N + 1) * NX; i++) {
        s->X[i] = tgco_choose(won, s->Xn[i], s->X[i]);
        t->y[i] = tgco_choose(won, t->y[i] + step * (t->yn[i] - t->y[i]), t->y[i]);
    }
    for (int64_t i = 0; i < N * NU; i++) s->U[i] = tgco_choose(won, s->Un[i], s->U[i]);
    for (int64_t i = 0; i < N * NX; i++) t->gap[i] = tgco_choose(won, t->gapn[i], t->gap[i]);
    EACH_ROW(t, 1, q) t->z[q] = tgco_choose(won, t->z[q] + step * t->dz[q], t->z[q]);
    EACH_ROW(t, 0, q) {
        V z = t->z[q] + dual * t->dz[q], center = t->mu / t->sn[q];
        z = most(least(z, bound * center), center / bound);
        t->z[q] = tgco_choose(won, by_role(t, q, z, t->z[q] + step * t->dz[q]), t->z[q]);
        t->s[q] = tgco_choose(won, t->sn[q], t->s[q]);
    }
    for (int64_t q = 0; q < t->rows; q++) t->c[q] = tgco_choose(won, t->cn[q], t->c[q]);
}

/* Keeps the iterate of the lanes `of`, or goes back to it. */
TGCO_LARGE void keep(Barrier *t, I of, int back) {
    const Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    OUT kept = t->kept;
    struct { Numbers values; int64_t count; } parts[] = {
        {s->X, (N + 1) * NX}, {t->y, (N + 1) * NX}, {s->U, N * NU}, {t->s, t->rows}, {t->z, t->rows}};
    for (int part = 0; part < (int)(sizeof parts / sizeof *parts); part++) {
        OUT values = parts[part].values;
        for (int64_t i = 0; i < parts[part].count; i++, kept++)
            if (back) values[i] = tgco_choose(of, *kept, values[i]); else *kept = tgco_choose(of, values[i], *kept);
    }
}

/* Lanes whose steps have been short for long take some full ones on trial (the paper's watchdog). */
static void watch(Barrier *t, Track *k, I moving, V slope, V full) {
    I begins = moving & NOT(moving);
    for (int l = 0; l < LANES; l++) {
        int rarely = k->shortened[l] < t->how->watchdog_shortened_iter_trigger;
        if (!LANE(moving, l) || LANE(k->watching, l) || LANE(k->restoring, l) || rarely) continue;
        LANE(begins, l) = LANE(k->watching, l) = -1;
        LANE(k->slope, l) = LANE(slope, l); LANE(k->alpha, l) = LANE(full, l);
        k->ahead[l] = 0;
    }
    if (any(begins)) keep(t, begins, 0);
}

static void go_back(Barrier *t, Track *k, I of) {
    keep(t, of, 1);
    values(t, t->live, t->lanes.X, t->lanes.U, t->c, t->gap);
    for (int l = 0; l < LANES; l++) if (LANE(of, l)) LANE(k->watching, l) = k->shortened[l] = 0;
}

/* Moves the lanes `moving` along their steps; returns those that found a step length. A lane moves as soon as it has
   found it; what is computed for it from there on is not used. */
TGCO_LARGE I search(Barrier *t, Track *k, I moving, V tau) {
    const Interior *how = t->how;
    V full, alpha, dual, theta, phi, slope = descent(t);
    longest(t, tau, &full, &dual);
    I none = moving & NOT(moving), open = moving, won = none, corrected = none;
    alpha = full;
    watch(t, k, moving, slope, full);
    for (int tries = 0; any(open); tries++) {
        attempt(t, open, alpha, &theta, &phi);
        I good = none, again = none, undo = none, back = none;
        for (int l = 0; l < LANES; l++) {
            int descends, watching = LANE(k->watching, l) != 0;
            if (!LANE(open, l)) continue;
            double from = watching ? LANE(k->slope, l) : LANE(slope, l), length = watching ? LANE(k->alpha, l) : LANE(alpha, l);
            int accepted = is_good(t, k, l, length, from, LANE(theta, l), LANE(phi, l), &descends);
            if (watching && !accepted) {
                int sound = LANE(theta, l) <= LANE(k->highest, l) && LANE(phi, l) - LANE(phi, l) == 0;
                int goes_on = sound && k->ahead[l]++ < how->watchdog_trial_iter_max;
                if (goes_on) { LANE(good, l) = -1; LANE(k->crawls, l) = 0; } else LANE(back, l) = -1;
                continue;
            }
            if (accepted) {
                if (watching) LANE(k->watching, l) = 0;
                if (!descends && !LANE(k->restoring, l)) remember(t, k, l);
                LANE(k->theta, l) = LANE(theta, l); LANE(k->phi, l) = LANE(phi, l);
                LANE(good, l) = -1;
                LANE(k->crawls, l) = LANE(alpha, l) < how->crawl * LANE(full, l) && !watching ? -1 : 0;
                k->shortened[l] = LANE(alpha, l) < LANE(full, l) && !watching ? k->shortened[l] + 1 : 0;
            } else if (tries == 0 && how->max_soc && !LANE(k->restoring, l) && LANE(theta, l) >= LANE(k->theta, l)) {
                LANE(again, l) = -1;
            } else {
                LANE(undo, l) = LANE(corrected, l);
                LANE(alpha, l) = 0.5 * (LANE(corrected, l) ? LANE(full, l) : LANE(alpha, l));
                if (LANE(alpha, l) < how->alpha_min) LANE(open, l) = 0;
            }
        }
        if (any(good)) accept(t, good, alpha, dual);
        if (any(back)) go_back(t, k, back);
        won |= good | back;
        open &= NOT(won);
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
