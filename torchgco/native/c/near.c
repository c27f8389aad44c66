/* Obstacles near the trajectory: at each knot a list of those that can add anything there. An obstacle that isn't listed
   has no multiplier and lies farther away than the position has moved since, so leaving it out changes no bit. */

#if DIM > 0
#define SLACK 1.001 /* obstacles are listed this much farther away than positions move: more than rounding */

/* The numbers of a constraint's obstacles that count at a knot, in their order. */
typedef struct { const int32_t *row; int64_t count; } Listed;

/* The squared radius of sphere j at knot k; ABSENT without one, or where time has stopped. */
static inline V square_at(const Constraint *con, const Rows *rows, int64_t j, int64_t k) {
    if (!con->stops.data) return rows->squares[j];
    return tgco_choose(SET(k) > rows->stops[0], SET(ABSENT), rows->squares[j]);
}

/* Lanes in which the position is nearer to obstacle j than it may move, along every axis. */
static inline I in_reach(const Constraint *con, const Rows *rows, int64_t j, int64_t k, const V *x) {
    I far = SET(0.0) != SET(0.0);
    V radius = con->kind == SPHERES ? tgco_sqrt(square_at(con, rows, j, k)) : SET(0.0);
    for (int a = 0; a < DIM; a++) {
        const V *bounds = rows->bound + (con->kind == SPHERES ? j * DIM + a : (a * con->rows + j) * 2);
        V away = x[POSITION + a] - bounds[0], reach = con->kind == SPHERES ? radius : bounds[1];
        if (con->velocities.data) away -= SET(k * con->dt) * rows->velocities[j * DIM + a];
        far |= tgco_fabs(away) > reach + SET(SLACK) * rows->margin[a];
        if (!any(~far)) break;
    }
    return ~far & ~(radius != radius);
}

/* No list holds for the problem in a lane. Those to be made hold while positions move by its obstacles' mean reach. */
static void begin_lists(const Constraint *con, Rows *rows, int lane) {
    for (int a = 0; a < DIM; a++) {
        double sum = 0;
        int64_t count = 0;
        for (int64_t j = 0; j < con->rows; j++) {
            double reach = con->kind == SPHERES ? rows->squares[j][lane] : rows->bound[(a * con->rows + j) * 2 + 1][lane];
            if (!(reach > 0)) continue;
            sum += con->kind == SPHERES ? __builtin_sqrt(reach) : reach;
            count++;
        }
        rows->margin[a][lane] = count ? sum / count : 0;
    }
    for (int64_t i = 0; i < con->knots * DIM; i++) rows->from[i][lane] = __builtin_nan("");
}

static void list_near(const Constraint *con, const Rows *rows, int64_t k, const V *x) {
    int64_t place = con->place[k], count = 0;
    const V *lam = rows->lam + place * con->rows;
    int32_t *list = rows->near + place * con->rows;
    int pushed = any(rows->pushed[place]);
    for (int64_t j = 0; j < con->rows; j++)
        if (any(in_reach(con, rows, j, k, x)) || (pushed && any(lam[j] != SET(0.0)))) list[count++] = (int32_t)j;
    rows->count[place] = (int32_t)count;
    memcpy(rows->from + place * DIM, x + POSITION, DIM * sizeof(V));
}

/* The obstacles of a constraint that count at knot k. */
static inline Listed near(const Constraint *con, const Rows *rows, int64_t k, const V *x) {
    if (con->rows <= FEW) return (Listed){rows->near, con->rows};
    int64_t place = con->place[k];
    const V *from = rows->from + place * DIM;
    I stays = tgco_fabs(x[POSITION] - from[0]) <= rows->margin[0];
    for (int a = 1; a < DIM; a++) stays &= tgco_fabs(x[POSITION + a] - from[a]) <= rows->margin[a];
    if (any(~stays)) list_near(con, rows, k, x);
    return (Listed){rows->near + place * con->rows, rows->count[place]};
}
#endif
