/* A primal-dual interior point with a filter (Waechter and Biegler 2006) for problems side by side: states, controls
   and slacks move together, and the lanes are kept filled. solvers/interior says what it does. */

#include "clock.h"
#include "interior_fixed.h"
#include "interior_search.h"

/* Values and an empty filter of the lanes `of`; `anew`: slacks, too, and which rows have one. */
TGCO_LARGE void settle(Barrier *t, Track *k, I of, int anew) {
    const Interior *how = t->how;
    Lanes *s = &t->lanes;
    V cost = values(t, t->live, s->X, s->U, t->c, t->gap);
    if (anew) {
        sort_rows(t, of);
        EACH_ROW(t, 0, q) {
            V slack = most(-t->c[q], SET(how->bound_push) * t->room[q]);
            if (t->some_out) slack = tgco_choose(is_out(t, q), SET(1.0), slack);
            t->s[q] = tgco_choose(of, slack, t->s[q]);
        }
    }
    residuals(t, t->c, t->s, t->r);
    V theta = size_of(t, t->gap, t->r), phi = cost - t->mu * logarithms(t, t->s);
    k->theta = tgco_choose(of, theta, k->theta);
    k->phi = tgco_choose(of, phi, k->phi);
    V one = SET(1.0), base = most(theta, one);
    k->highest = tgco_choose(of, SET(how->theta_max_fact) * base, k->highest);
    k->lowest = tgco_choose(of, SET(how->theta_min_fact) * base, k->lowest);
    for (int l = 0; l < LANES; l++) if (LANE(of, l)) k->pairs[l] = 0;
}

/* Sizes of bounds join those of their variables. */
static void measure_bounds(const Barrier *t, OUT size) {
    const Lanes *s = &t->lanes;
    for (int64_t i = 0; i < s->of->constraints; i++) {
        const Constraint *con = s->of->constraint + i;
        if (!is_kind(con, BOUNDS)) continue;
        for (int64_t k = 0; k <= s->of->N; k++) for (int j = 0; con->place[k] != NOWHERE && j < con->rows; j++) {
            V limit = tgco_fabs(at(s->rows[i].bound, &con->bound, con->place[k])[j]);
            int v = con->variable[j];
            size[v] = most(tgco_if(tgco_finite(limit), limit), size[v]);
        }
    }
}

/* Sizes that no number tells, 0, follow from those of the states that these variables move within a step. */
static void infer_sizes(const Barrier *t, OUT size) {
    const Lanes *s = &t->lanes;
    I open = SET(0.0) != SET(0.0);
    for (int v = 0; v < S; v++) open |= size[v] == SET(0.0);
    if (!any(open)) return;
    LOCAL_NUMBERS(t, f, 0, NJ + 1);
    LOCAL_NUMBERS(t, moved, S * S, S * NX);
    V one[S];
    model_jacobian(s->X, s->U, model_at(s, 0), s->of->shared, f);
    for (int v = 0; v < S; v++) {
        for (int w = 0; w < S; w++) one[w] = SET(w == v);
        model_push(f, one, moved + v * NX);
    }
    for (int tries = 0; tries < NX; tries++) for (int v = 0; v < S; v++) {
        V found = SET(INFINITY);
        for (int i = 0; i < NX; i++) {
            V by = size[i] / tgco_fabs(moved[v * NX + i]);
            if (i != v) found = tgco_choose(by > SET(0.0), least(by, found), found);
        }
        size[v] = tgco_choose((size[v] == SET(0.0)) & tgco_finite(found), found, size[v]);
    }
}

/* The largest slope or curvature of the cost in any one variable, and `plain` in its own units. The cost is scaled by it.
   In a variable of small units, a length in tens of kilometres, curvatures are large though it moves little: the scaled
   cost would be tiny beside barrier and multipliers. So a variable whose numbers are all small counts in units of the
   largest of them: in the guess, in its bounds, and in the step to the minimum of the cost alone. */
