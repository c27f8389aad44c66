/* A Newton step of the interior point: the model of all knots, a Riccati recursion, and the step of slacks and duals. */

/* Values along X, U into c and gap; returns the cost. */
static V values(const Barrier *t, const V *X, const V *U, V *c, V *gap) {
    const Lanes *s = &t->lanes;
    const Problem *p = s->of;
    V total = SET(0.0);
    for (int64_t k = 0; k <= p->N; k++) {
        const V *x = X + k * NX, *u = k < p->N ? U + k * NU : 0;
        for (int64_t i = 0; i < p->constraints; i++) {
            if (p->constraint[i].place[k] == NOWHERE) continue;
            int64_t q = row_of(t, i, k), end = q + p->constraint[i].rows;
            rows_at(s, i, k, x, u, c + q);
            if (t->some_relaxed) for (; q < end; q++) c[q] -= t->relaxed[q];
        }
        total += cost_value(s, k, x, u);
        if (!u) break;
        V next[NX];
        model_step(x, u, model_at(s, k), s->of->shared, next);
        for (int i = 0; i < NX; i++) gap[k * NX + i] = next[i] - X[(k + 1) * NX + i];
    }
    return t->scale * total;
}

/* Residuals of the rows: c + s, or c of equalities. */
static void residuals(const Barrier *t, const V *c, const V *s, V *r) {
    const Problem *p = t->lanes.of;
    for (int64_t i = 0, q = 0; i < p->constraints; i++)
        for (int64_t end = q + p->constraint[i].knots * p->constraint[i].rows; q < end; q++)
            r[q] = p->constraint[i].equality ? c[q] : by_role(t, q, c[q] + s[q], c[q]);
}

/* Slopes and curvatures of all knots at the iterate. */
static void expand(Barrier *t) {
    Lanes *s = &t->lanes;
    const Problem *p = s->of;
    V weight = t->scale * t->objective;
    for (int64_t k = 0; k <= p->N; k++) {
        const V *x = s->X + k * NX, *u = k < p->N ? s->U + k * NU : 0;
        V *H = t->H + k * S * S, *slope = t->cost_slope + k * S;
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
            if (p->constraint[i].place[k] != NOWHERE) add_rows(t, i, k, x, u);
        if (!u) break;
        V y[NX];
        for (int i = 0; i < NX; i++) y[i] = t->objective * t->y[(k + 1) * NX + i];
#ifdef TGCO_TOGETHER
        tgco_together(x, u, model_at(s, k), s->of->shared, y, t->f + k * NJ, H);
#else
        tgco_jacobian(x, u, model_at(s, k), s->of->shared, t->f + k * NJ);
        tgco_curve(x, u, model_at(s, k), s->of->shared, y, H);
#endif
    }
}

/* The factor of the cost-to-go's curvature in the free components of the start, and the unit matrix in the others. */
static I factor_start(Barrier *t) {
    V *L = t->L_start, one = SET(1.0);
    I good = one == one;
    for (int j = 0; j < NX; j++) {
        I own = tgco_is(t->is_free[j]);
        V whole = tgco_choose(own, t->P[j * NX + j], one), pivot = whole;
        for (int a = 0; a < j; a++) pivot -= L[j * NX + a] * L[j * NX + a];
        good &= (pivot > SET(1e-14) * tgco_fabs(whole)) & finite(pivot);
        V inverse = one / tgco_sqrt(pivot);
        L[j * NX + j] = inverse;
        for (int i = j + 1; i < NX; i++) {
            V entry = tgco_if(own & tgco_is(t->is_free[i]), t->P[i * NX + j]);
            for (int a = 0; a < j; a++) entry -= L[i * NX + a] * L[j * NX + a];
            L[i * NX + j] = entry * inverse;
        }
    }
    return good;
}

/* Factors L and gains K of the recursion with `shift` on the diagonal; where it isn't positive definite, the answer is
   false. It stops as soon as it is false for all lanes of `open`, unless there are none: what it says of others then
   is void. */
