/* The rows of constraints in the interior point. */
#pragma once
#include "interior.h"
#include "solids.h"

/* Rows of constraint i at knot k begin here. */
static inline int64_t row_of(const Barrier *t, int64_t i, int64_t k) {
    const Constraint *con = t->lanes.of->constraint + i;
    return t->first[i] + con->place[k] * con->rows;
}

#if DIM > 0
/* Values c of obstacles at knot k. */
static inline void solids_at(const Constraint *con, const Rows *rows, int64_t k, IN x, OUT c) {
    V away[DIM];
    if (is_kind(con, SPHERES)) for (int j = 0; j < con->rows; j++) c[j] = sphere(con, rows, j, k, x, away);
    else if (is_kind(con, BOXES)) for (int j = 0; j < con->rows; j++) c[j] = solid(con, rows, j, k, x, NONE);
    else if (is_kind(con, FIELD)) c[0] = field_row(con, rows, k, x, NONE, NONE);
}

static void body_at(const Lanes *s, int64_t i, int64_t k, IN x, OUT c) {
    const Constraint *con = s->of->constraint + i;
    V centers[MAX_ROWS];
    Ball ball;
    ball_centers(s, i, k, x, centers);
    for (int b = 0; b < con->balls; b++) {
        ball_at(con, s->rows + i, b, k, centers + b * DIM, &ball);
        solids_at(&ball.con, &ball.rows, k, ball.x, c + b * ball.con.rows);
    }
}
#endif

/* Values c of constraint i at knot k. */
static inline void rows_at(const Lanes *s, int64_t i, int64_t k, IN x, IN u, OUT c) {
    const Constraint *con = s->of->constraint + i;
    const Rows *rows = s->rows + i;
    if (is_kind(con, BOUNDS)) {
        for (int j = 0; j < con->rows; j++) c[j] = bound(con, rows, j, k, x, u);
#if DIM > 0
    } else if (is_solid(con)) {
        solids_at(con, rows, k, x, c);
    } else if (is_kind(con, BODY)) {
        body_at(s, i, k, x, c);
#endif
    } else model_rows((int)i, x, u, at(rows->bound, &con->bound, con->place[k]), con->shared, c);
}

static inline I is_out(const Barrier *t, int64_t q) { return t->role[q] != SET(INSIDE); }
static inline I is_fixed(const Barrier *t, int64_t q) { return t->role[q] == SET(FIXED); }

/* `inside` of rows in the barrier, `fixed` of bounds that coincide, and nothing of rows that no variable moves. */
static inline V by_role(const Barrier *t, int64_t q, V inside, V fixed) {
    return t->some_out ? tgco_choose(is_out(t, q), tgco_if(is_fixed(t, q), fixed), inside) : inside;
}

/* The dual regularisation of a row that holds as an equality. */
static inline V softness(const Barrier *t, int64_t q) { return t->gives ? t->soft * t->gives[q] : t->soft; }

/* What row q adds: by[0] its multiplier, by[1] the condensed residual, by[2] mu's factor, and the curvature across. */
static inline V weigh(const Barrier *t, int equality, int64_t q, V *by) {
    by[0] = t->z[q];
    if (equality) {
        by[1] = t->objective * t->z[q] + t->r[q] / softness(t, q);
        by[2] = SET(0.0);
        return SET(1.0) / softness(t, q);
    }
    V sigma = t->z[q] / t->s[q], one = SET(1.0);
    by[1] = by_role(t, q, sigma * t->r[q], t->objective * t->z[q] + t->r[q] / softness(t, q));
    by[2] = by_role(t, q, one / t->s[q], SET(0.0));
    return by_role(t, q, sigma, one / softness(t, q));
}

#if DIM > 0
/* A row of the position alone, with its slopes and lam times its curvature (DIM, DIM), upper triangle. It and those that follow
   add to gradients of the parts, g (POSITION + DIM at least), and to an upper triangle H by rows of S. */
static inline void add_row(const Barrier *t, OUTS g, OUT H, int64_t q, IN slopes, IN curvature) {
    V by[PARTS], cc = weigh(t, 0, q, by);
    for (int a = 0; a < DIM; a++) {
        for (int part = 0; part < PARTS; part++) ADD(g[part][POSITION + a], by[part], slopes[a]);
        for (int b = a; b < DIM; b++)
            H[(POSITION + a) * S + POSITION + b] += cc * slopes[a] * slopes[b] + curvature[a * DIM + b];
    }
}