TGCO_LARGE V steepest(const Barrier *t, V *plain) {
    const Lanes *s = &t->lanes;
    LOCAL_NUMBERS(t, H, 0, S * S);
    V largest = SET(0.0), zero = SET(0.0), one = SET(1.0), g[S], slope[S], bend[S], size[S];
    for (int v = 0; v < S; v++) slope[v] = bend[v] = size[v] = zero;
    for (int64_t k = 0; k <= s->of->N; k++) {
        IN x = s->X + k * NX; IN u = k < s->of->N ? s->U + k * NU : 0;
        memset(g, 0, sizeof g); memset(H, 0, S * S * sizeof(V));
        cost_expand(s, k, x, u, g, H);
        for (int v = 0; v < (u ? S : NX); v++) {
            V rises = tgco_fabs(g[v]), bends = tgco_fabs(H[v * S + v]);
            slope[v] = most(rises, slope[v]); bend[v] = most(bends, bend[v]);
            V far = most(tgco_fabs(v < NX ? x[v] : u[v - NX]), tgco_if(bends > zero, rises / bends));
            size[v] = most(far, size[v]);
        }
    }
    measure_bounds(t, size);
    infer_sizes(t, size);
    *plain = zero;
    for (int v = 0; v < S; v++) {
        V by = most(size[v], SET(LEAST_SIZE));
        by = tgco_choose((size[v] > zero) & (by < SET(ORDINARY)), by, one);
        largest = most(most(slope[v] * by, bend[v] * by * by), largest);
        *plain = most(most(slope[v], bend[v]), *plain);
    }
    return largest;
}

/* The barrier parameter at which lane l begins: at least that at which it ends, where the barrier stays. */
static double first_barrier(const Barrier *t, int l) {
    double own = t->how->barrier[t->lanes.element[l]], end = t->how->smoothing * LANE(t->scale, l);
    return own > end ? own : end;
}

/* Multipliers of bounds begin at 1 where the cost hardly holds a step back. Those of the central path, mu / s, are tiny at
   a bound far away: in a linear programme, and with tiny weights, steps leave the bounds a hundredfold, as little of them
   is taken, and iterations grow with the horizon. Elsewhere 1 would bend the model for nothing. What moving a variable
   leads to counts, too, and a slack as 1 at least: at a bound nearby small slacks hold a step. */
TGCO_LARGE void hold_loose(Barrier *t, I of) {
    const Lanes *s = &t->lanes;
    I some = of & NOT(of);
    measure_costs(t);
    for (int64_t i = 0; i < s->of->constraints; i++) {
        const Constraint *con = s->of->constraint + i;
        if (!is_kind(con, BOUNDS)) continue;
        for (int64_t k = 0; k <= s->of->N; k++) for (int j = 0; con->place[k] != NOWHERE && j < con->rows; j++) {
            int v = con->variable[j];
            int64_t q = row_of(t, i, k) + j;
            V costs = v < NX ? t->dx[k * NX + v] : t->du[k * NU + v - NX];
            I loose = of & NOT(is_out(t, q)) & (costs * most(t->s[q], SET(1.0)) <= SET(t->how->held));
            if (k == 0 && v < NX) loose &= t->is_free ? tgco_is(t->is_free[v]) : of & NOT(of); /* nothing moves a given one */
            t->z[q] = tgco_choose(loose, SET(1.0), t->z[q]);
            some |= loose;
        }
    }
    if (!any(some)) return;
    expand(t);
    adjoin(t, some, NONE);
}

