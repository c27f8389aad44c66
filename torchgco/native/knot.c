/* What one knot says of the iterate: cost, constraints, guide and the model's step. */

/* What a row adds to L_M. */
static inline V worth(const Problem *p, int equality, V c, V lam, V mu) {
    V half = SET(0.5);
    if (equality) return (lam + half * mu * c) * c;
    if (p->clip) {
        I idle = lam + mu * c < SET(0.0);
        return tgco_choose(idle, -half * lam * lam / mu, (lam + half * mu * c) * c);
    }
    I idle = (c < SET(0.0)) & (lam == SET(0.0));
    return (lam + half * tgco_if(~idle, mu) * c) * c;
}

/* First and second derivative of that by c; of lam c, with the penalty's curvature, where optimality is asked for. */
static inline V pull(const Problem *p, int equality, V c, V lam, V mu, V *rho) {
    if (p->optimality) { *rho = tgco_if(lam != SET(0.0), mu); return lam; }
    if (equality) { *rho = mu; return lam + mu * c; }
    I idle = p->clip ? lam + mu * c < SET(0.0) : (c < SET(0.0)) & (lam == SET(0.0));
    *rho = tgco_if(~idle, mu);
    V g = lam + *rho * c;
    return p->clip ? tgco_if(~idle, g) : g;
}

static inline void sphere(const Lanes *s, int64_t i, int64_t j, const V *x, int64_t k, V *away, V *c) {
    const Constraint *con = s->of->constraint + i;
    const V *o = s->bound[i] + j * DIM;
    V square = SET(0.0);
    I here = s->squares[i][j] >= SET(0.0); /* an absent one is c = -1 everywhere */
    for (int a = 0; a < DIM; a++) {
        away[a] = x[POSITION + a] - o[a];
        if (con->velocities.data) away[a] -= SET(k * con->dt) * s->velocities[i][j * DIM + a];
        away[a] = tgco_if(here, away[a]);
        square += away[a] * away[a];
    }
    *c = s->squares[i][j] - square;
}

/* Cost of stage k, or of the last knot. */
static inline V cost_value(const Lanes *s, int64_t k, const V *x, const V *u) {
    const Problem *p = s->of;
    V total = SET(0.0), half = SET(0.5), ex[NX], eu[NU];
    int last = k == p->N;
    const V *ref = last ? s->xf_ref : at(s->x_ref, &p->x_ref, k), *Q = last ? s->Qf : at(s->Q, &p->Q, k);
    for (int i = 0; i < NX; i++) ex[i] = x[i] - ref[i];
#if QUADRATIC_FULL
    for (int i = 0; i < NX; i++) {
        V row = SET(0.0);
        for (int j = 0; j < NX; j++) row += Q[i * NX + j] * ex[j];
        total += half * ex[i] * row;
    }
#else
    for (int i = 0; i < NX; i++) total += half * Q[i] * ex[i] * ex[i];
#endif
    const V *q = last ? (p->qf.data ? s->qf : 0) : (p->q.data ? at(s->q, &p->q, k) : 0);
    if (q) for (int i = 0; i < NX; i++) total += q[i] * ex[i];
    if (!last) {
        const V *u_ref = at(s->u_ref, &p->u_ref, k), *R = at(s->R, &p->R, k);
        for (int i = 0; i < NU; i++) eu[i] = u[i] - u_ref[i];
#if QUADRATIC_FULL
        for (int i = 0; i < NU; i++) {
            V row = SET(0.0);
            for (int j = 0; j < NU; j++) row += R[i * NU + j] * eu[j];
            total += half * eu[i] * row;
        }
#else
        for (int i = 0; i < NU; i++) total += half * R[i] * eu[i] * eu[i];
#endif
        if (p->r.data) for (int i = 0; i < NU; i++) total += at(s->r, &p->r, k)[i] * eu[i];
        if (p->cross.data) {
            const V *H = at(s->cross, &p->cross, k);
            for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) total += eu[i] * H[i * NX + j] * ex[j];
        }
    }
    return total;
}

/* Cost of knot k; guides and constraints go into `added`. */
static inline V knot_value(const Lanes *s, int64_t k, const V *x, const V *u, V *added) {
    const Problem *p = s->of;
    V total = cost_value(s, k, x, u), more = SET(0.0), half = SET(0.5);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (con->place[k] < 0) continue;
        const V *lam = s->lam[i] + con->place[k] * con->rows;
        if (con->kind == BOX) {
            for (int j = 0; j < con->rows; j++) {
                V z = con->variable[j] < NX ? x[con->variable[j]] : u[con->variable[j] - NX];
                V c = SET(con->sign[j]) * (z - s->bound[i][j]);
                more += worth(p, 0, c, lam[j], s->mu);
            }
#if DIM > 0
        } else if (con->kind == SPHERES) {
            for (int j = 0; j < con->rows; j++) {
                V away[DIM], c;
                sphere(s, i, j, x, k, away, &c);
                if (any((c > SET(0.0)) | (lam[j] != SET(0.0)) | (c != c))) more += worth(p, 0, c, lam[j], s->mu);
            }
#endif
        } else {
            V c[MAX_ROWS];
            tgco_rows((int)i, x, u, c);
            for (int j = 0; j < con->rows; j++) more += worth(p, con->equality, c[j], lam[j], s->mu);
        }
    }
