/* Rows of inequalities that have no place in a barrier: those that no variable moves, such as a bound on a given start
   or a row that is constantly 0, and bounds that coincide.

   A slack has no room in them, and their multipliers would explode. The first kind stays out of the solve, and is judged
   at its end: what is feasible there, with no multiplier, is optimal with the row, too. Of two bounds that coincide, the
   upper one becomes an equality, and the lower one stays out. */
#pragma once
#include "interior_memory.h"

/* A number in [1, 2) for variable i: no row and no model is likely to let a sum of these cancel. */
static inline double uneven(int64_t i) {
    double golden = GOLDEN * (double)(i + 1);
    return 1.0 + golden - floor(golden);
}

/* Whether rows j, the upper, and l, the lower bound of constraint i, are of one variable. */
static inline int are_a_pair(const Constraint *con, int j, int l) {
    return con->variable[j] == con->variable[l] && con->sign[j] > 0 && con->sign[l] < 0;
}

/* The room between two bounds of a variable at knot k; where they coincide, the upper one holds as an equality. */
static void measure_room(Barrier *t, I of, int64_t i, int64_t k) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    if (!is_kind(con, BOUNDS)) return;
    for (int j = 0; j < con->rows; j++) for (int l = j + 1; l < con->rows; l++) {
        if (!are_a_pair(con, j, l)) continue;
        V half = SET(-0.5) * (t->c[q + j] + t->c[q + l]);
        for (int m = 0; m < 2; m++) {
            OUT room = t->room + q + (m ? l : j);
            *room = tgco_choose(of, least(half, SET(1.0)), *room);
        }
        I same = of & (half == SET(0.0));
        t->role[q + j] = tgco_choose(same, SET(FIXED), t->role[q + j]);
        t->role[q + l] = tgco_choose(same, SET(BESIDE), t->role[q + l]);
    }
}

/* The controls du of knot k that are free, each changed by a number of its own. */
static void vary_controls(const Barrier *t, int64_t k, OUT du) {
    const Problem *p = t->lanes.of;
    for (int j = 0; j < NU; j++) du[j] = SET(uneven(k * NU + j));
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (!is_kind(con, BOUNDS) || con->place[k] == NOWHERE) continue;
        for (int j = 0; j < con->rows; j++) if (con->variable[j] >= NX) {
            OUT own = du + con->variable[j] - NX;
            *own = tgco_if(NOT(is_fixed(t, row_of(t, i, k) + j)), *own);
        }
    }
}

/* The rows of constraint i at knot k that z, a change of the knot's variables, moves: they join `moves`. A change that is
   within rounding of its terms is none. */
TGCO_LARGE void find_moved(const Barrier *t, int64_t i, int64_t k, IN x, IN u, const V *z) {
    int rows = t->lanes.of->constraint[i].rows;
    Numbers moves = t->moves + row_of(t, i, k);
    OUT change = t->across[0]; OUT part = t->across[1]; OUT terms = t->across[2]; V own[S];
    along(t, i, k, x, u, z, change);
    for (int j = 0; j < rows; j++) terms[j] = SET(0.0);
    for (int v = 0; v < (u ? S : NX); v++) {
        for (int w = 0; w < S; w++) own[w] = w == v ? z[v] : SET(0.0);
        along(t, i, k, x, u, own, part);
        for (int j = 0; j < rows; j++) terms[j] += tgco_fabs(part[j]);
    }
    V rounding = SET(ROUNDINGS * t->how->last_bit), one = SET(1.0);
    for (int j = 0; j < rows; j++) moves[j] = tgco_choose(tgco_fabs(change[j]) <= rounding * terms[j], moves[j], one);
}

/* Rows j of constraint i at knot k, in the lanes `of`, with less room than a slack is given at first, or than a guess is
   moved inside of its bounds. */