/* Lanes `of` have just been loaded: the scale of their cost, slacks and multipliers. */
TGCO_LARGE void begin(Barrier *t, Track *k, I of) {
    V one = SET(1.0), zero = SET(0.0), largest, plain;
    const Interior *how = t->how;
    const Problem *p = t->lanes.of;
    t->scale = tgco_choose(of, one, t->scale); t->raised = tgco_choose(of, one, t->raised);
    t->objective = tgco_choose(of, one, t->objective);
    k->last = tgco_choose(of, zero, k->last); k->forced = tgco_choose(of, zero, k->forced);
    k->made = tgco_choose(of, zero, k->made);
    k->least = tgco_choose(of, SET(INFINITY), k->least);
    k->left = tgco_choose(of, SET(INFINITY), k->left);
    t->shift = tgco_choose(of, zero, t->shift); /* gains of a problem that ends at once don't know the lane's last one */
    k->restoring &= NOT(of); k->watching &= NOT(of);
    t->relaxed &= NOT(of); k->presses &= NOT(of);
    t->soft = tgco_choose(of, SET(how->jacobian_regularization_value), t->soft);
    for (int l = 0; l < LANES; l++) if (LANE(of, l)) k->failures[l] = k->shortened[l] = 0;
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        for (int64_t j = 0; j < con->knots * con->rows; j++)
            for (int l = 0; l < LANES; l++)
                if (LANE(of, l)) LANE(t->z[t->first[i] + j], l) = con->lam[t->lanes.element[l] * con->knots * con->rows + j];
    }
    ask(t, DERIVATIVES, t->live, t->lanes.X, t->lanes.U);
    largest = steepest(t, &plain);
    V scale = SET(how->nlp_scaling_obj_target_gradient) / largest;
    I scaled = of & tgco_finite(scale) & (largest > zero);
    t->scale = tgco_choose(scaled, scale, t->scale);
    t->raised = tgco_choose(scaled, plain / largest, t->raised);
    for (int l = 0; l < LANES; l++) if (LANE(of, l)) LANE(t->mu, l) = first_barrier(t, l);
    settle(t, k, of, 1);
    if (how->warm) {
        if (t->some_out) join_multipliers(t, of);
        EACH_ROW(t, 0, q) {
            V z = t->scale * t->z[q], lowest = t->mu / (SET(how->kappa_sigma) * t->s[q]);
            t->z[q] = tgco_choose(of, by_role(t, q, most(z, lowest), z), t->z[q]);
        }
        EACH_ROW(t, 1, q) t->z[q] = tgco_choose(of, t->scale * t->z[q], t->z[q]);
        expand(t);
        adjoin(t, of, NONE);
    } else {
        renew(t, of);
        hold_loose(t, of);
    }
    soften_rows(t, of, SET(how->slight), NONE);
}

/* The next mu of the lanes whose barrier problem is solved well enough; their filter begins anew. */
TGCO_LARGE void lower_barrier(Barrier *t, Track *k, I running, V dual, V primal, V scale_z) {
    const Interior *how = t->how;
    V base = most(dual, primal), usual = SET(how->tol * how->mu_floor);
    V smallest = tgco_choose(k->presses, SET(how->mu_min), usual);
    if (how->smoothing > 0) smallest = SET(how->smoothing) * t->scale;
    I lowered = running & NOT(running);
    for (int tries = 0; tries < LONGEST_FALL; tries++) {
        V error = most(base, complementarity(t, t->mu) * scale_z);
        I low = (error <= SET(how->barrier_tol_factor) * t->mu) & (t->mu > smallest);
        low &= running & NOT(k->restoring) & NOT(k->watching);
        if (!any(low)) break;
        V slow = SET(how->mu_linear_decrease_factor) * t->mu, fast = t->mu * tgco_sqrt(t->mu);
        V next = most(smallest, least(slow, fast));
        t->mu = tgco_choose(low, next, t->mu);
        lowered |= low;
    }
    if (!any(lowered)) return;
    V cost = cost_along(t, lowered, t->lanes.X, t->lanes.U);
    k->phi = tgco_choose(lowered, cost - t->mu * logarithms(t, t->s), k->phi);
    for (int l = 0; l < LANES; l++) if (LANE(lowered, l)) k->pairs[l] = 0;
}

/* Factors of all lanes, their curvature shifted where it must be, those of the lanes `anew` from the least shift on;
   lanes that no shift helps leave `running`. */