static I factor(Barrier *t, I open) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V T[S * NX], Q[S * S], Y[NU * NX], pivots[NU];
    I good = SET(0.0) == SET(0.0);
    int stops = any(open);
    const V *last = t->H + N * S * S;
    for (int i = 0; i < NX; i++) for (int j = i; j < NX; j++)
        t->P[(N * NX + i) * NX + j] = t->P[(N * NX + j) * NX + i] = last[i * S + j] + (i == j ? t->shift : SET(0.0));
    for (int64_t k = N - 1; k >= 0; k--) {
        const V *H = t->H + k * S * S, *f = t->f + k * NJ;
        V *L = t->L + k * NU * NU, *K = s->G + k * NU * NZ, *P = t->P + k * NX * NX;
        tgco_gather(P + NX * NX, f, T);
        tgco_product(f, T, Q);
        for (int i = 0; i < S; i++) for (int j = i; j < S; j++) Q[i * S + j] += H[i * S + j];
        for (int i = 0; i < S; i++) Q[i * S + i] += t->shift;
        factor_controls(Q, L, pivots);
        for (int j = 0; j < NU; j++) {
            V whole = Q[(NX + j) * S + NX + j];
            good &= (pivots[j] > SET(t->how->pivot) * tgco_fabs(whole)) & finite(pivots[j]);
            for (int i = 0; i < NX; i++) Y[j * NX + i] = Q[i * S + NX + j];
        }
        solve_lower(L, Y, NX, NX);
        if (stops && !any(open & good)) return good;
        for (int j = 0; j < NU; j++) for (int i = 0; i < NX; i++) K[j * NZ + i] = -Y[j * NX + i];
        solve_upper(L, K, NZ, NX);
        for (int i = 0; i < NX; i++) for (int l = i; l < NX; l++) {
            V entry = Q[i * S + l];
            for (int j = 0; j < NU; j++) entry -= Y[j * NX + i] * Y[j * NX + l];
            P[i * NX + l] = P[l * NX + i] = entry;
        }
    }
    return t->is_free ? good & factor_start(t) : good;
}

/* The step of the start that is the least of the quadratic cost-to-go. */
static void solve_start(Barrier *t) {
    const V *L = t->L_start;
    V *d = t->dx;
    for (int i = 0; i < NX; i++) {
        d[i] = tgco_if(tgco_is(t->is_free[i]), -t->p[i]);
        for (int a = 0; a < i; a++) d[i] -= L[i * NX + a] * d[a];
        d[i] *= L[i * NX + i];
    }
    for (int i = NX - 1; i >= 0; i--) {
        for (int a = i + 1; a < NX; a++) d[i] -= L[a * NX + i] * d[a];
        d[i] = tgco_if(tgco_is(t->is_free[i]), d[i] * L[i * NX + i]);
    }
}

/* The step in states, controls and costates that the factors give. */
static void solve(Barrier *t) {
    Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V q[S], z[S], along_f[NX];
    for (int i = 0; i < NX; i++) t->p[N * NX + i] = t->g[1][N * S + i] + t->mu * t->g[2][N * S + i];
    for (int64_t k = N - 1; k >= 0; k--) {
        const V *P = t->P + (k + 1) * NX * NX, *next = t->p + (k + 1) * NX, *L = t->L + k * NU * NU;
        V *K = s->G + k * NU * NZ, v[NX];
        for (int i = 0; i < NX; i++) {
            v[i] = next[i];
            for (int j = 0; j < NX; j++) v[i] += P[i * NX + j] * t->aim[k * NX + j];
        }
        tgco_pull_back(v, t->f + k * NJ, q);
        for (int i = 0; i < S; i++) q[i] += t->g[1][k * S + i] + t->mu * t->g[2][k * S + i];
        for (int i = 0; i < NX; i++) {
            V entry = q[i];
            for (int j = 0; j < NU; j++) entry += K[j * NZ + i] * q[NX + j];
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
        const V *K = s->G + k * NU * NZ, *P = t->P + (k + 1) * NX * NX;
        V *dx = t->dx + k * NX, *du = t->du + k * NU;
        for (int i = 0; i < NX; i++) z[i] = dx[i];
        for (int j = 0; j < NU; j++) {
            du[j] = K[j * NZ + NX];
            for (int i = 0; i < NX; i++) du[j] += K[j * NZ + i] * dx[i];
            z[NX + j] = du[j];
        }
        tgco_push(t->f + k * NJ, z, along_f);
        for (int i = 0; i < NX; i++) dx[NX + i] = along_f[i] + t->aim[k * NX + i];
        for (int i = 0; i < NX; i++) {
            V y = t->p[(k + 1) * NX + i];
            for (int j = 0; j < NX; j++) y += P[i * NX + j] * dx[NX + j];
            t->yn[(k + 1) * NX + i] = y;
        }
    }
}

/* The step of slacks and multipliers that belongs to dx, du. */
static void solve_rows(Barrier *t) {
    const Lanes *s = &t->lanes;
    const Problem *p = s->of;
    V z[S];
    for (int64_t k = 0; k <= p->N; k++) {
        const V *x = s->X + k * NX, *u = k < p->N ? s->U + k * NU : 0;
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
                    t->dz[q] = change / t->soft;
                } else {
                    t->ds[q] = by_role(t, q, -change, SET(0.0));
                    t->dz[q] = by_role(t, q, (t->mu + t->z[q] * change) / t->s[q] - t->z[q], change / t->soft);
                }
            }
        }
    }
}