/* Those that follow add the rows of obstacles, which begin at row q, at knot k. */
static inline void add_spheres(
    const Barrier *t, OUTS g, OUT H, const Constraint *con, const Rows *rows, int64_t q, int64_t k, IN x) {
    for (int j = 0; j < con->rows; j++, q++) {
        V slopes[DIM], curvature[DIM * DIM], bend;
        sphere(con, rows, j, k, x, slopes);
        bend = tgco_if(square_at(con, rows, j, k) >= SET(0.0), SET(-2.0) * t->objective * t->z[q]);
        for (int a = 0; a < DIM; a++) {
            slopes[a] *= SET(-2.0);
            for (int b = 0; b < DIM; b++) curvature[a * DIM + b] = a == b ? bend : SET(0.0);
        }
        add_row(t, g, H, q, slopes, curvature);
    }
}
#endif

#if DIM > 0
/* lam times the second derivatives of row j (DIM, DIM): distances bend around edges and corners, not along faces. */
static inline void bend_box(
    const Constraint *con, const Rows *rows, int64_t j, int64_t k, IN x, V lam, OUT curvature) {
    IN factors = rows->bound + con->rows * 2 * DIM; IN box = factors + con->rows + j * BOX_NUMBERS;
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

static inline void add_boxes(
    const Barrier *t, OUTS g, OUT H, const Constraint *con, const Rows *rows, int64_t q, int64_t k, IN x) {
    V slopes[DIM], curvature[DIM * DIM];
    for (int j = 0; j < con->rows; j++, q++) {
        solid(con, rows, j, k, x, slopes);
        bend_box(con, rows, j, k, x, t->objective * t->z[q], curvature);
        add_row(t, g, H, q, slopes, curvature);
    }
}

static inline void add_field(
    const Barrier *t, OUTS g, OUT H, const Constraint *con, const Rows *rows, int64_t q, int64_t k, IN x) {
    V slopes[DIM], curvature[DIM * DIM], lam = t->objective * t->z[q];
    field_row(con, rows, k, x, slopes, curvature);
    for (int a = 0; a < DIM; a++) for (int b = a; b < DIM; b++) curvature[a * DIM + b] *= lam;
    add_row(t, g, H, q, slopes, curvature);
}

/* The same of any kind. */
static inline void add_solids(
    const Barrier *t, OUTS g, OUT H, const Constraint *con, const Rows *rows, int64_t q, int64_t k, IN x) {
    if (is_kind(con, SPHERES)) add_spheres(t, g, H, con, rows, q, k, x);
    else if (is_kind(con, BOXES)) add_boxes(t, g, H, con, rows, q, k, x);
    else if (is_kind(con, FIELD)) add_field(t, g, H, con, rows, q, k, x);
}

/* Rows of a body: each ball's by its center, then by the state, with the curvature of its way. */
static void add_body(Barrier *t, int64_t i, int64_t k, IN x, OUT H) {
    const Lanes *s = &t->lanes;
    const Constraint *con = s->of->constraint + i;
    IN numbers = at(s->rows[i].lift, &con->lift, con->place[k]);
    int64_t q = row_of(t, i, k), P = con->balls;
    V centers[MAX_ROWS], e[MAX_ROWS * S], own[PARTS * (POSITION + DIM)], square[(POSITION + DIM) * S];
    V by[PARTS * MAX_ROWS], cc[MAX_ROWS], lam[MAX_ROWS], *of_ball[PARTS];
    Numbers g[PARTS];
    const int *columns;
    Ball ball;
    ball_centers(s, i, k, x, centers);
    int count = model_slopes((int)i, x, NONE, numbers, con->shared, e, &columns);
    for (int part = 0; part < PARTS; part++) {
        of_ball[part] = own + part * (POSITION + DIM);
        g[part] = t->g[part] + k * S;
    }
    for (int b = 0; b < P; b++) {
        ball_at(con, s->rows + i, b, k, centers + b * DIM, &ball);
        for (int a = POSITION; a < POSITION + DIM; a++) {
            for (int part = 0; part < PARTS; part++) of_ball[part][a] = SET(0.0);
            for (int c = POSITION; c < POSITION + DIM; c++) square[a * S + c] = SET(0.0);
        }
        add_solids(t, of_ball, square, &ball.con, &ball.rows, q + b * ball.con.rows, k, ball.x);
        pull_square(count, columns, e + b * DIM * count, square + POSITION * S, H);
        for (int a = 0; a < DIM; a++) {
            for (int part = 0; part < PARTS; part++) by[part * MAX_ROWS + b * DIM + a] = of_ball[part][POSITION + a];
            cc[b * DIM + a] = SET(0.0);
            lam[b * DIM + a] = t->objective * of_ball[0][POSITION + a]; /* by[0] are multipliers: weigh */
        }
    }
    model_bend_rows((int)i, x, NONE, numbers, con->shared, by, cc, lam, g, H);
}
#endif

static inline void add_bounds(Barrier *t, int64_t i, int64_t k, OUT H) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    for (int j = 0; j < con->rows; j++, q++) {
        V by[PARTS], cc = weigh(t, 0, q, by), sign = SET(con->sign[j]);
        int v = con->variable[j];
        for (int part = 0; part < PARTS; part++) ADD(t->g[part][k * S + v], sign, by[part]);
        H[v * S + v] += cc;
    }
}

