/* The root of q equations in each lane, by Newton's method; base/roots.py has the same in PyTorch, and says when a step
   serves. What a lane finds doesn't depend on the others: those that are done wait.

       newton_state newton = newton_begin(q, trial, z, step);     trial: the guess
       do equation(trial, r, A);                                  its residual r (q), slopes A (q, q) row by row
       while (newton_next(&newton, q, z, trial, step, further, r, A, turns, F, F_turns));   z: the root, or NaN

   q is a constant where these functions are called: their loops are short. */
#pragma once
#include <stddef.h>
#include "constants.h"
#include "functions.h"

#define NEWTON_EPSILON (TGCO_IS_DOUBLE ? 0x1p-52 : 0x1p-23)
#define NEWTON_BY_ROUNDING (TGCO_IS_DOUBLE ? NEWTON_ROUNDED_DOUBLE : NEWTON_ROUNDED_SINGLE)
#define NEWTON_PIVOT 0.1 /* of a column's largest entry a pivot may be (Duff, Erisman and Reid, Direct Methods, 5.2) */

typedef struct {
    V share, length, size; /* of the step that is tried, its largest entry, and the residual's square at z */
    I begins, fresh; /* slopes of the trial are taken without a test; F is that of z */
    I done, lost;
    int evaluations, turned; /* turned: whether F has exchanges */
} newton_state;

static inline newton_state newton_begin(int q, const V *trial, V *z, V *step) {
    newton_state s;
    I none = SET(0.0) != SET(0.0);
    s.share = SET(1.0);
    s.length = s.size = SET(0.0);
    s.begins = NOT(none);
    s.fresh = s.done = s.lost = none;
    s.evaluations = s.turned = 0;
    for (int i = 0; i < q; i++) z[i] = trial[i], step[i] = SET(0.0);
    return s;
}

static inline void newton_exchange(I where, V *a, V *b) {
    V kept = *a;
    *a = tgco_choose(where, *b, *a);
    *b = tgco_choose(where, kept, *b);
}

/* Elimination in place: unit upper U, and below it the factors of rows, with the inverses of the pivots on the diagonal.
   turns (q, q): where row i was exchanged with row j, whose entry in column j was too small; they differ between lanes.
   Returns whether any was: exchanges take longer than all else, and few matrices need them. */
TGCO_INLINE int newton_factor(int q, V *A, I *turns) {
    int turned = 0;
    for (int j = 0; j < q; j++) {
        for (int i = j + 1; i < q; i++) {
            turns[j * q + i] = SET(NEWTON_PIVOT) * tgco_fabs(A[i * q + j]) > tgco_fabs(A[j * q + j]);
            if (!tgco_any(turns[j * q + i])) continue;
            turned = 1;
            for (int l = j; l < q; l++) newton_exchange(turns[j * q + i], &A[i * q + l], &A[j * q + l]);
        }
        V inverse = SET(1.0) / A[j * q + j];
        A[j * q + j] = inverse;
        for (int l = j + 1; l < q; l++) A[j * q + l] = A[j * q + l] * inverse;
        for (int i = j + 1; i < q; i++)
            for (int l = j + 1; l < q; l++) SUBTRACT(A[i * q + l], A[i * q + j], A[j * q + l]);
    }
    return turned;
}

/* b = A^-1 b; turns: NULL where there were none. */
TGCO_INLINE void newton_solve(int q, const V *A, const I *turns, V *b) {
    for (int j = 0; j < q; j++) {
        if (turns) for (int i = j + 1; i < q; i++) newton_exchange(turns[j * q + i], &b[i], &b[j]);
        b[j] = b[j] * A[j * q + j];
        for (int i = j + 1; i < q; i++) SUBTRACT(b[i], A[i * q + j], b[j]);
    }
    for (int j = q - 1; j > 0; j--) for (int i = 0; i < j; i++) SUBTRACT(b[i], A[i * q + j], b[j]);
}

/* b = A'^-1 b. */
TGCO_INLINE void newton_solve_turned(int q, const V *A, const I *turns, V *b) {
    for (int i = 0; i < q; i++) for (int j = i + 1; j < q; j++) SUBTRACT(b[j], A[i * q + j], b[i]);
    for (int j = q - 1; j >= 0; j--) {
        for (int i = j + 1; i < q; i++) SUBTRACT(b[j], A[i * q + j], b[i]);
        b[j] = b[j] * A[j * q + j];
        if (turns) for (int i = q - 1; i > j; i--) newton_exchange(turns[j * q + i], &b[i], &b[j]);
    }
}

