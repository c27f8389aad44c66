/* The Cholesky factor of the controls' block of a stage's Hessian, and triangular systems with it. */
#pragma once
#include "triangle.h"

/* L of L L' = H_uu, of which the upper triangle in H (S, S) is read; L's diagonal is inverted. Pivots go into `pivots`. */
static inline void factor_controls(IN H, OUT L, OUT pivots) {
    for (int j = 0; j < NU; j++) {
        V pivot = H[(NX + j) * S + NX + j];
        for (int i = 0; i < j; i++) SUBTRACT(pivot, L[ENTRY(j, i)], L[ENTRY(j, i)]);
        pivots[j] = pivot;
        V inverse = SET(1.0) / tgco_sqrt(pivot);
        L[ENTRY(j, j)] = inverse;
        for (int i = j + 1; i < NU; i++) {
            V entry = H[(NX + j) * S + NX + i];
            for (int a = 0; a < j; a++) SUBTRACT(entry, L[ENTRY(i, a)], L[ENTRY(j, a)]);
            L[ENTRY(i, j)] = entry * inverse;
        }
    }
}

/* Y = L^-1 Y for `count` columns of Y (NU, width). */
static inline void solve_lower(IN L, OUT Y, int width, int count) {
    for (int j = 0; j < NU; j++) {
        OUT row = Y + j * width;
        for (int a = 0; a < j; a++) for (int i = 0; i < count; i++) SUBTRACT(row[i], L[ENTRY(j, a)], Y[a * width + i]);
        for (int i = 0; i < count; i++) row[i] *= L[ENTRY(j, j)];
    }
}

/* Y = L'^-1 Y for `count` columns of Y (NU, width). */
static inline void solve_upper(IN L, OUT Y, int width, int count) {
    for (int j = NU - 1; j >= 0; j--) {
        OUT row = Y + j * width;
        for (int a = j + 1; a < NU; a++)
            for (int i = 0; i < count; i++) SUBTRACT(row[i], L[ENTRY(a, j)], Y[a * width + i]);
        for (int i = 0; i < count; i++) row[i] *= L[ENTRY(j, j)];
    }
}
