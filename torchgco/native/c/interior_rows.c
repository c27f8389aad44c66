/* The rows of constraints in the interior point. */

/* Rows of constraint i at knot k begin here. */
static inline int64_t row_of(const Barrier *t, int64_t i, int64_t k) {
    const Constraint *con = t->lanes.of->constraint + i;
    return t->first[i] + con->place[k] * con->rows;
}

/* Values c of constraint i at knot k. */
static inline void rows_at(const Lanes *s, int64_t i, int64_t k, const V *x, const V *u, V *c) {
    const Constraint *con = s->of->constraint + i;
    const Rows *rows = s->rows + i;
    if (con->kind == BOUNDS) {
        for (int j = 0; j < con->rows; j++) c[j] = bound(con, rows, j, k, x, u);
#if DIM > 0
    } else if (con->kind == SPHERES) {
        V away[DIM];
        for (int j = 0; j < con->rows; j++) c[j] = sphere(con, rows, j, k, x, away);
    } else if (con->kind == BOXES) {
        for (int j = 0; j < con->rows; j++) c[j] = solid(con, rows, j, k, x, 0);
    } else if (con->kind == FIELD) {
        c[0] = field_row(con, rows, k, x, 0, 0);
#endif
    } else model_rows((int)i, x, u, at(rows->bound, &con->bound, con->place[k]), con->shared, c);
}

/* `inside` of rows in the barrier, `fixed` of bounds that coincide, and nothing of rows that no variable moves. */
static inline V by_role(const Barrier *t, int64_t q, V inside, V fixed) {
    return t->some_out ? tgco_choose(t->out[q], tgco_if(t->fixes[q], fixed), inside) : inside;
}

/* What row q adds: by[0] its multiplier, by[1] the condensed residual, by[2] mu's factor, and the curvature across. */
static inline V weigh(const Barrier *t, int equality, int64_t q, V *by) {
    by[0] = t->z[q];
    if (equality) {
        by[1] = t->objective * t->z[q] + t->r[q] / t->soft;
        by[2] = SET(0.0);
        return SET(1.0) / t->soft;
    }
    V sigma = t->z[q] / t->s[q], one = SET(1.0);
    by[1] = by_role(t, q, sigma * t->r[q], t->objective * t->z[q] + t->r[q] / t->soft);
    by[2] = by_role(t, q, one / t->s[q], SET(0.0));
    return by_role(t, q, sigma, one / t->soft);
}

#if DIM > 0
/* A row of the position alone, with its slopes and lam times its curvature (DIM, DIM), upper triangle. */
static inline void add_row(Barrier *t, int64_t k, int64_t q, const V *slopes, const V *curvature) {
    V by[PARTS], cc = weigh(t, 0, q, by), *H = t->H + k * S * S;
    for (int a = 0; a < DIM; a++) {
        for (int part = 0; part < PARTS; part++) ADD(t->g[part][k * S + POSITION + a], by[part], slopes[a]);
        for (int b = a; b < DIM; b++)
            H[(POSITION + a) * S + POSITION + b] += cc * slopes[a] * slopes[b] + curvature[a * DIM + b];
    }
}

static inline void add_spheres(Barrier *t, int64_t i, int64_t k, const V *x) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    int64_t q = row_of(t, i, k);
    for (int j = 0; j < con->rows; j++, q++) {
        V slopes[DIM], curvature[DIM * DIM], bend;
        sphere(con, rows, j, k, x, slopes);
        bend = tgco_if(square_at(con, rows, j, k) >= SET(0.0), SET(-2.0) * t->objective * t->z[q]);
        for (int a = 0; a < DIM; a++) {
            slopes[a] *= SET(-2.0);
            for (int b = 0; b < DIM; b++) curvature[a * DIM + b] = a == b ? bend : SET(0.0);
        }
        add_row(t, k, q, slopes, curvature);
    }
}
#endif

#if DIM > 0
/* lam times the second derivatives of row j (DIM, DIM): distances bend around edges and corners, not along faces. */
static inline void bend_box(
    const Constraint *con, const Rows *rows, int64_t j, int64_t k, const V *x, V lam, V *curvature) {
    const V *factors = rows->bound + con->rows * 2 * DIM, *box = factors + con->rows + j * BOX_NUMBERS;
    V zero = SET(0.0), local[DIM], away[DIM], square = zero;
    seen_from(box, x + POSITION, local);
    for (int i = 0; i < DIM; i++) { away[i] = beyond(local[i], BOX_HALF(box)[i]); ADD(square, away[i], away[i]); }
    I bends = (square > zero) & is_here(con, rows, BOX_RADIUS(box), k);
    V inverse = tgco_if(bends, SET(1.0) / tgco_choose(bends, square, SET(1.0)));
    V weight = -lam * factors[j] * tgco_sqrt(inverse);
    for (int a = 0; a < DIM; a++) for (int b = 0; b < DIM; b++) {
        V sum = zero;
        for (int i = 0; i < DIM; i++) for (int l = 0; l < DIM; l++) {
            V entry = -away[i] * away[l] * inverse;
            if (i == l) entry += tgco_truth(away[i] != zero);
            ADD(sum, box[DIM + i * DIM + a] * entry, box[DIM + l * DIM + b]);
        }
        curvature[a * DIM + b] = weight * sum;
    }
}

