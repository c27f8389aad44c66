/* A Newton step of the interior point around its Riccati recursion: the model of all knots, and the step of slacks and
   multipliers. */
#pragma once
#include "interior_rows.h"
#include "asking.h"

/* The cost of the lanes `of` along X, U, scaled. */
TGCO_LARGE V cost_along(const Barrier *t, I of, IN X, IN U) {
    V total = SET(0.0);
    int64_t N = t->lanes.of->N;
    ask(t, VALUES, of, X, U);
    for (int64_t k = 0; k < N; k++) total += cost_value(&t->lanes, k, X + k * NX, U + k * NU);
    return t->scale * (total + cost_value(&t->lanes, N, X + N * NX, NONE));
}

/* Values of the lanes `of` along X, U into c and gap; returns the cost. */
TGCO_LARGE V values(const Barrier *t, I of, IN X, IN U, OUT c, OUT gap) {
    const Lanes *s = &t->lanes;
    V cost = cost_along(t, of, X, U);
    const Problem *p = s->of;
    int relaxes = any(t->relaxed);
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = X + k * NX; IN u = k < p->N ? U + k * NU : 0;
        for (int64_t i = 0; i < p->constraints; i++) {
            if (p->constraint[i].place[k] == NOWHERE) continue;
            int64_t q = row_of(t, i, k), end = q + p->constraint[i].rows;
            rows_at(s, i, k, x, u, c + q);
            if (relaxes && !p->constraint[i].equality) for (; q < end; q++) c[q] -= tgco_if(t->relaxed, t->room[q]);
        }
        if (!u) break;
        V next[NX];
        model_step(x, u, model_at(s, k), s->of->shared, next);
        for (int i = 0; i < NX; i++) gap[k * NX + i] = next[i] - X[(k + 1) * NX + i];
    }
    return cost;
}

/* Residuals of the rows: c + s, or c of equalities. */
TGCO_LARGE void residuals(const Barrier *t, IN c, IN s, OUT r) {
    const Problem *p = t->lanes.of;
    for (int64_t i = 0, q = 0; i < p->constraints; i++)
        for (int64_t end = q + p->constraint[i].knots * p->constraint[i].rows; q < end; q++)
            r[q] = p->constraint[i].equality ? c[q] : by_role(t, q, c[q] + s[q], c[q]);
}

/* Slopes and curvatures of all knots at the iterate. */
TGCO_LARGE void expand(Barrier *t) {
    Lanes *s = &t->lanes;
    const Problem *p = s->of;
    V weight = t->scale * t->objective;
    LOCAL_NUMBERS(t, H, 0, S * S);
    ask(t, DERIVATIVES, t->live, s->X, s->U);
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = s->X + k * NX; IN u = k < p->N ? s->U + k * NU : 0;
        OUT slope = t->cost_slope + k * S;
        for (int i = 0; i < S; i++) memset(H + i * S + i, 0, (S - i) * sizeof(V)); /* the lower triangle isn't used */
        memset(slope, 0, S * sizeof(V));
        cost_expand(s, k, x, u, slope, H);
        for (int i = 0; i < S; i++) {
            slope[i] *= weight;
            t->g[0][k * S + i] = t->g[1][k * S + i] = slope[i];
            t->g[2][k * S + i] = SET(0.0);
            for (int j = i; j < S; j++) H[i * S + j] *= weight;
        }
        for (int64_t i = 0; i < p->constraints; i++)
            if (p->constraint[i].place[k] != NOWHERE) add_rows(t, i, k, x, u, H);
        if (u) {
            V y[NX];
            for (int i = 0; i < NX; i++) y[i] = t->objective * t->y[(k + 1) * NX + i];
            model_expand(x, u, model_at(s, k), s->of->shared, y, t->f + k * NJ, H);
        }
        fold(H, t->H + k * TRIANGLE(S), S);
    }
}

/* The step of slacks and multipliers that belongs to dx, du. */
TGCO_LARGE void solve_rows(Barrier *t) {
    const Lanes *s = &t->lanes;
    const Problem *p = s->of;
    V z[S];
    for (int64_t k = 0; k <= p->N; k++) {
        IN x = s->X + k * NX; IN u = k < p->N ? s->U + k * NU : 0;
        for (int i = 0; i < NX; i++) z[i] = t->dx[k * NX + i];
        for (int j = 0; j < NU; j++) z[NX + j] = u ? t->du[k * NU + j] : SET(0.0);
        for (int64_t i = 0; i < p->constraints; i++) {
            const Constraint *con = p->constraint + i;
            if (con->place[k] == NOWHERE) continue;
            int64_t q = row_of(t, i, k);
            along(t, i, k, x, u, z, t->ds + q);
            for (int j = 0; j < con->rows; j++, q++) {
                V change = t->ds[q] + t->r[q];
                if (con->equality) {
                    t->ds[q] = SET(0.0);
                    t->dz[q] = change / softness(t, q);
                } else {
                    t->ds[q] = by_role(t, q, -change, SET(0.0));
                    t->dz[q] = by_role(t, q, (t->mu + t->z[q] * change) / t->s[q] - t->z[q], change / softness(t, q));
                }
            }
        }
    }
}
