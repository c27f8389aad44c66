/* Boxes that may be turned, as obstacles: the rows of a knot, for problems with boxes (constraints/boxes.py). */

/* First come the bounds of all boxes along the first axis of space, middle and half length, then along the second, ...:
   most boxes are too far away for more. Then the numbers of each box: its centre (DIM), the directions of its sides
   (DIM, DIM), half their lengths (DIM), its own radius plus r_veh, and the factor that turns a distance into a squared
   length, 0 where the box is absent. */
#define BOX_NUMBERS (DIM * DIM + 2 * DIM + 2)

/* Row j at a knot, and its derivatives by position (DIM) unless `slopes` is NULL; an absent box is c = -1. */
static inline V solid(const Constraint *con, const Rows *rows, int64_t j, const V *x, V *slopes) {
    const V *o = rows->bound + con->rows * 2 * DIM + j * BOX_NUMBERS;
    const V *axes = o + DIM, *half = axes + DIM * DIM, *radius = half + DIM;
    V factor = radius[1], zero = SET(0.0), local[DIM], away[DIM], square = zero, deepest = zero;
    I nearest[DIM];
    for (int i = 0; i < DIM; i++) {
        local[i] = zero;
        for (int a = 0; a < DIM; a++) local[i] += axes[i * DIM + a] * (x[POSITION + a] - o[a]);
        V depth = tgco_fabs(local[i]) - half[i];
        away[i] = tgco_if(depth > zero, depth);
        square += away[i] * away[i];
        nearest[i] = i == 0 ? zero == zero : depth > deepest; /* the first of equals */
        deepest = tgco_choose(nearest[i], depth, deepest);
        for (int a = 0; a < i; a++) nearest[a] &= ~nearest[i];
    }
    I outside = square > zero, here = factor > zero;
    V distance = tgco_sqrt(tgco_choose(outside, square, SET(1.0)));
    V c = factor * (radius[0] - tgco_choose(outside, distance, deepest));
    if (slopes) {
        for (int a = 0; a < DIM; a++) slopes[a] = zero;
        for (int i = 0; i < DIM; i++) {
            V side = tgco_choose(outside, away[i] / distance, tgco_truth(nearest[i]));
            side = -factor * tgco_choose(local[i] < zero, -side, side);
            for (int a = 0; a < DIM; a++) slopes[a] += axes[i * DIM + a] * side;
        }
        for (int a = 0; a < DIM; a++) slopes[a] = tgco_if(here, slopes[a]);
    }
    return tgco_choose(here, c, SET(-1.0));
}

/* Whether the knot lies outside of the bounds of box j in every lane. */
static inline int is_far(const Constraint *con, const Rows *rows, int64_t j, const V *x) {
    I far = SET(0.0) != SET(0.0);
    for (int a = 0; a < DIM; a++) {
        const V *bounds = rows->bound + (a * con->rows + j) * 2;
        far |= tgco_fabs(x[POSITION + a] - bounds[0]) > bounds[1];
        if (!any(~far)) return 1;
    }
    return 0;
}

static inline V boxes_value(const Lanes *s, const Constraint *con, const Rows *rows, int64_t k, const V *x, V total) {
    const V *lam = rows->lam + con->place[k] * con->rows;
    int pushed = any(rows->pushed[con->place[k]]);
    for (int64_t j = 0; j < con->rows; j++) {
        if (is_far(con, rows, j, x) && !(pushed && any(lam[j] != SET(0.0)))) continue;
        V c = solid(con, rows, j, x, 0);
        if (any(~(c <= SET(0.0)) | (lam[j] != SET(0.0)))) total += worth(s, 0, c, lam[j]);
    }
    return total;
}

static inline void boxes_expand(
    const Lanes *s, const Constraint *con, const Rows *rows, int64_t k, const V *x, V *g, V *H) {
    const V *lam = rows->lam + con->place[k] * con->rows;
    int pushed = any(rows->pushed[con->place[k]]);
    V slopes[DIM], rho;
    for (int64_t j = 0; j < con->rows; j++) {
        if (is_far(con, rows, j, x) && !(pushed && any(lam[j] != SET(0.0)))) continue;
        V c = solid(con, rows, j, x, slopes);
        if (!any(~(c <= SET(0.0)) | (lam[j] != SET(0.0)))) continue;
        V slope = pull(s, 0, c, lam[j], &rho);
        for (int a = 0; a < DIM; a++) {
            g[POSITION + a] += slope * slopes[a];
            for (int b = a; b < DIM; b++) H[(POSITION + a) * S + POSITION + b] += rho * slopes[a] * slopes[b];
        }
    }
}