TGCO_LARGE I factor_shifted(Barrier *t, const Track *k, I running, I anew) {
    const Interior *how = t->how;
    t->shift = tgco_choose(anew, k->forced, t->shift);
    I lost = running & NOT(running), open = running & anew; /* others had this shift before */
    for (;;) {
        I bad = open & NOT(factor(t, open));
        if (!any(bad)) break;
        V before = k->last, first = SET(how->first_hessian_perturbation), floor = SET(how->min_hessian_perturbation);
        V start = tgco_choose(before == SET(0.0), first, most(floor, before * SET(how->perturb_dec_fact)));
        V growth = tgco_choose(before == SET(0.0), SET(how->perturb_inc_fact_first), SET(how->perturb_inc_fact));
        V next = tgco_choose(t->shift == SET(0.0), start, growth * t->shift);
        t->shift = tgco_choose(bad, next, t->shift);
        lost |= bad & (t->shift > SET(how->max_hessian_perturbation));
        open = bad & NOT(lost);
    }
    return running & NOT(lost);
}

/* Where equalities contradict each other to first order, their multipliers explode: a softer step is taken there. */
TGCO_LARGE I soften(Barrier *t, const Track *k, I moving) {
    const Interior *how = t->how;
    for (;;) {
        V largest = SET(0.0);
        EACH_ROW(t, 1, q) largest = most(tgco_fabs(t->z[q] + t->dz[q]), largest);
        if (t->some_out) EACH_ROW(t, 0, q) largest = most(tgco_if(is_fixed(t, q), tgco_fabs(t->z[q] + t->dz[q])), largest);
        I large = moving & (largest > SET(how->explodes) * t->raised) & (t->soft < SET(how->softest));
        if (!any(large)) return moving;
        t->soft = tgco_choose(large, SET(how->soft_growth) * t->soft, t->soft);
        expand(t);
        moving = factor_shifted(t, k, moving, large);
        solve(t);
        solve_rows(t);
    }
}

/* Lanes whose line search failed, or that no shift gives a step, look for feasibility alone: steps of least length that
   close residuals. Where there is nothing to close, they start anew with new multipliers and a shift. Returns the lanes
   that give up. */
TGCO_LARGE I recover(Barrier *t, Track *k, I failed) {
    const Interior *how = t->how;
    I renewed = failed & NOT(failed), lost = renewed;
    for (int l = 0; l < LANES; l++) {
        if (!LANE(failed, l)) continue;
        if (++k->failures[l] > how->failures) { LANE(lost, l) = -1; continue; }
        int seeks = LANE(k->theta, l) > how->constr_viol_tol && !LANE(k->restoring, l);
        double harder = how->forced_growth * LANE(k->forced, l);
        LANE(k->forced, l) = harder < how->shift_recovery ? how->shift_recovery : harder;
        if (seeks) { LANE(k->restoring, l) = -1; LANE(k->entered, l) = LANE(k->theta, l); LANE(t->objective, l) = 0; }
        else { LANE(k->restoring, l) = 0; LANE(t->objective, l) = 1; }
        LANE(renewed, l) = -1;
    }
    if (any(renewed)) { renew(t, renewed); settle(t, k, renewed, 0); }
    return lost;
}

/* Lanes that have become feasible enough go on with the cost. */
TGCO_LARGE void resume(Barrier *t, Track *k) {
    const Interior *how = t->how;
    I less = k->theta <= SET(how->required_infeasibility_reduction) * k->entered;
    I done = k->restoring & (less | (k->theta <= SET(how->constr_viol_tol)));
    if (!any(done)) return;
    k->restoring &= NOT(done);
    t->objective = tgco_choose(done, SET(1.0), t->objective);
    renew(t, done);
    settle(t, k, done, 0);
}

/* Lanes `of` whose barrier, or what the rows' residuals are worth, is a part of their cost that counts: where the units
   are small, a complementarity or a residual within its tolerance, in all `left`, isn't small beside it. */
TGCO_LARGE I barrier_counts(Barrier *t, I of, V *left) {
    *left = SET(0.0);
    if (t->how->smoothing > 0) return of & NOT(of); /* it is to stay */
    if (!any(of)) return of;
    V cost = cost_along(t, of, t->lanes.X, t->lanes.U), size;
    EACH_ROW(t, 0, q) *left += by_role(t, q, t->s[q] * t->z[q], SET(0.0)) + tgco_fabs(t->z[q] * t->r[q]);
    EACH_ROW(t, 1, q) *left += tgco_fabs(t->z[q] * t->r[q]);
    for (int l = 0; l < LANES; l++) {
        int64_t e = t->lanes.element[l];
        LANE(size, l) = fabs(LANE(cost, l) - LANE(t->scale, l) * t->how->constant[e]) + LANE(t->scale, l) * t->how->least_cost[e];
    }
    return of & (*left > SET(t->how->counts) * size);
}