static inline void add_boxes(Barrier *t, int64_t i, int64_t k, const V *x) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    int64_t q = row_of(t, i, k);
    V slopes[DIM], curvature[DIM * DIM];
    for (int j = 0; j < con->rows; j++, q++) {
        solid(con, rows, j, k, x, slopes);
        bend_box(con, rows, j, k, x, t->objective * t->z[q], curvature);
        add_row(t, k, q, slopes, curvature);
    }
}
#endif

#if DIM > 0
static inline void add_field(Barrier *t, int64_t i, int64_t k, const V *x) {
    int64_t q = row_of(t, i, k);
    V slopes[DIM], curvature[DIM * DIM], lam = t->objective * t->z[q];
    field_row(t->lanes.of->constraint + i, t->lanes.rows + i, k, x, slopes, curvature);
    for (int a = 0; a < DIM; a++) for (int b = a; b < DIM; b++) curvature[a * DIM + b] *= lam;
    add_row(t, k, q, slopes, curvature);
}
#endif

static inline void add_bounds(Barrier *t, int64_t i, int64_t k) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    for (int j = 0; j < con->rows; j++, q++) {
        V by[PARTS], cc = weigh(t, 0, q, by), sign = SET(con->sign[j]);
        int v = con->variable[j];
        for (int part = 0; part < PARTS; part++) ADD(t->g[part][k * S + v], sign, by[part]);
        t->H[k * S * S + v * S + v] += cc;
    }
}

/* Adds constraint i at knot k to the model of a step. */
static inline void add_rows(Barrier *t, int64_t i, int64_t k, const V *x, const V *u) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    if (con->kind == BOUNDS) { add_bounds(t, i, k); return; }
#if DIM > 0
    if (con->kind == SPHERES) { add_spheres(t, i, k, x); return; }
    if (con->kind == BOXES) { add_boxes(t, i, k, x); return; }
    if (con->kind == FIELD) { add_field(t, i, k, x); return; }
#endif
    V by[PARTS * MAX_ROWS], cc[MAX_ROWS], lam[MAX_ROWS], own[PARTS];
    int64_t q = row_of(t, i, k);
    for (int j = 0; j < con->rows; j++) {
        cc[j] = weigh(t, con->equality, q + j, own);
        for (int part = 0; part < PARTS; part++) by[part * MAX_ROWS + j] = own[part];
        lam[j] = t->objective * t->z[q + j];
    }
    V *g[PARTS];
    for (int part = 0; part < PARTS; part++) g[part] = t->g[part] + k * S;
    const V *numbers = at(rows->bound, &con->bound, con->place[k]);
    model_bend_rows((int)i, x, u, numbers, con->shared, by, cc, lam, g, t->H + k * S * S);
}

/* The change of the rows of constraint i at knot k along z = [dx, du], into out. */
static inline void along(const Barrier *t, int64_t i, int64_t k, const V *x, const V *u, const V *z, V *out) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    if (con->kind == BOUNDS) {
        for (int j = 0; j < con->rows; j++) out[j] = SET(con->sign[j]) * z[con->variable[j]];
#if DIM > 0
    } else if (con->kind == SPHERES) {
        for (int j = 0; j < con->rows; j++) {
            V away[DIM];
            sphere(con, rows, j, k, x, away);
            out[j] = SET(0.0);
            for (int a = 0; a < DIM; a++) SUBTRACT(out[j], SET(2.0) * away[a], z[POSITION + a]);
        }
    } else if (con->kind == BOXES) {
        for (int j = 0; j < con->rows; j++) {
            V slopes[DIM];
            solid(con, rows, j, k, x, slopes);
            out[j] = SET(0.0);
            for (int a = 0; a < DIM; a++) ADD(out[j], slopes[a], z[POSITION + a]);
        }
    } else if (con->kind == FIELD) {
        V slopes[DIM];
        field_row(con, rows, k, x, slopes, 0);
        out[0] = SET(0.0);
        for (int a = 0; a < DIM; a++) ADD(out[0], slopes[a], z[POSITION + a]);
#endif
    } else model_along_rows((int)i, x, u, at(rows->bound, &con->bound, con->place[k]), con->shared, z, out);
}