#if DIM > 0
    if (p->guide != NO_GUIDE) {
        const V *center = s->center + k * DIM;
        V square = SET(0.0);
        for (int a = 0; a < DIM; a++) { V e = x[POSITION + a] - center[a]; square += e * e; }
        if (p->guide == PATH) more += half * s->weight * square;
        else {
            V f = square - s->radius[k] * s->radius[k];
            more += tgco_if(f > SET(0.0), half * s->weight * f * f);
        }
    }
#endif
    *added = more;
    return total;
}

/* Adds gradient g (S) and upper triangle H (S, S) of all terms of knot k. */
static inline void knot_expand(const Lanes *s, int64_t k, const V *x, const V *u, V *g, V *H) {
    const Problem *p = s->of;
    V ex[NX], eu[NU];
    int last = k == p->N;
    const V *ref = last ? s->xf_ref : at(s->x_ref, &p->x_ref, k), *Q = last ? s->Qf : at(s->Q, &p->Q, k);
    for (int i = 0; i < NX; i++) ex[i] = x[i] - ref[i];
#if QUADRATIC_FULL
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) {
        g[i] += Q[i * NX + j] * ex[j];
        if (j >= i) H[i * S + j] += Q[i * NX + j];
    }
#else
    for (int i = 0; i < NX; i++) { g[i] += Q[i] * ex[i]; H[i * S + i] += Q[i]; }
#endif
    const V *q = last ? (p->qf.data ? s->qf : 0) : (p->q.data ? at(s->q, &p->q, k) : 0);
    if (q) for (int i = 0; i < NX; i++) g[i] += q[i];
    if (!last) {
        const V *u_ref = at(s->u_ref, &p->u_ref, k), *R = at(s->R, &p->R, k);
        for (int i = 0; i < NU; i++) eu[i] = u[i] - u_ref[i];
#if QUADRATIC_FULL
        for (int i = 0; i < NU; i++) for (int j = 0; j < NU; j++) {
            g[NX + i] += R[i * NU + j] * eu[j];
            if (j >= i) H[(NX + i) * S + NX + j] += R[i * NU + j];
        }
#else
        for (int i = 0; i < NU; i++) { g[NX + i] += R[i] * eu[i]; H[(NX + i) * S + NX + i] += R[i]; }
#endif
        if (p->r.data) for (int i = 0; i < NU; i++) g[NX + i] += at(s->r, &p->r, k)[i];
        if (p->cross.data) {
            const V *C = at(s->cross, &p->cross, k);
            for (int i = 0; i < NU; i++) for (int j = 0; j < NX; j++) {
                g[NX + i] += C[i * NX + j] * ex[j];
                g[j] += C[i * NX + j] * eu[i];
                H[j * S + NX + i] += C[i * NX + j];
            }
        }
    }
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (con->place[k] < 0) continue;
        const V *lam = s->lam[i] + con->place[k] * con->rows;
        if (con->kind == BOX) {
            for (int j = 0; j < con->rows; j++) {
                int v = con->variable[j];
                V sign = SET(con->sign[j]), rho;
                V c = sign * ((v < NX ? x[v] : u[v - NX]) - s->bound[i][j]), gradient = pull(p, 0, c, lam[j], s->mu, &rho);
                g[v] += sign * gradient;
                H[v * S + v] += rho;
            }
#if DIM > 0
        } else if (con->kind == SPHERES) {
            for (int j = 0; j < con->rows; j++) {
                V away[DIM], c, rho;
                sphere(s, i, j, x, k, away, &c);
                if (!any((c > SET(0.0)) | (lam[j] != SET(0.0)) | (c != c))) continue;
                V gradient = pull(p, 0, c, lam[j], s->mu, &rho);
                for (int a = 0; a < DIM; a++) {
                    g[POSITION + a] -= SET(2.0) * gradient * away[a];
                    for (int b = a; b < DIM; b++)
                        H[(POSITION + a) * S + POSITION + b] += SET(4.0) * rho * away[a] * away[b];
                }
            }
#endif
        } else {
            V c[MAX_ROWS], gradient[MAX_ROWS], rho[MAX_ROWS];
            tgco_rows((int)i, x, u, c);
            for (int j = 0; j < con->rows; j++) gradient[j] = pull(p, con->equality, c[j], lam[j], s->mu, rho + j);
            tgco_add_rows((int)i, x, u, gradient, rho, g, H);
        }
    }
#if DIM > 0
    if (p->guide != NO_GUIDE) {
        const V *center = s->center + k * DIM;
        V e[DIM], square = SET(0.0);
        for (int a = 0; a < DIM; a++) { e[a] = x[POSITION + a] - center[a]; square += e[a] * e[a]; }
        if (p->guide == PATH) {
            for (int a = 0; a < DIM; a++) {
                g[POSITION + a] += s->weight * e[a];
                H[(POSITION + a) * S + POSITION + a] += s->weight;
            }
        } else {
            V f = square - s->radius[k] * s->radius[k];
            V rho = tgco_if(f > SET(0.0), s->weight), pulls = tgco_if(f > SET(0.0), s->weight * f * SET(2.0));
            for (int a = 0; a < DIM; a++) {
                g[POSITION + a] += pulls * e[a];
                for (int b = a; b < DIM; b++)
                    H[(POSITION + a) * S + POSITION + b] += SET(4.0) * rho * e[a] * e[b];
            }
        }
    }
#endif
}

__attribute__((noinline)) static void model_step(const V *x, const V *u, const V *parameters, V *next) {
    tgco_step(x, u, parameters, next);
}