/* Lanes of `running` that end here. Tolerances below the usual rounding are met as well as the iterate can be, as the
   rollout of its controls amplifies gaps: a lane goes on while the error falls, and ends above them where rounding keeps
   it there. So does one whose barrier counts, for as long as this share falls. */
TGCO_LARGE I find_solved(Barrier *t, Track *k, I running, V error, V primal) {
    const Interior *how = t->how;
    V zero = SET(0.0), one = SET(1.0), left;
    V idle = tgco_choose(error <= SET(0.5) * k->least, zero, k->idle + one);
    k->idle = tgco_choose(running, idle, k->idle);
    k->least = tgco_choose(running & (error < k->least), error, k->least);
    I feasible = running & NOT(k->restoring) & (primal <= SET(how->constr_viol_tol));
    I met = feasible & (error <= SET(how->tol)), counts = barrier_counts(t, met, &left);
    k->idle = tgco_choose(counts & (left <= SET(0.5) * k->left), zero, k->idle);
    k->left = tgco_choose(counts, least(left, k->left), k->left);
    k->presses |= counts;
    I rests = k->idle >= SET((double)how->acceptable_iter);
    met &= NOT(counts) | rests;
    met &= ((SET(how->tol) >= SET(how->rounding)) & NOT(k->presses)) | (error <= SET(2.0) * t->mu) | (k->idle >= one);
    return met | (feasible & rests & (error <= SET(how->acceptable_tol)));
}

/* Where a multiplier of an inequality explodes, rows leave each other no room: they are relaxed, as IPOPT's bounds are. */
TGCO_LARGE void relax(Barrier *t, Track *k, I running) {
    V largest = SET(0.0);
    EACH_ROW(t, 0, q) largest = most(t->z[q], largest);
    I lacks = running & (largest > SET(t->how->explodes) * t->raised) & NOT(t->relaxed) & NOT(k->watching);
    if (!any(lacks)) return;
    visit_rows(t, lacks, 1, CALLED(loosen));
    t->relaxed |= lacks;
    settle(t, k, lacks, 0);
    renew(t, lacks);
}

/* Rows that were left out of the lanes `of` come in where they are broken by more than `admitted` and something moves
   them now; returns the lanes with such rows. */
TGCO_LARGE I readmit(Barrier *t, Track *k, I of, double admitted) {
    I broken = of & NOT(of), changed = broken;
    t->admitted = admitted;
    EACH_ROW(t, 0, q) broken |= of & is_broken(t, q);
    if (!any(broken)) return changed;
    EACH_ROW(t, 0, q) t->dz[q] = t->role[q]; /* no step is under way */
    visit_rows(t, broken, 0, CALLED(come_in));
    EACH_ROW(t, 0, q) changed |= t->dz[q] != t->role[q];
    if (!any(changed)) { expand(t); return changed; } /* rows were visited in the model's memory */
    for (int l = 0; l < LANES; l++) if (LANE(changed, l)) {
        LANE(t->mu, l) = first_barrier(t, l);
        LANE(k->watching, l) = k->shortened[l] = 0;
    }
    k->least = tgco_choose(changed, SET(INFINITY), k->least);
    k->left = tgco_choose(changed, SET(INFINITY), k->left);
    settle(t, k, changed, 0);
    renew(t, changed);
    return changed;
}