static inline V newton_largest(int q, const V *a) {
    V largest = SET(0.0);
    for (int i = 0; i < q; i++) largest = tgco_maximum(largest, tgco_fabs(a[i]));
    return largest;
}

/* Whether a lane goes on, at the trial that is written. F is the factored A that steps come from. */
TGCO_INLINE int newton_next(
    newton_state *s, int q, V *z, V *trial, V *step, V *further, V *r, V *A, I *turns, V *F, I *F_turns) {
    V of_trial = newton_largest(q, trial), length = s->length, left = newton_largest(q, r);
    for (int i = 0; i < q; i++) further[i] = -r[i];
    if (s->evaluations == 0) {
        s->done = s->lost = NOT(left < SET(INFINITY));
        s->begins = NOT(s->lost);
    } else {
        newton_solve(q, F, s->turned ? F_turns : NULL, further);
        left = newton_largest(q, further);
    }
    V size = SET(0.0);
    for (int i = 0; i < q; i++) ADD(size, r[i], r[i]);
    I tested = NOT(s->begins | s->done), better = s->begins | (tested & ((left <= length) | (size < s->size)));
    s->size = tgco_choose(better, size, s->size);
    I ends = tested & better & (left * left <= SET(NEWTON_EPSILON) * of_trial * length);
    for (int i = 0; i < q; i++) {
        V ahead = trial[i] + tgco_if(ends, further[i]);
        z[i] = tgco_choose(better, ahead, z[i]);
    }
    I serves = left <= SET(NEWTON_SERVES_AGAIN) * length;
    ends = ends | (tested & NOT(serves) & (length <= SET(NEWTON_BY_ROUNDING) * of_trial));
    s->done = s->done | ends;
    if (!tgco_any(NOT(s->done)) || s->evaluations++ == NEWTON_MOST) {
        for (int i = 0; i < q; i++) z[i] = tgco_choose(s->done & NOT(s->lost), z[i], SET(NAN));
        return 0;
    }
    I stale = better & NOT(ends) & (s->begins | NOT(serves));
    if (tgco_any(stale)) {
        int turned = newton_factor(q, A, turns);
        if (turned && !s->turned) for (int i = 0; i < q * q; i++) F_turns[i] = s->lost & NOT(s->lost);
        s->turned |= turned;
        for (int i = 0; i < q * q; i++) F[i] = tgco_choose(stale, A[i], F[i]);
        if (s->turned) for (int j = 0; j < q; j++) for (int i = j * q + j + 1; i < j * q + q; i++)
            F_turns[i] = (stale & turns[i]) | (NOT(stale) & F_turns[i]);
        for (int i = 0; i < q; i++) r[i] = -r[i];
        newton_solve(q, F, s->turned ? F_turns : NULL, r);
        for (int i = 0; i < q; i++) further[i] = tgco_choose(stale, r[i], further[i]);
    }
    s->begins = tested & NOT(better | ends | s->fresh); /* steps are halved with slopes of z alone */
    s->fresh = stale | (s->fresh & NOT(better));
    s->share = tgco_choose(better | s->begins, SET(1.0), SET(0.5) * s->share);
    V share = tgco_choose(s->begins, SET(0.0), s->share);
    for (int i = 0; i < q; i++) {
        step[i] = tgco_choose(better, further[i], step[i]);
        trial[i] = tgco_fused(share, step[i], z[i]);
    }
    s->length = newton_largest(q, step);
    return 1;
}

/* to (q, count) = -A^-1 from, column by column, of a factored A. */
TGCO_INLINE void newton_slopes(int q, int count, const V *A, const I *turns, const V *from, V *to) {
    for (int l = 0; l < count * q; l++) to[l] = -from[l];
    for (int l = 0; l < count; l++) newton_solve(q, A, turns, to + l * q);
}

/* The same with the transpose of A. */
TGCO_INLINE void newton_back(int q, int count, const V *A, const I *turns, const V *from, V *to) {
    for (int l = 0; l < count * q; l++) to[l] = -from[l];
    for (int l = 0; l < count; l++) newton_solve_turned(q, A, turns, to + l * q);
}
