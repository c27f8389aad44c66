#if DIM > 0
/* By how far the states x lie deeper in the obstacles of constraint i than may be at a start; above 0: too far. */
static double too_deep(const Solve *b, const Lanes *s, int64_t i, const V *x) {
    const Constraint *con = s->of->constraint + i;
    double worst = -INFINITY;
    int64_t k = con->place[0] == NOWHERE && (con->moved || is_kind(con, BODY)) ? 1 : 0;
    Ball ball;
    V centers[MAX_ROWS];
    if (con->place[k] == NOWHERE && k) return worst;
    if (is_kind(con, BODY)) ball_centers(s, i, k, x, centers);
    for (int part = 0; part < (is_kind(con, BODY) ? con->balls : 1); part++) {
        const Constraint *own = con;
        const Rows *rows = s->rows + i;
        const V *at_x = x;
        if (is_kind(con, BODY)) {
            ball_at(con, rows, part, k, centers + part * DIM, &ball);
            own = &ball.con; rows = &ball.rows; at_x = ball.x;
        }
        for (int j = 0; j < own->rows; j++) {
            V away[DIM];
            double deep = -INFINITY;
            if (is_kind(own, SPHERES)) {
                double square = square_at(own, rows, j, k), gap = square - sphere(own, rows, j, k, at_x, away);
                if (square >= 0) deep = CONTACT * sqrt(square) - sqrt(gap);
            } else if (is_kind(own, BOXES)) {
                deep = solid(own, rows, j, k, at_x, 0) / (rows->bound + own->rows * 2 * DIM)[j] - b->contact_depth[i];
            } else if (is_kind(own, FIELD)) {
                V c = field_row(own, rows, k, at_x, 0, 0);
                if (c > 0) deep = depth_of(rows, c) - b->contact_depth[i];
            }
            if (deep > worst) worst = deep;
        }
    }
    return worst;
}
#endif

/* Whether the vehicle touches an obstacle at the start. */
static int starts_inside(Solve *b, const double *x) {
#if DIM > 0
    int inside = 0;
    for (int i = 0; i < DIM && b->how.free_start; i++) if (b->how.free_start[POSITION + i] != 0) return 0; /* a guess */
    memcpy(b->X, x, USER_NX * sizeof *x);
    b->follow.X = b->X; b->follow.U = b->U;
    b->arena.next = b->arena_begin;
    LOCAL(Lanes, s, &b->follow);
    if (!s || !start(s, &b->follow)) return 0;
    enter_problem(s, 0, 0);
    for (int64_t i = 0; i < s->of->constraints; i++) {
        const Constraint *con = s->of->constraint + i;
        if (is_solid(con) || is_kind(con, BODY)) inside |= too_deep(b, s, i, s->X) > 0;
    }
    finish(s);
    return inside;
#else
    (void)b; (void)x;
    return 0;
#endif
}