/* One iteration of the lanes `running`; returns those that end, with their status. */
TGCO_LARGE I iterate(Barrier *t, Track *k, I running, int32_t *status, V *error) {
    const Interior *how = t->how;
    V dual, primal, scale_z;
    if (t->some_out) readmit(t, k, running, how->theta_max_fact); /* beyond which no residual is accepted */
    relax(t, k, running);
    residuals(t, t->c, t->s, t->r);
    expand(t);
    errors(t, &dual, &primal, &scale_z);
    *error = most(most(dual, primal), complementarity(t, SET(how->smoothing) * t->scale) * scale_z);
    I ended = running & NOT(running), astray = running & k->watching & NOT(tgco_finite(*error));
    I small = (*error <= most(SET(how->tol), SET(how->acceptable_tol))) & (primal <= SET(how->constr_viol_tol));
    small &= NOT(k->restoring); /* no step that can't be taken matters there */
    if (any(astray)) go_back(t, k, astray);
    I solved = find_solved(t, k, running & NOT(astray), *error, primal);
    for (int l = 0; l < LANES; l++) {
        if (!LANE(running, l) || LANE(astray, l)) continue;
        if (LANE(solved, l)) {
            I one = running & NOT(running);
            LANE(one, l) = -1;
            if (t->some_out && any(readmit(t, k, one, how->constr_viol_tol))) continue;
            status[l] = CONVERGED;
        }
        else if (!(LANE(*error, l) - LANE(*error, l) == 0)) status[l] = NON_FINITE;
        else if (LANE(k->made, l) >= how->max_iter) status[l] = LANE(small, l) ? CONVERGED : MAX_ITERATIONS;
        else continue;
        LANE(ended, l) = -1;
    }
    running &= NOT(ended) & NOT(astray);
    if (!any(running)) return ended;
    lower_barrier(t, k, running, dual, primal, scale_z);
    memcpy(t->aim, t->gap, t->lanes.of->N * NX * sizeof(V));
    I moving = factor_shifted(t, k, running, running);
    solve(t);
    solve_rows(t);
    moving = soften(t, k, moving);
    k->last = tgco_choose(moving & (t->shift > SET(0.0)), t->shift, k->last);
    astray = running & NOT(moving) & k->watching;
    if (any(astray)) go_back(t, k, astray);
    I without = running & NOT(moving) & NOT(astray);
    V tau = least(most(SET(how->tau_min), SET(1.0) - t->mu), SET(how->tau_max));
    I won = search(t, k, moving, tau);
    k->made += tgco_truth(running);
    /* Where only short steps are accepted, the step reaches further than the model: more curvature shortens it. */
    V floor = SET(how->shift_crawl), lower = k->forced * SET(how->recovery_decay);
    V higher = tgco_choose(t->shift > floor, SET(how->recovery_growth) * t->shift, most(floor, k->last));
    lower = tgco_if(lower >= floor, lower);
    k->forced = tgco_choose(won & NOT(k->restoring), tgco_choose(k->crawls, higher, lower), k->forced);
    t->soft = tgco_choose(won, most(SET(how->jacobian_regularization_value), SET(how->soft_decay) * t->soft), t->soft);
    residuals(t, t->c, t->s, t->r);
    for (int l = 0; l < LANES; l++) if (LANE(won, l) && !LANE(k->restoring, l) && LANE(k->forced, l) == 0) k->failures[l] = 0;
    I stopped = (moving & NOT(won)) | without;
    for (int l = 0; l < LANES; l++) if (LANE(stopped, l) && LANE(small, l)) { status[l] = CONVERGED; LANE(ended, l) = -1; }
    I lost = recover(t, k, stopped & NOT(small));
    for (int l = 0; l < LANES; l++) if (LANE(lost, l)) {
        status[l] = LANE(without, l) ? NOT_POSITIVE_DEFINITE : LINE_SEARCH_FAILED;
        LANE(ended, l) = -1;
    }
    resume(t, k);
    return ended;
}

static V stiffest(const Barrier *t) {
    V found = SET(0.0);
    EACH_ROW(t, 0, q) found = most(by_role(t, q, t->z[q] / t->s[q], SET(0.0)), found);
    return found;
}

/* Lanes of `ended` from whose iterate the cost falls to second order: the reduced Hessian isn't positive definite. Where
   rows have become so stiff that rounding decides, none. */
TGCO_LARGE I find_falls(Barrier *t, I ended) {
    V shift = t->shift;
    ended &= stiffest(t) < SET(1.0 / t->how->rounding);
    if (!any(ended)) return ended;
    expand(t);
    t->shift = tgco_choose(ended, SET(0.0), shift);
    I sound = factor(t, ended);
    t->shift = shift;
    return ended & NOT(sound);
}

