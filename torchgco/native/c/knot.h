/* The terms of one knot of the iterate beside its cost: constraints and guide. */
#pragma once
#include "penalty.h"
#include "solids.h"

#define SAFE 1.000001 /* more than rounding: of the distance up to which a ball may touch a sphere */

/* Functions NAME_terms add the terms of rows to `total`, or, where g isn't NULL, their gradient to g (S) and the upper
   triangle of their Hessian to H (S, S). */

#if DIM > 0
/* The same of row j, whose value is c. */
static inline V sphere_terms(
    const Lanes *s, const Constraint *con, const Rows *rows, int64_t j, int64_t k, IN x, V c, V lam, V total,
    OUT g, OUT H) {
    if (!g) return total + worth(s, 0, c, lam);
    if (!any(NOT(c <= SET(0.0)) | (lam != SET(0.0)))) return total;
    V away[DIM], rho, slope = pull(s, 0, sphere(con, rows, j, k, x, away), lam, &rho);
    for (int a = 0; a < DIM; a++) {
        SUBTRACT(g[POSITION + a], SET(2.0) * slope, away[a]);
        for (int b = a; b < DIM; b++) ADD(H[(POSITION + a) * S + POSITION + b], SET(4.0) * rho * away[a], away[b]);
    }
    return total;
}

TGCO_INLINE V spheres_terms(
    const Lanes *s, const Constraint *con, const Rows *rows, int64_t k, IN x, V total, OUT g, OUT H) {
    IN lam = rows->lam + con->place[k] * con->rows;
    V c[BLOCK];
    for (int64_t first = 0; first < con->rows; first += BLOCK) {
        int64_t last = first + BLOCK < con->rows ? first + BLOCK : con->rows;
        if (!spheres(con, rows, first, last, k, x, c)) continue;
        for (int64_t j = first; j < last; j++)
            total = sphere_terms(s, con, rows, j, k, x, c[j - first], lam[j], total, g, H);
    }
    return total;
}

/* Of the spheres of a body, in order, those that a ball may touch in any lane at knot k, or that have a multiplier. */
static inline int64_t spheres_near(const Lanes *s, int64_t i, int64_t k, IN centers, Places near) {
    const Constraint *con = s->of->constraint + i;
    const Rows *rows = s->rows + i;
    IN lam = rows->lam + con->place[k] * con->rows; IN o = at(rows->bound, &con->bound, con->place[k]);
    int64_t P = con->balls, each = con->rows / P, count = 0;
    int pushed = any(rows->pushed[con->place[k]]);
    V middle[DIM], reach = SET(0.0);
    for (int a = 0; a < DIM; a++) {
        middle[a] = SET(0.0);
        for (int b = 0; b < P; b++) middle[a] += SET(1.0 / P) * centers[b * DIM + a];
    }
    for (int b = 0; b < P; b++) {
        V square = SET(0.0);
        for (int a = 0; a < DIM; a++) {
            V away = centers[b * DIM + a] - middle[a];
            ADD(square, away, away);
        }
        reach = tgco_maximum(reach, square);
    }
    reach = tgco_sqrt(reach);
    for (int64_t j = 0; j < each; j++) {
        V square = SET(0.0), limit = SET(SAFE) * (rows->widest[j] + reach);
        for (int a = 0; a < DIM; a++) {
            V away = middle[a] - o[j * DIM + a];
            if (con->velocities.data) SUBTRACT(away, SET(k * con->dt), rows->velocities[j * DIM + a]);
            ADD(square, away, away);
        }
        int adds = any((rows->widest[j] >= SET(0.0)) & NOT(square >= limit * limit)); /* NaN may touch */
        for (int64_t b = 0; pushed && !adds && b < P; b++) adds = any(lam[b * each + j] != SET(0.0));
        if (adds) near[count++] = j;
    }
    return count;
}