static I is_tight(const Barrier *t, I of, int64_t i, int64_t k, int j) {
    const Constraint *con = t->lanes.of->constraint + i;
    V room = SET(t->how->bound_push);
    if (is_kind(con, BOUNDS)) {
        int v = con->variable[j];
        V at = v < NX ? t->lanes.X[k * NX + v] : t->lanes.U[k * NU + v - NX];
        room *= SET(2.0) * most(tgco_fabs(at), SET(1.0));
    }
    return of & (t->c[row_of(t, i, k) + j] > -room);
}

/* Whether any row of constraint i at knot k is tight in a lane of `of`. */
static int has_tight(const Barrier *t, I of, int64_t i, int64_t k) {
    I tight = of & NOT(of);
    for (int j = 0; j < t->lanes.of->constraint[i].rows; j++) tight |= is_tight(t, of, i, k, j);
    return any(tight);
}

/* What to do with the rows of constraint i at knot k in the lanes `of`, where z is how the knot's variables change. */
typedef void Visit(Barrier *t, I of, int64_t i, int64_t k, const V *z);

/* Whether rows of constraint i at knot k are visited: those that are tight, or `all`. */
static int is_visited(const Barrier *t, I of, int all, int64_t i, int64_t k) {
    const Constraint *con = t->lanes.of->constraint + i;
    return !con->equality && con->place[k] != NOWHERE && (all || has_tight(t, of, i, k));
}

/* How a change of all free variables, each by a number of its own, changes the start. */
static void vary_start(const Barrier *t, OUT dx) {
    for (int i = 0; i < NX; i++) dx[i] = t->is_free ? tgco_if(tgco_is(t->is_free[i]), SET(uneven(~i))) : SET(0.0);
}

/* A trajectory close to the iterate, with the same gaps, into Xn and Un. */
static void find_nearby(Barrier *t) {
    const Lanes *s = &t->lanes;
    int64_t N = s->of->N;
    V step[NX], moved[NX], du[NU];
    vary_start(t, step);
    for (int i = 0; i < NX; i++) s->Xn[i] = s->X[i] + SET(NUDGE) * step[i];
    for (int64_t k = 0; k < N; k++) {
        vary_controls(t, k, du);
        for (int j = 0; j < NU; j++) s->Un[k * NU + j] = s->U[k * NU + j] + SET(NUDGE) * du[j];
    }
    ask(t, NEARBY, t->live, s->X, s->U);
    for (int64_t k = 0; k < N && !t->how->ask; k++) {
        model_step(s->Xn + k * NX, s->Un + k * NU, model_at(s, k), s->of->shared, moved);
        model_step(s->X + k * NX, s->U + k * NU, model_at(s, k), s->of->shared, step);
        for (int i = 0; i < NX; i++) s->Xn[(k + 1) * NX + i] = s->X[(k + 1) * NX + i] + (moved[i] - step[i]);
    }
}

/* Visits the tight rows of all knots, or `all`. Which of them a change of all free variables moves, `moves`, is seen in two
   trajectories close together: a row may be flat in one point alone. */
TGCO_LARGE void visit_rows(Barrier *t, I of, int all, CALLABLE(Visit) visit) {
    const Lanes *s = &t->lanes;
    const Problem *p = s->of;
    int some = 0;
    for (int64_t k = 0; k <= p->N; k++) for (int64_t i = 0; i < p->constraints; i++) some |= is_visited(t, of, all, i, k);
    if (!some) return;
    memset(t->moves, 0, t->rows * sizeof(V));
    find_nearby(t);
    for (int near = 1; near >= 0; near--) {
        IN X = near ? s->Xn : s->X; IN U = near ? s->Un : s->U;
        LOCAL_NUMBERS(t, f, 0, NJ + 1);
        V z[S];
        ask(t, DERIVATIVES, t->live, X, U);
        vary_start(t, z);
        for (int64_t k = 0; k <= p->N; k++) {
            IN x = X + k * NX; IN u = k < p->N ? U + k * NU : 0;
            for (int j = NX; j < S; j++) z[j] = SET(0.0);
            if (u) vary_controls(t, k, z + NX);
            for (int64_t i = 0; i < p->constraints; i++) {
                if (!is_visited(t, of, all, i, k)) continue;
                find_moved(t, i, k, x, u, z);
                if (!near) visit(t, of, i, k, z);
            }
            if (!u) continue;
            V next[NX];
            model_jacobian(x, u, model_at(s, k), p->shared, f);
            model_push(f, z, next);
            memcpy(z, next, sizeof next);
        }
    }
}