TGCO_LARGE void leave_barrier(Barrier *t, const Track *k, int lane, int32_t status, double error) {
    const Problem *p = t->lanes.of;
    int64_t N = p->N, e = t->lanes.element[lane];
    for (int64_t i = 0; i < (N + 1) * NX; i++) p->X[e * (N + 1) * NX + i] = LANE(t->lanes.X[i], lane);
    for (int64_t i = 0; i < N * NU; i++) p->U[e * N * NU + i] = LANE(t->lanes.U[i], lane);
    for (int64_t i = 0; i < N * NU * NZ; i++) p->gains[e * N * NU * NZ + i] = LANE(t->lanes.G[i], lane);
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        for (int64_t j = 0; j < con->knots * con->rows; j++)
            con->lam[e * con->knots * con->rows + j] = LANE(t->z[t->first[i] + j], lane) / LANE(t->scale, lane);
        if (t->some_out && is_kind(con, BOUNDS)) split_multipliers(t, i, lane);
    }
    t->how->barrier[e] = LANE(t->mu, lane);
    t->how->error[e] = error;
    t->how->theta[e] = LANE(k->theta, lane);
    p->iterations[e] += (int64_t)LANE(k->made, lane);
    if (status == CONVERGED && breaks_rows_left_out(t, lane)) status = INFEASIBLE;
    /* The slack of a violated row without slope falls to 0, and its multiplier has no end. */
    int fails = status == NON_FINITE || status == NOT_POSITIVE_DEFINITE;
    p->status[e] = fails && LANE(stiffest(t), lane) == INFINITY ? LINE_SEARCH_FAILED : status;
}

/* How many numbers of a lane a solve has room for. */
int64_t tgco_room(const Interior *how) { return room_of(how); }

/* Problems first, first + 1, ..., last - 1. Returns 0 without memory. */
int tgco_interior(const Interior *how, int64_t first, int64_t last) {
    LOCAL(Barrier, t, how->of);
    LOCAL(Track, k, how->of);
    if (!start_barrier(t, how)) return 0;
    memset(k, 0, sizeof *k);
    I running = SET(0.0) == SET(0.0), fresh = running;
    int64_t next = first;
    double begun = SECONDS_BEGUN(how);
    int64_t own = last - first < LANES ? last - first : LANES;
    for (int l = 0; l < LANES; l++) { /* lanes without a problem repeat the first problem: its networks are computed once */
        enter_barrier(t, l, l < own ? first + l : first);
        if (l < own) next++;
        else if (how->ask) LANE(running, l) = 0;
    }
    t->live = running;
    begin(t, k, fresh);
    while (any(running)) {
        int32_t status[LANES];
        V error;
        I ended = iterate(t, k, running, status, &error);
        int late = SECONDS_NOW(how) - begun > how->seconds; /* which Python makes shorter where a function has failed */
        if (late) for (int l = 0; l < LANES; l++) if (LANE(running, l) && !LANE(ended, l)) { status[l] = TIME_LIMIT; LANE(ended, l) = -1; }
        fresh &= NOT(fresh);
        I falls = how->minimum && any(ended) ? find_falls(t, ended) : fresh & NOT(fresh);
        if (any(ended)) { /* gains along the trajectories that leave, whatever the other lanes do */
            expand(t);
            factor(t, fresh);
        }
        for (int l = 0; l < LANES; l++) {
            if (!LANE(ended, l)) continue;
            if (l < own) leave_barrier(t, k, l, status[l], LANE(error, l));
            if (l < own) how->falls[t->lanes.element[l]] = LANE(falls, l) ? 1.0 : 0.0;
            if (next < last && !late) { enter_barrier(t, l, next++); LANE(fresh, l) = -1; }
            else LANE(running, l) = 0;
        }
        t->live = running;
        if (any(fresh)) begin(t, k, fresh);
    }
    for (; next < last; next++) how->of->status[next] = TIME_LIMIT; /* not begun */
    finish_barrier(t);
    return 1;
}