TGCO_INLINE V near_terms(
    const Lanes *s, const Ball *ball, int64_t k, Places near, int64_t count, V total, OUT g, OUT H) {
    IN lam = ball->rows.lam + ball->con.place[k] * ball->con.rows;
    V away[DIM];
    for (int64_t i = 0; i < count; i++) {
        V c = sphere(&ball->con, &ball->rows, near[i], k, ball->x, away);
        total = sphere_terms(s, &ball->con, &ball->rows, near[i], k, ball->x, c, lam[near[i]], total, g, H);
    }
    return total;
}

/* Rows of a body, ball by ball. */
TGCO_APART V body_terms(const Lanes *s, int64_t i, int64_t k, IN x, V total, OUT g, OUT H) {
    const Constraint *con = s->of->constraint + i;
    V centers[MAX_ROWS], e[MAX_ROWS * S], by[POSITION + DIM], square[(POSITION + DIM) * S], *own = g ? by : NULL;
    const int *columns = 0;
    Places near = s->rows[i].near;
    int64_t some = 0;
    int count = -1;
    Ball ball;
    ball_centers(s, i, k, x, centers);
    if (con->kind_of_balls == SPHERES && !(some = spheres_near(s, i, k, centers, near))) return total;
    for (int b = 0; b < con->balls; b++) {
        ball_at(con, s->rows + i, b, k, centers + b * DIM, &ball);
        for (int a = POSITION; g && a < POSITION + DIM; a++) {
            own[a] = SET(0.0);
            for (int c = POSITION; c < POSITION + DIM; c++) square[a * S + c] = SET(0.0);
        }
        if (is_kind(&ball.con, SPHERES)) total = near_terms(s, &ball, k, near, some, total, own, square);
        else if (is_kind(&ball.con, BOXES)) total = boxes_terms(s, &ball.con, &ball.rows, k, ball.x, total, own, square);
        else total = field_terms(s, &ball.con, &ball.rows, k, ball.x, total, own, square);
        if (!g || adds_nothing(own + POSITION, square + POSITION * S)) continue;
        if (count < 0)
            count = model_slopes(
                (int)i, x, NONE, at(s->rows[i].lift, &con->lift, con->place[k]), con->shared, e, &columns);
        pull_slope(count, columns, e + b * DIM * count, own + POSITION, g);
        pull_square(count, columns, e + b * DIM * count, square + POSITION * S, H);
    }
    return total;
}
#endif

/* Rows that are traced, in a function of their own: room for any number of them would cost the others time. */
TGCO_APART V traced_terms(
    const Lanes *s, int64_t i, int64_t k, IN x, IN u, IN lam, V total, OUT g, OUT H) {
    const Constraint *con = s->of->constraint + i;
    IN numbers = at(s->rows[i].bound, &con->bound, con->place[k]);
    V c[MAX_ROWS], slope[MAX_ROWS], rho[MAX_ROWS];
    model_rows((int)i, x, u, numbers, con->shared, c);
    for (int j = 0; j < con->rows; j++) {
        if (g) slope[j] = pull(s, con->equality, c[j], lam[j], rho + j);
        else total += worth(s, con->equality, c[j], lam[j]);
    }
    if (g) model_add_rows((int)i, x, u, numbers, con->shared, slope, rho, g, H);
    return total;
}