/* Rows that nothing moves leave the barrier, and so do bounds that coincide but that nothing moves. */
static void leave_out(Barrier *t, I of, int64_t i, int64_t k, const V *z) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    Numbers moves = t->moves + q;
    for (int j = 0; j < con->rows; j++) {
        I tight = is_tight(t, of, i, k, j), is_state = of & NOT(of);
        if (is_kind(con, BOUNDS) && con->variable[j] < NX) is_state = NOT(is_state);
        I still = NOT(tgco_is(moves[j])), fixed = is_fixed(t, q + j);
        V role = tgco_choose(tight & still & NOT(is_out(t, q + j)), SET(LEFT_OUT), t->role[q + j]);
        t->role[q + j] = tgco_choose(of & still & is_state & fixed, SET(BESIDE), role); /* fixed controls weren't varied */
    }
}

/* Where row q, which was left out, is violated by more than is admitted. Of bounds that coincide none is, as an equality
   stands for both. */
static inline I is_broken(const Barrier *t, int64_t q) {
    return (t->role[q] == SET(LEFT_OUT)) & (t->c[q] > SET(t->admitted));
}

/* Violated rows that were left out, but that something moves now, come into the barrier. */
static void come_in(Barrier *t, I of, int64_t i, int64_t k, const V *z) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    Numbers moves = t->moves + q;
    for (int j = 0; j < con->rows; j++) {
        I in = of & is_broken(t, q + j) & tgco_is(moves[j]);
        t->role[q + j] = tgco_choose(in, SET(INSIDE), t->role[q + j]);
        t->s[q + j] = tgco_choose(in, SET(t->how->bound_push), t->s[q + j]);
    }
}

/* Rows are relaxed by a share of the violation tolerance, and by less where bounds leave less room or the controls change
   them little. */
static void loosen(Barrier *t, I of, int64_t i, int64_t k, const V *z) {
    const Constraint *con = t->lanes.of->constraint + i;
    int64_t q = row_of(t, i, k);
    const Lanes *s = &t->lanes;
    OUT change = t->across[0]; V most_room = SET(t->how->relaxes * t->how->constr_viol_tol);
    along(t, i, k, s->X + k * NX, k < s->of->N ? s->U + k * NU : 0, z, change);
    for (int j = 0; j < con->rows; j++, q++) {
        V room = most_room * least(tgco_fabs(change[j]), t->room[q]);
        room = tgco_if(of & NOT(is_out(t, q)) & tgco_finite(room), room);
        t->room[q] = tgco_choose(of, room, t->room[q]);
        t->s[q] += room;
    }
}

/* Which rows of the lanes `of`, whose iterate and values c are new, stay out of the barrier. */
TGCO_LARGE void sort_rows(Barrier *t, I of) {
    const Problem *p = t->lanes.of;
    for (int64_t q = 0; q < t->rows; q++) {
        t->role[q] = tgco_choose(of, SET(INSIDE), t->role[q]);
        t->room[q] = tgco_choose(of, SET(1.0), t->room[q]);
    }
    for (int64_t k = 0; k <= p->N; k++)
        for (int64_t i = 0; i < p->constraints; i++)
            if (p->constraint[i].place[k] != NOWHERE && !p->constraint[i].equality) measure_room(t, of, i, k);
    visit_rows(t, of, 0, CALLED(leave_out));
    I some = of & NOT(of);
    for (int64_t q = 0; q < t->rows; q++) some |= is_out(t, q);
    t->some_out = any(some);
}

