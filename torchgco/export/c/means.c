/* The time of a knot of the plan, s. */
static double knot_time(const NAME_workspace *w, int k) {
#if SEGMENTS
    return w->t[k];
#else
    static const double stage = @STAGE@;
    (void)w;
    return stage * k;
#endif
}

/* The mean controls of the plan from `since` on, s, while `lasting`, s; where that is 0, those of the first stage. */
static void mean_controls(const NAME_workspace *w, double since, double lasting, double *u) {
    double first = knot_time(w, 0), last = knot_time(w, N), end = since + lasting;
    for (int j = 0; j < USER_NU; j++) u[j] = lasting > 0 ? 0 : w->U[j];
    for (int k = 0; k < N && lasting > 0; k++) {
        double from = k ? knot_time(w, k) : first < since ? first : since;
        double to = k + 1 < N ? knot_time(w, k + 1) : last > end ? last : end;
        from = from < since ? since : from > end ? end : from;
        to = to < since ? since : to > end ? end : to;
        for (int j = 0; j < USER_NU; j++) u[j] += (to - from) / lasting * w->U[k * USER_NU + j];
    }
}

