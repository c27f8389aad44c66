/* iLQR (Algorithm 2) for problems side by side: the line search, and the loop that keeps the lanes filled.
   A problem's results agree with PyTorch's kernels up to rounding (tests/native). */
#pragma once
#include "knot.h"
#include "memory.h"
#include "passes.h"

/* The numbers first, ..., last - 1 of problems, to be given back; NULL without memory. */
static int64_t *in_order(const Problem *p, int64_t first, int64_t last) {
    int64_t *number = (int64_t *)take(p, (last - first + 1) * sizeof *number);
    for (int64_t i = 0; number && first + i < last; i++) number[i] = first + i;
    return number;
}

#define ROUNDED 1e-6 /* share of a sum that rounding can't reach */

/* Commit the trial of lane from[l] to lane l where `won`. */
static void commit(Lanes *s, I won, const int *from, V alpha, V cost, V merit) {
    int64_t N = s->of->N;
    I index;
    for (int l = 0; l < LANES; l++) LANE(index, l) = from[l];
    for (int64_t i = 0; i < (N + 1) * NX; i++) s->X[i] = tgco_choose(won, tgco_permuted(s->Xn[i], index), s->X[i]);
    for (int64_t i = 0; i < N * NU; i++) s->U[i] = tgco_choose(won, tgco_permuted(s->Un[i], index), s->U[i]);
    s->cost = tgco_choose(won, tgco_permuted(cost, index), s->cost);
    s->merit = tgco_choose(won, tgco_permuted(merit, index), s->merit);
    s->alpha = tgco_choose(won, tgco_permuted(alpha, index), s->alpha);
}

/* The line search (lines 14-24) of the lanes `moving`. The `replicas` lanes of a problem try rungs in parallel. */
TGCO_LARGE I search(Lanes *s, I moving, V linear, V quadratic, V *shortest) {
    const Options *o = &s->of->options;
    int replicas = s->of->replicas;
    int64_t landed[LANES];
    I open = moving, done = moving & NOT(moving);
    /* No trial is accepted that doesn't lower L_M, which terms that are left lower by at most `floor`, and rounding. */
    V size = tgco_fabs(s->merit) + s->floor, most = s->merit + s->floor + SET(ROUNDED) * size;
    *shortest = SET(0.0);
    for (int64_t tried = 0; any(open); tried += replicas) {
        V alpha, enough, cost, merit;
        for (int l = 0; l < LANES; l++) {
            int64_t rung = s->rung[l] + tried + l % replicas;
            int last = rung + 1 >= o->rungs; /* its L_M counts, whatever it is */
            LANE(alpha, l) = o->ladder[last ? o->rungs - 1 : rung];
            LANE(enough, l) = !LANE(open, l) ? -INFINITY : last || !s->of->bounded ? INFINITY : LANE(most, l);
        }
        roll(s, CALLED(knot_value), alpha, enough, &cost, &merit);
        V ratio = (merit - s->merit) / (alpha * linear + SET(0.5) * alpha * alpha * quadratic);
        I good = (ratio >= SET(o->ratio_min)) & (ratio <= SET(o->ratio_max));
        if (o->accept_last) good |= alpha < SET(o->smallest);
        good &= tgco_finite(merit) & open;
        *shortest = tgco_choose(open, merit, *shortest);
        int from[LANES];
        I won;
        for (int e = 0; e < LANES; e += replicas) {
            int winner = -1;
            for (int l = e; l < e + replicas && winner < 0; l++) if (LANE(good, l)) winner = l;
            for (int l = e; l < e + replicas; l++) {
                from[l] = winner < 0 ? l : winner;
                LANE(won, l) = winner < 0 ? 0 : -1;
            }
            /* Where a problem refuses all rungs, its last lane holds the last rung. */
            for (int l = e; l < e + replicas; l++) LANE(*shortest, l) = LANE(*shortest, e + replicas - 1);
        }
        if (any(won)) commit(s, won, from, alpha, cost, merit);
        open &= NOT(won);
        done |= won;
        for (int l = 0; l < LANES; l++) {
            if (LANE(won, l)) landed[l] = s->rung[l] + tried + from[l] % replicas;
            else if (s->rung[l] + tried + replicas >= o->rungs) LANE(open, l) = 0;
        }
    }
    /* The next search begins a little above where this one ended; after one that found nothing, at a full step. */
    for (int l = 0; l < LANES; l++)
        if (LANE(moving, l)) s->rung[l] = LANE(done, l) && o->back >= 0 && landed[l] > o->back ? landed[l] - o->back : 0;
    return done;
}

