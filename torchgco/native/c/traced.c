/* A traced cost times one number per problem, less another one per stage: its value, gradient and Hessian at a knot.

   The generated part defines, for `stage` and `last` alike, with a knot's own numbers p, and w that all problems share:

       tgco_stage_value(x, u, p, w, value)
       tgco_stage_entries(x, u, p, w, e)   STAGE_ENTRIES derivatives: STAGE_SLOPES of the gradient, then the Hessian's
       tgco_stage_places                where they belong in g and H */
#include "model.h"
#include "code.h"

/* The cost of stage k at x, u; of the last knot where u is NULL. */
TGCO_BETWEEN_UNITS V cost_value(const Lanes *s, int64_t k, IN x, IN u) {
    V value;
    IN scale = cost_at(s, FACTOR, k);
    if (u) tgco_stage_value(x, u, cost_at(s, STAGE, k), s->of->stage_shared, &value);
    else tgco_last_value(x, u, cost_at(s, LAST, k), s->of->last_shared, &value);
    return u ? scale[0] * value - scale[1] : scale[0] * value;
}

static inline void add_entries(V factor, int slopes, int count, const int *places, IN e, OUT g, OUT H) {
    for (int i = 0; i < slopes; i++) ADD(g[places[i]], factor, e[i]);
    for (int i = slopes; i < count; i++) ADD(H[places[i]], factor, e[i]);
}

/* Adds gradient g (S) and upper triangle H (S, S) of `cost_value`. */
TGCO_BETWEEN_UNITS void cost_expand(const Lanes *s, int64_t k, IN x, IN u, OUT g, OUT H) {
    if (u) {
        V e[STAGE_ENTRIES + 1];
        tgco_stage_entries(x, u, cost_at(s, STAGE, k), s->of->stage_shared, e);
        add_entries(cost_at(s, FACTOR, k)[0], STAGE_SLOPES, STAGE_ENTRIES, tgco_stage_places, e, g, H);
    } else {
        V e[LAST_ENTRIES + 1];
        tgco_last_entries(x, u, cost_at(s, LAST, k), s->of->last_shared, e);
        add_entries(cost_at(s, FACTOR, k)[0], LAST_SLOPES, LAST_ENTRIES, tgco_last_places, e, g, H);
    }
}
