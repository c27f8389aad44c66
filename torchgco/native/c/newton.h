/* The root of q equations in each lane, by Newton's method with corrections that are halved until the residual is less;
   base/roots.py has the same in PyTorch. What a lane finds doesn't depend on the others: those that are done wait.

       newton_state newton = newton_begin(q, trial, z, correction);          trial: the guess
       do equation(trial, r, A);                                             its residual r (q), slopes A (q, q) by rows
       while (newton_next(&newton, q, z, trial, correction, r, A, turns));   z: the root, NaN where none is found

   q is a constant where these functions are called: their loops are short. */
#pragma once
#include "functions.h"

#define NEWTON_NEAR (TGCO_IS_DOUBLE ? 0x1.428a2f98d7294p-35 : 0x1.965fea53d6e3ap-16) /* the precision to the power 2/3 */
#define NEWTON_EPSILON (TGCO_IS_DOUBLE ? 0x1p-52 : 0x1p-23)
#define NEWTON_MOST 30 /* evaluations of the equations */

typedef struct {
    V size, share; /* of the residual at z, and of the correction that is tried */
    V largest; /* entry of the correction */
    I done;
    int evaluations;
} newton_state;

static inline newton_state newton_begin(int q, const V *trial, V *z, V *correction) {
    newton_state s;
    s.size = SET(INFINITY);
    s.share = SET(1.0);
    s.largest = SET(0.0);
    s.done = SET(0.0) != SET(0.0);
    s.evaluations = 0;
    for (int i = 0; i < q; i++) z[i] = trial[i], correction[i] = SET(0.0);
    return s;
}

static inline void newton_exchange(I where, V *a, V *b) {
    V kept = *a;
    *a = tgco_choose(where, *b, *a);
    *b = tgco_choose(where, kept, *b);
}

/* Elimination in place: unit upper U, and below it the factors of rows, with the inverses of the pivots on the diagonal.
   turns (q, q): where row i was exchanged with row j, whose entry in column j was less; they differ between lanes. */
TGCO_INLINE void newton_factor(int q, V *A, I *turns) {
    for (int j = 0; j < q; j++) {
        for (int i = j + 1; i < q; i++) {
            turns[j * q + i] = tgco_fabs(A[i * q + j]) > tgco_fabs(A[j * q + j]);
            for (int l = j; l < q; l++) newton_exchange(turns[j * q + i], &A[i * q + l], &A[j * q + l]);
        }
        V inverse = SET(1.0) / A[j * q + j];
        A[j * q + j] = inverse;
        for (int l = j + 1; l < q; l++) A[j * q + l] = A[j * q + l] * inverse;
        for (int i = j + 1; i < q; i++)
            for (int l = j + 1; l < q; l++) SUBTRACT(A[i * q + l], A[i * q + j], A[j * q + l]);
    }
}

/* b = A^-1 b. */
TGCO_INLINE void newton_solve(int q, const V *A, const I *turns, V *b) {
    for (int j = 0; j < q; j++) {
        for (int i = j + 1; i < q; i++) newton_exchange(turns[j * q + i], &b[i], &b[j]);
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
        for (int i = q - 1; i > j; i--) newton_exchange(turns[j * q + i], &b[i], &b[j]);
    }
}

/* Whether a lane goes on, at the trial that is written. */
TGCO_INLINE int newton_next(newton_state *s, int q, V *z, V *trial, V *correction, V *r, V *A, I *turns) {
    V size = SET(0.0), of_trial = SET(0.0), largest = SET(0.0);
    for (int i = 0; i < q; i++) {
        ADD(size, r[i], r[i]);
        of_trial = tgco_maximum(of_trial, tgco_fabs(trial[i]));
    }
    I first = NOT(s->size < SET(INFINITY)), better = (size < s->size) & NOT(s->done);
    /* The next correction is less than rounding, if it is to this residual as the last one was to the one before. */
    V least = SET(NEWTON_EPSILON) * of_trial;
    I ends = better & NOT(first) & (size * s->largest * s->largest <= least * least * s->size);
    s->size = tgco_choose(better, size, s->size);
    s->share = tgco_choose(better, SET(1.0), SET(0.5) * s->share);
    s->done = s->done | ends;
    for (int i = 0; i < q; i++) z[i] = tgco_choose(better, trial[i], z[i]);
    if (tgco_any(NOT(s->done))) {
        newton_factor(q, A, turns);
        newton_solve(q, A, turns, r);
        for (int i = 0; i < q; i++) {
            correction[i] = tgco_choose(better, -r[i], correction[i]);
            largest = tgco_maximum(largest, tgco_fabs(correction[i]));
        }
        s->largest = tgco_choose(better, largest, s->largest);
        ends = better & NOT(s->done) & (largest <= SET(NEWTON_NEAR) * of_trial);
        for (int i = 0; i < q; i++) {
            z[i] = tgco_choose(ends, z[i] + correction[i], z[i]);
            trial[i] = tgco_fused(s->share, correction[i], z[i]);
        }
        s->done = s->done | ends;
    }
    if (tgco_any(NOT(s->done)) && ++s->evaluations < NEWTON_MOST) return 1;
    for (int i = 0; i < q; i++) z[i] = tgco_choose(s->done, z[i], SET(NAN));
    return 0;
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