/* One iteration. Returns the lanes that are done, their status, and whether they converged, were refused or diverge. */
TGCO_LARGE I iterate(Lanes *s, I running, int32_t *status, I *converged, I *refused, I *lost) {
    const Options *o = &s->of->options;
    V linear, squares, lowest, zero = SET(0.0), old = s->merit, shortest;
    s->alpha = zero;
    s->used = s->mu_r;
    backward(s, CALLED(knot_expand), NONE, &linear, &squares, &lowest);
    V quadratic = -linear - s->mu_r * squares, before = s->mu_r;
    I failed = NOT(lowest > zero) & running;
    V expected = tgco_fabs(linear + SET(0.5) * quadratic);
    I settled = expected <= SET(o->rounding) * tgco_fabs(old);
    I moving = running & NOT(failed) & NOT(settled);
    for (int l = 0; l < LANES; l++) status[l] = RUNNING;
    if (any(failed)) {
        V higher = s->mu_r * SET(o->regularisation_growth);
        higher = tgco_choose(higher < SET(o->regularisation_first), SET(o->regularisation_first), higher);
        s->mu_r = tgco_choose(failed, higher, s->mu_r);
        I sound = is_finite(s, CALLED(knot_expand));
        for (int l = 0; l < LANES; l++) if (LANE(failed, l)) {
            if (LANE(s->mu_r, l) > o->regularisation_max) status[l] = NOT_POSITIVE_DEFINITE;
            if (!LANE(sound, l)) status[l] = NON_FINITE;
        }
    }
    I accepted = search(s, moving, linear, quadratic, &shortest);
    *refused = moving & NOT(accepted);
    s->inner += tgco_truth(running & NOT(failed));
    s->made += tgco_truth(running & NOT(failed));
    /* mu_r of the next iteration */
    V next = zero;
    if (o->damping > 0) {
        V up = SET(o->damping_growth) * before, down = before / SET(o->damping_decay);
        up = tgco_choose(up < SET(o->damping), SET(o->damping), up);
        up = tgco_choose(up > SET(o->regularisation_max), zero, up);
        next = tgco_choose(*refused, up, tgco_choose(down < SET(o->damping), zero, down));
    }
    s->mu_r = tgco_choose(failed | NOT(running), s->mu_r, next);
    I stuck = *refused & (s->mu_r == zero);
    V change = tgco_fabs(s->merit - old);
    V larger = tgco_choose(change > expected, change, expected);
    I flat = (larger <= SET(o->tolerance) * tgco_fabs(s->merit)) & NOT(before > SET(o->damping));
    *converged = running & NOT(failed) & (settled | (moving & NOT(*refused) & (flat | (change < SET(o->absolute_tolerance)))));
    *lost = *refused & NOT(shortest <= SET(o->lost) * tgco_fabs(old));
    *lost &= s->inner <= SET(1.0);
    if (o->damping == 0) *lost = *lost & NOT(*lost);
    I over = running & NOT(failed) & (*converged | stuck | (s->inner >= SET((double)o->max_iterations)));
    *refused = stuck;
    for (int l = 0; l < LANES; l++) if (LANE(over, l)) status[l] = ENDED;
    I limit = running & (*lost | (s->made >= SET((double)s->of->limit)));
    for (int l = 0; l < LANES; l++) if (status[l] != RUNNING) LANE(limit, l) = -1;
    return limit & running;
}

/* Up to `limit` iterations of the inner solves of `count` problems, by their numbers. */
TGCO_LARGE void inner_solves(Lanes *s, const int64_t *number, int64_t count) {
    int replicas = s->of->replicas;
    I running = SET(0.0) != SET(0.0);
    int64_t next = 0;
    for (int e = 0; e < LANES; e += replicas) {
        /* Lanes without a problem repeat the first problem, so that all lanes hold finite numbers. */
        int64_t element = number[next < count ? next : 0];
        for (int l = e; l < e + replicas; l++) {
            enter(s, l, element);
            LANE(running, l) = next < count ? -1 : 0;
        }
        if (next < count) next++;
    }
    while (any(running)) {
        int32_t status[LANES];
        I converged, refused, lost, ended;
        ended = iterate(s, running, status, &converged, &refused, &lost);
        for (int e = 0; e < LANES; e += replicas) {
            if (!LANE(ended, e)) continue;
            leave(s, e, status[e], LANE(converged, e) != 0, LANE(refused, e) != 0, LANE(lost, e) != 0);
            for (int l = e; l < e + replicas; l++) {
                if (next < count) enter(s, l, number[next]);
                else LANE(running, l) = 0;
            }
            if (next < count) next++;
        }
    }
}

