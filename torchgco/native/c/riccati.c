/* The Riccati recursion of the interior point: factors of all stages, and the step in states, controls and costates. */
#include "interior.h"
#include "code.h"
#include "cholesky.h"

/* The factor of the cost-to-go's curvature in the free components of the start, and the unit matrix in the others. */
static I factor_start(Barrier *t) {
    OUT L = t->L_start; V one = SET(1.0);
    I good = one == one;
    for (int j = 0; j < NX; j++) {
        I own = tgco_is(t->is_free[j]);
        V whole = tgco_choose(own, t->P[ENTRY(j, j)], one), pivot = whole;
        for (int a = 0; a < j; a++) SUBTRACT(pivot, L[ENTRY(j, a)], L[ENTRY(j, a)]);
        good &= (pivot > SET(1e-14) * tgco_fabs(whole)) & tgco_finite(pivot);
        V inverse = one / tgco_sqrt(pivot);
        L[ENTRY(j, j)] = inverse;
        for (int i = j + 1; i < NX; i++) {
            V entry = tgco_if(own & tgco_is(t->is_free[i]), t->P[ENTRY(i, j)]);
            for (int a = 0; a < j; a++) SUBTRACT(entry, L[ENTRY(i, a)], L[ENTRY(j, a)]);
            L[ENTRY(i, j)] = entry * inverse;
        }
    }
    return good;
}

/* Factors L and gains K of the recursion with `shift` on the diagonal; where it isn't positive definite, the answer is
   false. It stops as soon as it is false for all lanes of `open`, unless there are none: what it says of others then
   is void. */
TGCO_BETWEEN_UNITS I factor(Barrier *t, I open) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    LOCAL_NUMBERS(t, Q, 0, S * S);
    LOCAL_NUMBERS(t, T, S * S, S * NX);
    LOCAL_NUMBERS(t, Y, S * S, NU * NX); /* after T */
    LOCAL_NUMBERS(t, ahead, S * S + S * NX, NX * NX);
    V pivots[NU];
    I good = SET(0.0) == SET(0.0);
    int stops = any(open);
    IN last = t->H + N * TRIANGLE(S); OUT end = t->P + N * TRIANGLE(NX);
    for (int i = 0; i < NX; i++) for (int j = 0; j <= i; j++)
        end[ENTRY(i, j)] = last[ENTRY(i, j)] + (i == j ? t->shift : SET(0.0));
    unfold(end, ahead, NX);
    for (int64_t k = N - 1; k >= 0; k--) {
        IN H = t->H + k * TRIANGLE(S); IN f = t->f + k * NJ;
        OUT L = t->L + k * TRIANGLE(NU); OUT K = s->G + k * NU * NZ; OUT P = t->P + k * TRIANGLE(NX);
        tgco_gather(ahead, f, T);
        tgco_product(f, T, Q);
        for (int i = 0; i < S; i++) for (int j = 0; j <= i; j++) Q[j * S + i] += H[ENTRY(i, j)];
        for (int i = 0; i < S; i++) Q[i * S + i] += t->shift;
        factor_controls(Q, L, pivots);
        for (int j = 0; j < NU; j++) {
            V whole = Q[(NX + j) * S + NX + j];
            good &= (pivots[j] > SET(t->how->pivot) * tgco_fabs(whole)) & tgco_finite(pivots[j]);
            for (int i = 0; i < NX; i++) Y[j * NX + i] = Q[i * S + NX + j];
        }
        solve_lower(L, Y, NX, NX);
        if (stops && !any(open & good)) return good;
        for (int j = 0; j < NU; j++) for (int i = 0; i < NX; i++) K[j * NZ + i] = -Y[j * NX + i];
        solve_upper(L, K, NZ, NX);
        for (int l = 0; l < NX; l++) for (int i = 0; i <= l; i++) {
            V entry = Q[i * S + l];
            for (int j = 0; j < NU; j++) SUBTRACT(entry, Y[j * NX + i], Y[j * NX + l]);
            P[ENTRY(l, i)] = ahead[i * NX + l] = ahead[l * NX + i] = entry;
        }
    }
    return t->is_free ? good & factor_start(t) : good;
}

/* The step of the start that is the least of the quadratic cost-to-go. */
static void solve_start(Barrier *t) {
    IN L = t->L_start;
    OUT d = t->dx;
    for (int i = 0; i < NX; i++) {
        d[i] = tgco_if(tgco_is(t->is_free[i]), -t->p[i]);
        for (int a = 0; a < i; a++) SUBTRACT(d[i], L[ENTRY(i, a)], d[a]);
        d[i] *= L[ENTRY(i, i)];
    }
    for (int i = NX - 1; i >= 0; i--) {
        for (int a = i + 1; a < NX; a++) SUBTRACT(d[i], L[ENTRY(a, i)], d[a]);
        d[i] = tgco_if(tgco_is(t->is_free[i]), d[i] * L[ENTRY(i, i)]);
    }
}

/* The step in states, controls and costates that the factors give. */
TGCO_BETWEEN_UNITS void solve(Barrier *t) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V q[S], z[S], along_f[NX];
    for (int i = 0; i < NX; i++) t->p[N * NX + i] = t->g[1][N * S + i] + t->mu * t->g[2][N * S + i];
    for (int64_t k = N - 1; k >= 0; k--) {
        IN P = t->P + (k + 1) * TRIANGLE(NX); IN next = t->p + (k + 1) * NX; IN L = t->L + k * TRIANGLE(NU);
        OUT K = s->G + k * NU * NZ; V v[NX];
        for (int i = 0; i < NX; i++) v[i] = next[i];
        add_product(P, t->aim + k * NX, v, NX);
        tgco_pull_back(v, t->f + k * NJ, q);
        for (int i = 0; i < S; i++) q[i] += t->g[1][k * S + i] + t->mu * t->g[2][k * S + i];
        for (int i = 0; i < NX; i++) {
            V entry = q[i];
            for (int j = 0; j < NU; j++) ADD(entry, K[j * NZ + i], q[NX + j]);
            t->p[k * NX + i] = entry;
        }
        V d[NU];
        for (int j = 0; j < NU; j++) d[j] = -q[NX + j];
        solve_lower(L, d, 1, 1);
        solve_upper(L, d, 1, 1);
        for (int j = 0; j < NU; j++) K[j * NZ + NX] = d[j];
    }
    for (int i = 0; i < NX; i++) t->dx[i] = SET(0.0);
    if (t->is_free) solve_start(t);
    for (int64_t k = 0; k < N; k++) {
        IN K = s->G + k * NU * NZ; IN P = t->P + (k + 1) * TRIANGLE(NX);
        OUT dx = t->dx + k * NX; OUT du = t->du + k * NU;
        for (int i = 0; i < NX; i++) z[i] = dx[i];
        for (int j = 0; j < NU; j++) {
            du[j] = K[j * NZ + NX];
            for (int i = 0; i < NX; i++) ADD(du[j], K[j * NZ + i], dx[i]);
            z[NX + j] = du[j];
        }
        model_push(t->f + k * NJ, z, along_f);
        for (int i = 0; i < NX; i++) dx[NX + i] = along_f[i] + t->aim[k * NX + i];
        OUT y = t->yn + (k + 1) * NX;
        for (int i = 0; i < NX; i++) y[i] = t->p[(k + 1) * NX + i];
        add_product(P, dx + NX, y, NX);
    }
}
