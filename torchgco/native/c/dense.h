/* Products with dense slopes f (NX, S) of a step, and Hessians (S, S) that are added. */
#pragma once
#include "model.h"

static inline void add_upper(IN from, OUT H) {
    for (int i = 0; i < S; i++) for (int j = i; j < S; j++) H[i * S + j] += from[i * S + j];
}

static inline void tgco_gather(IN ALONE P, IN ALONE f, OUT ALONE T) { /* T = P [fx fu] */
    for (int c = 0; c < S; c++) for (int r = 0; r < NX; r++) {
        T[c * NX + r] = SET(0.0);
        for (int i = 0; i < NX; i++) ADD(T[c * NX + r], f[i * S + c], P[i * NX + r]);
    }
}

static inline void tgco_product(IN ALONE f, IN ALONE T, OUT ALONE H) { /* H = [fx fu]' T */
    for (int c = 0; c < S; c++) for (int l = c; l < S; l++) {
        H[c * S + l] = SET(0.0);
        for (int i = 0; i < NX; i++) ADD(H[c * S + l], f[i * S + c], T[l * NX + i]);
    }
}

static inline void tgco_pull_back(IN ALONE p, IN ALONE f, OUT ALONE g) { /* g = [fx fu]' p */
    for (int v = 0; v < S; v++) {
        g[v] = SET(0.0);
        for (int i = 0; i < NX; i++) ADD(g[v], f[i * S + v], p[i]);
    }
}
