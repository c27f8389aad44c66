/* Passes along a trajectory: rollouts with the gains, and the backward pass that computes them. */
#include "model.h"
#include "code.h"
#include "cholesky.h"
#include "passes.h"

/* The forward pass (line 16) from the nominal X, U along G with step lengths alpha; writes Xn, Un, J_var and L_M. It ends
   early, with what has added up so far, where that is over `enough` in all lanes, or isn't a number. */
TGCO_BETWEEN_UNITS void roll(Lanes *s, CALLABLE(Value) value, V alpha, V enough, V *cost, V *merit) {
    const Problem *p = s->of;
    V total = SET(0.0), more = SET(0.0);
    memcpy(s->Xn, s->X, NX * sizeof(V));
    for (int64_t k = 0; k < p->N; k++) {
        IN X = s->X + k * NX; IN G = s->G + k * NU * NZ;
        OUT x = s->Xn + k * NX; OUT u = s->Un + k * NU; V dx[NX];
        for (int i = 0; i < NX; i++) dx[i] = x[i] - X[i];
        for (int j = 0; j < NU; j++) {
            V step = alpha * G[j * NZ + NX];
            for (int i = 0; i < NX; i++) ADD(step, G[j * NZ + i], dx[i]);
            u[j] = s->U[k * NU + j] + step;
        }
        total += cost_value(s, k, x, u);
        more += value(s, k, x, u);
        if (!any(total + more <= enough)) { *cost = total; *merit = total + more; return; }
        model_step(x, u, model_at(s, k), s->of->shared, x + NX);
    }
    total += cost_value(s, p->N, s->Xn + p->N * NX, NONE);
    more += value(s, p->N, s->Xn + p->N * NX, NONE);
    *cost = total;
    *merit = total + more;
}

/* The backward pass (lines 4-13): gains into G, the two sums of the expected change, and the smallest pivot. `gap`
   (N, NX) is how far each step ends from the knot after it, NULL along a rollout. */
TGCO_BETWEEN_UNITS void backward(Lanes *s, CALLABLE(Expand) expand, IN gap, V *linear, V *squares, V *lowest) {
    const Problem *p = s->of;
    V P[NX * NX], vector[NX], g[S], H[S * S], T[S * NX], f[NJ ? NJ : 1], L[TRIANGLE(NU)], Y[NU * NZ], pivots[NU];
    V sum = SET(0.0), square = SET(0.0), least = SET(INFINITY);
    int regular = any(s->mu_r > SET(0.0));
    memset(g, 0, sizeof g); memset(H, 0, sizeof H);
    cost_expand(s, p->N, s->X + p->N * NX, NONE, g, H);
    expand(s, p->N, s->X + p->N * NX, NONE, g, H);
    for (int i = 0; i < NX; i++) {
        vector[i] = g[i];
        for (int j = 0; j < NX; j++) P[i * NX + j] = i <= j ? H[i * S + j] : H[j * S + i];
    }
    for (int64_t k = p->N - 1; k >= 0; k--) {
        IN x = s->X + k * NX; IN u = s->U + k * NU;
        OUT G = s->G + k * NU * NZ;
        tgco_jacobian(x, u, model_at(s, k), s->of->shared, f);
        tgco_gather(P, f, T);
        tgco_product(f, T, H);
        if (gap) for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) ADD(vector[i], P[i * NX + j], gap[k * NX + j]);
        tgco_pull_back(vector, f, g);
        cost_expand(s, k, x, u, g, H);
        expand(s, k, x, u, g, H);
        /* L of Quu + mu_r I, Y = L^-1 [Qux Qu], [K d] = -L'^-1 Y. */
        for (int j = 0; j < NU; j++) H[(NX + j) * S + NX + j] += s->mu_r;
        factor_controls(H, L, pivots);
        for (int j = 0; j < NU; j++) {
            least = tgco_choose((pivots[j] < least) | (pivots[j] != pivots[j]), pivots[j], least);
            for (int i = 0; i < NX; i++) Y[j * NZ + i] = H[i * S + NX + j];
            Y[j * NZ + NX] = g[NX + j];
        }
        solve_lower(L, Y, NZ, NZ);
        for (int i = 0; i < NU * NZ; i++) G[i] = -Y[i];
        solve_upper(L, G, NZ, NZ);
        for (int j = 0; j < NU; j++) {
            ADD(sum, g[NX + j], G[j * NZ + NX]);
            ADD(square, G[j * NZ + NX], G[j * NZ + NX]);
        }
        /* V = Qzz - Y'Y - mu_r G'G */
        for (int i = 0; i < NX; i++) {
            V slope = g[i];
            for (int j = 0; j < NU; j++) SUBTRACT(slope, Y[j * NZ + i], Y[j * NZ + NX]);
            if (regular) for (int j = 0; j < NU; j++) SUBTRACT(slope, s->mu_r * G[j * NZ + i], G[j * NZ + NX]);
            vector[i] = slope;
            for (int l = i; l < NX; l++) {
                V entry = H[i * S + l];
                for (int j = 0; j < NU; j++) SUBTRACT(entry, Y[j * NZ + i], Y[j * NZ + l]);
                if (regular) for (int j = 0; j < NU; j++) SUBTRACT(entry, s->mu_r * G[j * NZ + i], G[j * NZ + l]);
                P[i * NX + l] = P[l * NX + i] = entry;
            }
        }
    }
    *linear = sum; *squares = square; *lowest = least;
}