TGCO_INLINE V rows_terms(const Lanes *s, int64_t i, int64_t k, IN x, IN u, V total, OUT g, OUT H) {
    const Constraint *con = s->of->constraint + i;
    const Rows *rows = s->rows + i;
    IN lam = rows->lam + con->place[k] * con->rows;
    if (is_kind(con, BOUNDS)) {
        for (int j = 0; j < con->rows; j++) {
            int v = con->variable[j];
            V c = bound(con, rows, j, k, x, u), rho;
            if (!g) { total += worth(s, 0, c, lam[j]); continue; }
            ADD(g[v], SET(con->sign[j]), pull(s, 0, c, lam[j], &rho));
            H[v * S + v] += rho;
        }
        return total;
    }
#if DIM > 0
    if (is_kind(con, SPHERES)) return spheres_terms(s, con, rows, k, x, total, g, H);
    if (is_kind(con, BOXES)) return boxes_terms(s, con, rows, k, x, total, g, H);
    if (is_kind(con, FIELD)) return field_terms(s, con, rows, k, x, total, g, H);
    if (is_kind(con, BODY)) return body_terms(s, i, k, x, total, g, H);
#endif
    return traced_terms(s, i, k, x, u, lam, total, g, H);
}

#if DIM > 0
/* The vector from the guide's centre at knot k, and its squared length. */
static inline V from_guide(const Lanes *s, int64_t k, IN x, OUT away) {
    V square = SET(0.0);
    for (int a = 0; a < DIM; a++) {
        away[a] = x[POSITION + a] - s->center[k * DIM + a];
        ADD(square, away[a], away[a]);
    }
    return square;
}

static inline V guide_value(const Lanes *s, int64_t k, IN x) {
    V away[DIM], half = SET(0.5), square = from_guide(s, k, x, away);
    if (s->of->guide == PATH) return half * s->weight * square;
    V f = square - s->radius[k] * s->radius[k];
    return tgco_if(f > SET(0.0), half * s->weight * f * f);
}

static inline void guide_expand(const Lanes *s, int64_t k, IN x, OUT g, OUT H) {
    V away[DIM], square = from_guide(s, k, x, away);
    if (s->of->guide == PATH) {
        for (int a = 0; a < DIM; a++) {
            ADD(g[POSITION + a], s->weight, away[a]);
            H[(POSITION + a) * S + POSITION + a] += s->weight;
        }
        return;
    }
    V f = square - s->radius[k] * s->radius[k];
    V rho = tgco_if(f > SET(0.0), s->weight), slope = tgco_if(f > SET(0.0), s->weight * f * SET(2.0));
    for (int a = 0; a < DIM; a++) {
        ADD(g[POSITION + a], slope, away[a]);
        for (int b = a; b < DIM; b++) ADD(H[(POSITION + a) * S + POSITION + b], SET(4.0) * rho * away[a], away[b]);
    }
}
#endif

/* What constraints and guide add at knot k. u is NULL at the last knot. */
TGCO_LARGE V knot_value(const Lanes *s, int64_t k, IN x, IN u) {
    const Problem *p = s->of;
    V more = SET(0.0);
    for (int64_t i = 0; i < p->constraints; i++)
        if (p->constraint[i].place[k] != NOWHERE) more = rows_terms(s, i, k, x, u, more, NONE, NONE);
#if DIM > 0
    if (p->guide != NO_GUIDE) more += guide_value(s, k, x);
#endif
    return more;
}

/* L_M along X, U, and the cost in it. */
TGCO_LARGE V merit_of(const Lanes *s, V *cost) {
    int64_t N = s->of->N;
    V more = SET(0.0);
    *cost = SET(0.0);
    for (int64_t k = 0; k <= N; k++) {
        IN x = s->X + k * NX; IN u = k < N ? s->U + k * NU : 0;
        *cost += cost_value(s, k, x, u);
        more += knot_value(s, k, x, u);
    }
    return *cost + more;
}

/* Adds gradient g (S) and upper triangle H (S, S) of these terms. */
TGCO_LARGE void knot_expand(const Lanes *s, int64_t k, IN x, IN u, OUT g, OUT H) {
    const Problem *p = s->of;
    for (int64_t i = 0; i < p->constraints; i++)
        if (p->constraint[i].place[k] != NOWHERE) rows_terms(s, i, k, x, u, SET(0.0), g, H);
#if DIM > 0
    if (p->guide != NO_GUIDE) guide_expand(s, k, x, g, H);
#endif
}
