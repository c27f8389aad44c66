/* Sweeps over the rows of an iterate: violation, contacts, slack, and new multipliers. */
#pragma once
#include "memory.h"
#include "solids.h"

/* What a sweep over an iterate finds. */
typedef struct {
    V violation, touched; /* touched: rows in contact at a knot */
    V slack;              /* sum of |lam c| over inequalities with c < 0 */
    int update;           /* whether multipliers change */
} Sweep;

/* One row: its value c, by how much it is violated, and its multiplier. */
static inline void note(const Lanes *s, const Constraint *con, V c, V violated, OUT lam, I *pushed, Sweep *sweep) {
    V zero = SET(0.0), worst = sweep->violation;
    sweep->violation = tgco_choose((violated > worst) | (violated != violated), violated, worst); /* NaN stays */
    sweep->touched += tgco_truth(c > zero);
    if (!con->equality) SUBTRACT(sweep->slack, *lam, tgco_choose(c > zero, zero, c));
    if (!sweep->update) return;
    V next = *lam + s->mu * c;
    *lam = con->equality ? next : tgco_choose(next < zero, zero, next);
    *pushed |= *lam != zero;
}

/* By how much |v| is beyond r, where c = s (|v|^2 - r^2) / (2 r) is at least 0; `radius` is s r. */
static inline V past_radius(V c, V radius) {
    V square = SET(1.0) + (c + c) / radius; /* (|v| / r)^2 */
    return (c + c) / (SET(1.0) + tgco_sqrt(tgco_choose(square < SET(0.0), SET(0.0), square)));
}

#if DIM > 0
/* Rows of obstacles at one knot. */
static inline void note_solids(
    Lanes *s, const Constraint *con, const Rows *rows, int64_t k, IN x, I *pushed, Sweep *sweep) {
    int64_t place = con->place[k];
    OUT lam = rows->lam + place * con->rows; V zero = SET(0.0);
    if (is_kind(con, SPHERES)) {
        V c[BLOCK];
        for (int64_t first = 0; first < con->rows; first += BLOCK) {
            int64_t last = first + BLOCK < con->rows ? first + BLOCK : con->rows;
            if (!spheres(con, rows, first, last, k, x, c)) continue; /* no multiplier, and none to come */
            for (int64_t j = first; j < last; j++) {
                V value = c[j - first], square = square_at(con, rows, j, k);
                V depth = tgco_sqrt(square) - tgco_sqrt(square - value);
                note(s, con, value, tgco_choose(value <= zero, zero, depth), lam + j, pushed, sweep);
            }
        }
    } else if (is_kind(con, BOXES)) {
        IN factors = rows->bound + con->rows * 2 * DIM;
        int known = any(rows->pushed[place]);
        for (int64_t first = 0, last; first < con->rows; first = last) {
            last = first + TOGETHER < con->rows ? first + TOGETHER : con->rows;
            if (!some_matter(con, rows, lam, known, first, last, x)) continue;
            for (int64_t j = first; j < last; j++) {
                if (!may_matter(con, rows, lam, known, j, x)) continue;
                V c = solid(con, rows, j, k, x, NONE);
                note(s, con, c, tgco_choose(c <= zero, zero, c / factors[j]), lam + j, pushed, sweep);
            }
        }
    } else if (is_kind(con, FIELD) && (any(rows->pushed[place]) || !is_far_from_map(con, rows, x))) {
        V c = field_row(con, rows, k, x, NONE, NONE);
        note(s, con, c, tgco_choose(c <= zero, zero, depth_of(rows, c)), lam, pushed, sweep);
    }
}
#endif

/* Rows of one knot of a constraint. */
TGCO_LARGE void note_rows(Lanes *s, int64_t i, int64_t k, IN x, IN u, Sweep *sweep) {
    const Constraint *con = s->of->constraint + i;
    const Rows *rows = s->rows + i;
    int64_t place = con->place[k];
    OUT lam = rows->lam + place * con->rows; V zero = SET(0.0);
    I none = zero != zero, pushed = none;
    if (is_kind(con, BOUNDS)) {
        for (int j = 0; j < con->rows; j++) {
            V c = bound(con, rows, j, k, x, u);
            note(s, con, c, tgco_choose(c < zero, zero, c), lam + j, &pushed, sweep);
        }
#if DIM > 0
    } else if (is_solid(con)) {
        note_solids(s, con, rows, k, x, &pushed, sweep);
    } else if (is_kind(con, BODY)) {
        V centers[MAX_ROWS];
        Ball ball;
        ball_centers(s, i, k, x, centers);
        for (int b = 0; b < con->balls; b++) {
            ball_at(con, rows, b, k, centers + b * DIM, &ball);
            note_solids(s, &ball.con, &ball.rows, k, ball.x, &pushed, sweep);
        }
#endif
    } else if (is_kind(con, FUNCTION)) {
        V c[MAX_ROWS];
        model_rows((int)i, x, u, at(rows->bound, &con->bound, place), con->shared, c);
        for (int j = 0; j < con->rows; j++) {
            V violated = con->equality ? tgco_fabs(c[j]) : tgco_choose(c[j] < zero, zero, c[j]);
            if (con->radii.data) violated = past_radius(violated, at(rows->radii, &con->radii, place)[j]);
            note(s, con, c[j], violated, lam + j, &pushed, sweep);
        }
    }
    if (sweep->update) rows->pushed[place] = pushed;
}

/* What a sweep over the iterates finds, of all rows or of obstacles alone, and whether one is caught: `least` rows of
   obstacles or more in contact at a knot, start and end left out. */
TGCO_LARGE Sweep swept(Lanes *s, int obstacles, int update, V least, I *caught) {
    int64_t N = s->of->N;
    V zero = SET(0.0);
    Sweep sweep = {zero, zero, zero, update};
    *caught = zero != zero;
    for (int64_t k = 0; k <= N; k++) {
        V contacts = zero;
        for (int64_t i = 0; i < s->of->constraints; i++) {
            const Constraint *con = s->of->constraint + i;
            if (con->place[k] == NOWHERE || (obstacles && !con->geometric)) continue;
            sweep.touched = zero;
            note_rows(s, i, k, s->X + k * NX, k < N ? s->U + k * NU : 0, &sweep);
            if (con->geometric) contacts += sweep.touched;
        }
        if (k > 0 && k < N) *caught |= contacts >= least;
    }
    return sweep;
}
