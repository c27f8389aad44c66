/* The root of q equations in each lane, by Newton's method with corrections that are halved until the residual is less;
   base/roots.py has the same in PyTorch. What a lane finds doesn't depend on the others: those that are done wait.

       newton_state newton = newton_begin(q, trial, z, correction);      trial: the guess
       do equation(trial, r, A);                                         its residual r (q), slopes A (q, q) row by row
       while (newton_next(&newton, q, z, trial, correction, r, A));      z: the root, NaN where none is found */
#pragma once
#include "functions.h"

#define NEWTON_NEAR (TGCO_IS_DOUBLE ? 0x1.428a2f98d7294p-35 : 0x1.965fea53d6e3ap-16) /* the precision to the power 2/3 */
#define NEWTON_MOST 30 /* evaluations of the equations */

typedef struct {
    V size, share; /* of the residual at z, and of the correction that is tried */
    I done;
    int evaluations;
} newton_state;

static inline newton_state newton_begin(int q, const V *trial, V *z, V *correction) {
    newton_state s;
    s.size = SET(INFINITY);
    s.share = SET(1.0);
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

/* Row j of A (q, q) and B (q, count) becomes the one with the largest entry in column j, from row j on, of each lane. */
static inline void newton_pivot(int j, int q, int count, V *A, V *B) {
    for (int i = j + 1; i < q; i++) {
        I larger = tgco_fabs(A[i * q + j]) > tgco_fabs(A[j * q + j]);
        if (!tgco_any(larger)) continue;
        for (int l = j; l < q; l++) newton_exchange(larger, &A[i * q + l], &A[j * q + l]);
        for (int l = 0; l < count; l++) newton_exchange(larger, &B[i * count + l], &B[j * count + l]);
    }
}

/* B = A^-1 B of B (q, count), by elimination; A is lost. */
TGCO_APART void newton_solve(int q, int count, V *A, V *B) {
    for (int j = 0; j < q; j++) {
        newton_pivot(j, q, count, A, B);
        V inverse = SET(1.0) / A[j * q + j];
        for (int l = j + 1; l < q; l++) A[j * q + l] = A[j * q + l] * inverse;
        for (int l = 0; l < count; l++) B[j * count + l] = B[j * count + l] * inverse;
        for (int i = j + 1; i < q; i++) {
            V factor = A[i * q + j];
            for (int l = j + 1; l < q; l++) SUBTRACT(A[i * q + l], factor, A[j * q + l]);
            for (int l = 0; l < count; l++) SUBTRACT(B[i * count + l], factor, B[j * count + l]);
        }
    }
    for (int j = q - 1; j > 0; j--)
        for (int i = 0; i < j; i++)
            for (int l = 0; l < count; l++) SUBTRACT(B[i * count + l], A[i * q + j], B[j * count + l]);
}

static inline void newton_invert(int q, V *A, V *inverse) {
    for (int i = 0; i < q * q; i++) inverse[i] = SET(i % (q + 1) ? 0.0 : 1.0);
    newton_solve(q, q, A, inverse);
}

/* Whether a lane goes on, at the trial that is written. */
TGCO_APART int newton_next(newton_state *s, int q, V *z, V *trial, V *correction, V *r, V *A) {
    V size = SET(0.0), largest = SET(0.0), of_z = SET(0.0);
    for (int i = 0; i < q; i++) ADD(size, r[i], r[i]);
    I better = (size < s->size) & NOT(s->done);
    newton_solve(q, 1, A, r);
    s->size = tgco_choose(better, size, s->size);
    s->share = tgco_choose(better, SET(1.0), SET(0.5) * s->share);
    for (int i = 0; i < q; i++) {
        z[i] = tgco_choose(better, trial[i], z[i]);
        correction[i] = tgco_choose(better, -r[i], correction[i]);
        largest = tgco_maximum(largest, tgco_fabs(correction[i]));
        of_z = tgco_maximum(of_z, tgco_fabs(z[i]));
    }
    I ends = (largest <= SET(NEWTON_NEAR) * of_z) & (s->size < SET(INFINITY)) & NOT(s->done);
    for (int i = 0; i < q; i++) {
        z[i] = tgco_choose(ends, z[i] + correction[i], z[i]);
        trial[i] = tgco_fused(s->share, correction[i], z[i]);
    }
    s->done = s->done | ends;
    if (tgco_any(NOT(s->done)) && ++s->evaluations < NEWTON_MOST) return 1;
    for (int i = 0; i < q; i++) z[i] = tgco_choose(s->done, z[i], SET(NAN));
    return 0;
}

/* to (q, count) = -inverse from, column by column. */
static inline void newton_slopes(int q, int count, const V *inverse, const V *from, V *to) {
    for (int l = 0; l < count; l++) for (int i = 0; i < q; i++) {
        V sum = SET(0.0);
        for (int j = 0; j < q; j++) SUBTRACT(sum, inverse[i * q + j], from[l * q + j]);
        to[l * q + i] = sum;
    }
}

/* The same with the transposed inverse. */
static inline void newton_back(int q, int count, const V *inverse, const V *from, V *to) {
    for (int l = 0; l < count; l++) for (int i = 0; i < q; i++) {
        V sum = SET(0.0);
        for (int j = 0; j < q; j++) SUBTRACT(sum, inverse[j * q + i], from[l * q + j]);
        to[l * q + i] = sum;
    }
}