/* Whether everything that the backward pass reads is finite. */
TGCO_BETWEEN_UNITS I is_finite(const Lanes *s, CALLABLE(Expand) expand) {
    const Problem *p = s->of;
    V g[S], H[S * S], f[NJ ? NJ : 1], sum = SET(0.0);
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = s->X + k * NX; IN u = k < p->N ? s->U + k * NU : 0;
        memset(g, 0, sizeof g); memset(H, 0, sizeof H);
        cost_expand(s, k, x, u, g, H);
        expand(s, k, x, u, g, H);
        for (int i = 0; i < S; i++) sum += SET(0.0) * g[i];
        for (int i = 0; i < S * S; i++) sum += SET(0.0) * H[i];
        if (k == p->N) break;
        tgco_jacobian(x, u, model_at(s, k), s->of->shared, f);
        for (int i = 0; i < NJ; i++) sum += SET(0.0) * f[i];
    }
    return sum == SET(0.0);
}

/* How far each step ends from the knot after it. */
TGCO_BETWEEN_UNITS void gaps(const Lanes *s, OUT gap) {
    for (int64_t k = 0; k < s->of->N; k++) {
        V next[NX];
        model_step(s->X + k * NX, s->U + k * NU, model_at(s, k), s->of->shared, next);
        for (int i = 0; i < NX; i++) gap[k * NX + i] = next[i] - s->X[(k + 1) * NX + i];
    }
}

/* A full step of the linearised dynamics under the gains, which closes the gaps; added to X and U. */
TGCO_BETWEEN_UNITS void linear_step(Lanes *s, IN gap) {
    V one[NX * NX], F[NX * S], f[NJ ? NJ : 1], z[S], dx[NX];
    for (int i = 0; i < NX * NX; i++) one[i] = SET(i % (NX + 1) == 0);
    for (int i = 0; i < NX; i++) dx[i] = SET(0.0);
    for (int64_t k = 0; k < s->of->N; k++) {
        OUT x = s->X + k * NX; OUT u = s->U + k * NU;
        IN G = s->G + k * NU * NZ;
        tgco_jacobian(x, u, model_at(s, k), s->of->shared, f);
        tgco_gather(one, f, F);
        memcpy(z, dx, sizeof dx);
        for (int j = 0; j < NU; j++) {
            z[NX + j] = G[j * NZ + NX];
            for (int i = 0; i < NX; i++) ADD(z[NX + j], G[j * NZ + i], dx[i]);
        }
        for (int i = 0; i < NX; i++) {
            x[i] += dx[i];
            dx[i] = gap[k * NX + i];
            for (int c = 0; c < S; c++) ADD(dx[i], F[c * NX + i], z[c]);
        }
        for (int j = 0; j < NU; j++) u[j] += z[NX + j];
    }
    for (int i = 0; i < NX; i++) s->X[s->of->N * NX + i] += dx[i];
}