/* The squares of the slopes of step at knot k, F_iv^2, into squares (S, NX): a variable after the other. */
static void square_slopes(const Barrier *t, int64_t k, OUT squares) {
    V own[S];
    for (int v = 0; v < S; v++) {
        for (int w = 0; w < S; w++) own[w] = SET(w == v);
        model_push(t->f + k * NJ, own, squares + v * NX);
        for (int i = 0; i < NX; i++) squares[v * NX + i] *= squares[v * NX + i];
    }
}

/* What it costs to move the variables of each knot, with all they lead to: of states into dx, of controls into du, which
   hold no step yet. */
TGCO_LARGE void measure_costs(Barrier *t) {
    const Lanes *s = &t->lanes;
    LOCAL_NUMBERS(t, H, 0, S * S);
    LOCAL_NUMBERS(t, squares, S * S, S * NX);
    V g[S];
    for (int64_t k = s->of->N; k >= 0; k--) {
        int last = k == s->of->N;
        memset(g, 0, sizeof g); memset(H, 0, S * S * sizeof(V));
        cost_expand(s, k, s->X + k * NX, last ? 0 : s->U + k * NU, g, H);
        if (!last) square_slopes(t, k, squares);
        for (int v = 0; v < (last ? NX : S); v++) {
            V sum = t->scale * tgco_fabs(H[v * S + v]);
            if (!last) for (int i = 0; i < NX; i++) ADD(sum, squares[v * NX + i], t->dx[(k + 1) * NX + i]);
            *(v < NX ? t->dx + k * NX + v : t->du + k * NU + v - NX) = sum;
        }
    }
}

/* Rows of constraint i at knot k give way by `share` of J^2 moves, the least of their variables', where they hold. */
static void soften_at(Barrier *t, I of, int64_t i, int64_t k, IN moves, V share) {
    const Lanes *s = &t->lanes;
    const Constraint *con = s->of->constraint + i;
    IN x = s->X + k * NX; IN u = k < s->of->N ? s->U + k * NU : 0;
    int64_t q = row_of(t, i, k);
    int first = 0, end = u ? S : NX;
#if DIM > 0
    if (is_solid(con)) { first = POSITION; end = POSITION + DIM; }
#endif
    V own[S]; OUT change = t->across[0]; OUT least_of = t->across[1];
    for (int j = 0; j < con->rows; j++) least_of[j] = SET(INFINITY);
    for (int v = first; v < end; v++) {
        for (int w = 0; w < S; w++) own[w] = SET(w == v);
        along(t, i, k, x, u, own, change);
        for (int j = 0; j < con->rows; j++) {
            V by = change[j] * change[j] * moves[v];
            least_of[j] = tgco_choose(by > SET(0.0), least(by, least_of[j]), least_of[j]);
        }
    }
    for (int j = 0; j < con->rows; j++) {
        V gives = share * least_of[j];
        t->gives[q + j] = tgco_choose(of & tgco_finite(gives) & (gives > SET(1.0)), gives, t->gives[q + j]);
    }
}

/* Whether a row of constraint i at knot k is one of equalities, or `active`, in one of the lanes `of`; bounds that coincide
   are as stiff as can be: they hide no curvature but their own variable's. */
static int some_hold(const Barrier *t, I of, int64_t i, int64_t k, IN active) {
    const Constraint *con = t->lanes.of->constraint + i;
    if (con->place[k] == NOWHERE) return 0;
    int64_t q = row_of(t, i, k);
    int hold = con->equality;
    for (int j = 0; active && j < con->rows; j++) hold |= any(of & (active[q + j] > SET(0.0)));
    return hold;
}

