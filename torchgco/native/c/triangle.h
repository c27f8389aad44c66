/* Symmetric matrices as lower triangles, row by row: the first rows are those of the first variables' block. */
#pragma once
#include "model.h"

#define ENTRY(i, j) ((i) * ((i) + 1) / 2 + (j)) /* of row i, column j <= i */
#define TRIANGLE(n) ENTRY(n, 0)                 /* numbers of n rows */

/* Both triangles of a matrix (n, n) from its lower one. */
static inline void unfold(IN lower, OUT whole, int n) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) whole[i * n + j] = whole[j * n + i] = lower[ENTRY(i, j)];
}

/* The lower triangle of a matrix (n, n) from its upper one. */
static inline void fold(IN upper, OUT lower, int n) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) lower[ENTRY(i, j)] = upper[j * n + i];
}

/* y += A x. */
static inline void add_product(IN lower, IN x, OUT y, int n) {
    for (int i = 0; i < n; i++) {
        V sum = y[i];
        for (int j = 0; j < i; j++) ADD(sum, lower[ENTRY(i, j)], x[j]);
        for (int j = i, at = ENTRY(i, i); j < n; at += ++j) ADD(sum, lower[at], x[j]); /* down a column */
        y[i] = sum;
    }
}