/* Adds constraint i at knot k to the model of a step, of which H is the knot's upper triangle. */
static inline void add_rows(Barrier *t, int64_t i, int64_t k, IN x, IN u, OUT H) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    if (is_kind(con, BOUNDS)) { add_bounds(t, i, k, H); return; }
#if DIM > 0
    if (is_kind(con, BODY)) { add_body(t, i, k, x, H); return; }
    if (is_solid(con)) {
        Numbers g[PARTS];
        for (int part = 0; part < PARTS; part++) g[part] = t->g[part] + k * S;
        add_solids(t, g, H, con, rows, row_of(t, i, k), k, x);
        return;
    }
#endif
    if (!is_kind(con, FUNCTION)) return;
    V by[PARTS * MAX_ROWS], cc[MAX_ROWS], lam[MAX_ROWS], own[PARTS];
    int64_t q = row_of(t, i, k);
    for (int j = 0; j < con->rows; j++) {
        cc[j] = weigh(t, con->equality, q + j, own);
        for (int part = 0; part < PARTS; part++) by[part * MAX_ROWS + j] = own[part];
        lam[j] = t->objective * t->z[q + j];
    }
    Numbers g[PARTS];
    for (int part = 0; part < PARTS; part++) g[part] = t->g[part] + k * S;
    IN numbers = at(rows->bound, &con->bound, con->place[k]);
    model_bend_rows((int)i, x, u, numbers, con->shared, by, cc, lam, g, H);
}

#if DIM > 0
/* The change of rows of obstacles at knot k where the position changes by `step` (DIM), into out. */
static inline void solids_along(
    const Constraint *con, const Rows *rows, int64_t k, IN x, IN step, OUT out) {
    V slopes[DIM];
    for (int j = 0; j < con->rows; j++) {
        out[j] = SET(0.0);
        if (is_kind(con, SPHERES)) {
            sphere(con, rows, j, k, x, slopes);
            for (int a = 0; a < DIM; a++) SUBTRACT(out[j], SET(2.0) * slopes[a], step[a]);
            continue;
        }
        if (is_kind(con, BOXES)) solid(con, rows, j, k, x, slopes);
        else if (is_kind(con, FIELD)) field_row(con, rows, k, x, slopes, NONE);
        for (int a = 0; a < DIM; a++) ADD(out[j], slopes[a], step[a]);
    }
}

static void body_along(const Lanes *s, int64_t i, int64_t k, IN x, IN u, IN z, OUT out) {
    const Constraint *con = s->of->constraint + i;
    V centers[MAX_ROWS], steps[MAX_ROWS];
    Ball ball;
    ball_centers(s, i, k, x, centers);
    model_along_rows((int)i, x, u, at(s->rows[i].lift, &con->lift, con->place[k]), con->shared, z, steps);
    for (int b = 0; b < con->balls; b++) {
        ball_at(con, s->rows + i, b, k, centers + b * DIM, &ball);
        solids_along(&ball.con, &ball.rows, k, ball.x, steps + b * DIM, out + b * ball.con.rows);
    }
}
#endif

/* The change of the rows of constraint i at knot k along z = [dx, du], into out. */
static inline void along(const Barrier *t, int64_t i, int64_t k, IN x, IN u, IN z, OUT out) {
    const Constraint *con = t->lanes.of->constraint + i;
    const Rows *rows = t->lanes.rows + i;
    if (is_kind(con, BOUNDS)) {
        for (int j = 0; j < con->rows; j++) out[j] = SET(con->sign[j]) * z[con->variable[j]];
#if DIM > 0
    } else if (is_solid(con)) {
        solids_along(con, rows, k, x, z + POSITION, out);
    } else if (is_kind(con, BODY)) {
        body_along(&t->lanes, i, k, x, u, z, out);
#endif
    } else model_along_rows((int)i, x, u, at(rows->bound, &con->bound, con->place[k]), con->shared, z, out);
}