/* Rows of the lanes `of` that hold as equalities give way more where units are small: their stiffness is added to the
   curvature of the cost, of which rounding would leave nothing where that is many times smaller. The cost lets a row give
   way by about J^2 `moves`; of that, a `share` is enough. `moves` is how far the cost lets a variable move, squared, the
   inverse of its curvature: of controls that of all they lead to, of states no farther than what controls lead to them.
   Products of different variables don't count, so it is right but for a factor. The slopes f are those of the iterate. */
TGCO_LARGE void soften_rows(Barrier *t, I of, V share, IN active) {
    const Problem *p = t->lanes.of;
    int some = active ? 1 : 0;
    if (next_of(t, 1, 0) < p->constraints) some = 1;
    if (!some) return;
    for (int64_t q = 0; q < t->rows; q++) t->gives[q] = tgco_choose(of, SET(1.0), t->gives[q]);
    LOCAL_NUMBERS(t, squares, S * S, S * NX);
    V moves[S], zero = SET(0.0), one = SET(1.0);
    measure_costs(t);
    for (int i = 0; i < NX; i++) {
        moves[i] = t->is_free ? tgco_if(tgco_is(t->is_free[i]) & (t->dx[i] > zero), one / t->dx[i]) : zero;
    }
    for (int64_t k = 0; k <= p->N; k++) {
        for (int i = 0; i < NX; i++) {
            V cost = t->dx[k * NX + i];
            moves[i] = tgco_choose(cost > zero, least(one / cost, moves[i]), moves[i]);
        }
        for (int j = 0; j < NU; j++) {
            V cost = k < p->N ? t->du[k * NU + j] : zero;
            moves[NX + j] = tgco_if(cost > zero, one / cost);
        }
        for (int64_t i = 0; i < p->constraints; i++)
            if (some_hold(t, of, i, k, active)) soften_at(t, of, i, k, moves, share);
        if (k == p->N) break;
        square_slopes(t, k, squares);
        V next[NX];
        for (int i = 0; i < NX; i++) {
            next[i] = zero;
            for (int v = 0; v < S; v++) ADD(next[i], squares[v * NX + i], moves[v]);
        }
        for (int i = 0; i < NX; i++) moves[i] = next[i];
    }
}

/* Whether rows that were left out of lane l are violated. */
static int breaks_rows_left_out(const Barrier *t, int l) {
    int breaks = 0;
    if (t->some_out) EACH_ROW(t, 0, q) {
        double role = LANE(t->role[q], l);
        breaks |= role != INSIDE && role != FIXED && !(LANE(t->c[q], l) <= t->how->constr_viol_tol);
    }
    return breaks;
}

/* The multipliers that lane l leaves for two bounds that coincide: each has the sign of an inequality's. */
static void split_multipliers(const Barrier *t, int64_t i, int l) {
    const Constraint *con = t->lanes.of->constraint + i;
    for (int64_t first = 0; first < con->knots * con->rows; first += con->rows) {
        double *lam = con->lam + t->lanes.element[l] * con->knots * con->rows + first;
        for (int j = 0; j < con->rows; j++) for (int m = j + 1; m < con->rows; m++) {
            if (!are_a_pair(con, j, m) || LANE(t->role[t->first[i] + first + j], l) != FIXED || !(lam[j] < 0)) continue;
            lam[m] = -lam[j];
            lam[j] = 0;
        }
    }
}

/* The same the other way round for a warm start: the equality takes both. */
static void join_multipliers(Barrier *t, I of) {
    const Problem *p = t->lanes.of;
    for (int64_t i = 0; i < p->constraints; i++) {
        const Constraint *con = p->constraint + i;
        if (!is_kind(con, BOUNDS)) continue;
        for (int64_t first = t->first[i]; first < t->first[i] + con->knots * con->rows; first += con->rows)
            for (int j = 0; j < con->rows; j++) for (int m = j + 1; m < con->rows; m++) {
                if (!are_a_pair(con, j, m)) continue;
                OUT z = t->z + first;
                z[j] = tgco_choose(of & is_fixed(t, first + j), z[j] - z[m], z[j]);
            }
    }
}
