/* The time of a knot of the plan, s. */
static double knot_time(const NAME_workspace *w, int k) {
#if SEGMENTS
    return w->t[k];
#else
    (void)w;
    return @STAGE@ * k;
#endif
}

/* The mean controls of the plan for so many seconds from `since` on; of none, those of the first stage. */
static void mean_controls(const NAME_workspace *w, double since, double seconds, double *u) {
    double first = knot_time(w, 0), last = knot_time(w, N), end = since + seconds;
    for (int j = 0; j < USER_NU; j++) u[j] = seconds > 0 ? 0 : w->U[j];
    for (int k = 0; k < N && seconds > 0; k++) {
        double from = k ? knot_time(w, k) : first < since ? first : since;
        double to = k + 1 < N ? knot_time(w, k + 1) : last > end ? last : end;
        from = from < since ? since : from > end ? end : from;
        to = to < since ? since : to > end ? end : to;
        for (int j = 0; j < USER_NU; j++) u[j] += (to - from) / seconds * w->U[k * USER_NU + j];
    }
}

