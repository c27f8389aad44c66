/* What the interior point asks Python. */
#pragma once
#include "interior.h"

/* Has Python compute the functions of the lanes `of` at X, U, where C doesn't. */
static void ask(const Barrier *t, int asked, I of, IN X, IN U) {
    const Lanes *s = &t->lanes;
    if (!t->how->ask) return;
    Request request = {
        .asked = asked, .element = s->element, .X = ADDRESS(X), .U = ADDRESS(U), .Xn = ADDRESS(s->Xn),
        .Un = ADDRESS(s->Un), .y = ADDRESS(t->y), .z = ADDRESS(t->z), .objective = (double *)&t->objective,
        .step = ADDRESS(s->parameters), .stage = ADDRESS(s->cost_data[STAGE]),
        .last = ADDRESS(s->cost_data[LAST]), .rows = t->rows_asked};
    for (int l = 0; l < LANES; l++) if (LANE(of, l)) request.lanes |= (int64_t)1 << l;
    if (request.lanes) t->how->ask(&request);
}
