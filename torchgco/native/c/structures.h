/* What Python hands to the library and reads back: Python's own declarations follow from these (native/structures.py).
   E counts problems, S = NX + NU, NZ = NX + 1. Sizes of arrays stand in brackets, (E, ...). */
#pragma once
#include "standard.h"
#include "constants.h" /* enumerations and numbers that Python has, too */

/* An array over (problems, knots, numbers); a stride of 0 stands for an axis of length 1. */
typedef struct {
    const double *data;
    int64_t element, knot, size;
} Array;

typedef struct {
    int32_t kind, equality, geometric, rows; /* rows of a knot */
    const int32_t *place; /* (N+1): index among the constraint's knots, or NOWHERE */
    int64_t knots;
    /* (E, knots, rows): multipliers, NULL where all are 0, of an exported solver one after the other; and those of an outer
       loop's best */
    double *lam, *best;
    const int32_t *variable; /* BOUNDS: (rows) index into [x, u] */
    const double *sign; /* BOUNDS: (rows) +1 for an upper bound, -1 for a lower one */
    /* BOUNDS (E, knots, rows); SPHERES: centres (E, 1, rows * DIM), or (E, knots, rows * DIM) where they are `moved`;
       FUNCTION: p (E, knots, ...); BOXES, FIELD: see boxes.h, field.h. */
    Array bound;
    Array squares; /* SPHERES: squared inflated radii (E, 1, rows), ABSENT where there is none */
    Array velocities; /* SPHERES: as centres, or NULL */
    Array radii; /* FUNCTION: see Constraint.row_radii (E, knots, rows), or NULL */
    Array stops; /* SPHERES, BOXES, FIELD: the last knot at which they count (E, 1, 1), or NULL */
    double dt;
    const double *shared; /* FUNCTION: numbers w that all problems share */
    const float *map; /* FIELD: distances at the nodes of all maps (G, map_x, map_y, map_z) */
    const int64_t *map_of; /* FIELD: (E) */
    int64_t map_x, map_y, map_z;
    int32_t smooth; /* FIELD: three nodes per axis, or two */
    /* BODY: its balls, each with an equal share of rows and numbers, and the kind that all of them are; the function
       that places them is traced, with p as of a FUNCTION (E, knots, ...). */
    int32_t balls, kind_of_balls;
    int32_t moved; /* SPHERES: whether centres are those of the constraint's knots */
    Array lift;
} Constraint;

/* The options of iLQR and its line search (see ILQR and LineSearch). */
typedef struct {
    const double *ladder; /* (rungs): step lengths */
    int64_t rungs, back, max_iterations; /* back: -1 where each search begins with a full step */
    int32_t accept_last;
    double tolerance, absolute_tolerance, ratio_min, ratio_max, smallest, rounding, lost;
    double regularisation_first, regularisation_growth, regularisation_max;
    double damping, damping_growth, damping_decay;
} Options;

/* Problems of one form with their iterates, and where results are written. */
typedef struct {
    int64_t N, constraints, limit;
    double *X, *U, *cost, *merit, *regularisation; /* (E, ...) in and out */
    double *alpha, *used; /* (E): step length and mu_r of the last iteration */
    double *gains; /* (E, N, NU, NZ): what tgco_gains writes */
    double *slack, *violation; /* (E): the same; NULL: not asked for */
    double *slopes, *curvatures; /* (E, N+1, S), (E, N+1, S, S): what tgco_expand writes; (E, N+1, NX) of tgco_costates */
    const double *halves; /* of tgco_regulated, which reads costates in `slopes` */
    double *mu;
    int64_t *inner, *iterations, *rung;
    int32_t *status, *converged, *refused, *lost, *sensitive; /* sensitive: of tgco_gains; NULL: not asked for */
    const int64_t *numbers; /* (E): at which place each problem's parameters, cost and constraints are; NULL: at its own */
    Array parameters; /* of the model: (E, N, count) */
    /* Numbers w that all problems share, of the model, and of stages and the last knot of a traced cost. */
    const double *shared, *stage_shared, *last_shared;
    Array cost_data[COST_ARRAYS];
    const Constraint *constraint;
    int32_t guide, phr, replicas, bounded; /* bounded: no stage's cost is below 0 */
    int32_t optimality; /* see `pull` */
    Array center, radius, weight;
    Options options;
    double gain; /* share of L_M by which tgco_lift must lower it */
    double nudge; /* share of the controls by which tgco_gains changes them; times `gain` states may change by it */
    void *arena; /* of an exported solver, where its memory comes from (export/c/arena.h); else NULL */
} Problem;

/* The outer loop of the augmented Lagrangian (see solvers.augmented_lagrangian). */
typedef struct {
    const Problem *of;
    int64_t *outer, *outcome; /* (E): outcome is RUNNING until a problem ends */
    double *last_cost; /* (E) */
    double *best_X, *best_U, *best_mu, *best_cost, *best_violation; /* (E, ...) */
    const int64_t *base; /* (E): outer iterations before this solve, for `single_after` */
    const double *goal, *near; /* (E, DIM), (E); NULL: arrival doesn't count */
    int32_t solves, updates; /* whether a pass makes the inner solves, and the outer iterations of those ended */
    int64_t passes, max_outer, single_after; /* -1: never a single contact */
    int32_t ends, stops; /* stops: a caught iterate ends its problem's solve */
    double growth, penalty_max, tolerance, settled;
    int64_t lifted_steps;
    double lifted_gain;
} Outer;

/* MPPI's rounds (see guidance.MPPI). */
typedef struct {
    const Problem *of;
    int64_t samples, rounds, knots, elite; /* knots at which noise is drawn; 0: at every stage, white */
    double temperature, collision_penalty, dwell_cost, decay;
    const uint64_t *keys; /* (E, rounds) */
    Array deviation, lower, upper; /* (E, 1, NU), bounds (E, N, NU) */
    const int32_t *left; /* (N): the knot before each stage; unused where white */
    const double *share; /* (N): share of the interval to the next */
    const int32_t *geometric; /* of each constraint: whether samples that touch it are counted */
    double *mean; /* (E, N, NU) in and out */
} Sampling;

/* What the interior point asks Python, where C can't call a problem's functions, of all knots of LANES lanes: the numbers
   that called.c gives at a knot, of those lanes whose bit is set in `lanes`. R rows. */
typedef struct {
    int32_t asked; /* VALUES or DERIVATIVES at X, U; NEARBY: those states in Xn that follow from Un, with the gaps of X */
    int64_t lanes;
    const int64_t *element; /* (LANES): the problems in them */
    double *X, *U, *Xn, *Un; /* (N+1, NX, LANES), (N, NU, LANES) */
    const double *y, *z, *objective; /* (N+1, NX, LANES), (R, LANES), (LANES): y and z count so many times */
    double *step, *stage, *last; /* (N, ...), (N, ...), (1, ...): where numbers go */
    const void *rows; /* (constraints): pointers to those of each, (knots, ..., LANES) */
} Request;
typedef void Ask(const Request *request);

/* The interior point; what its options mean stands in lagrangian/barrier.py. */
typedef struct {
    const Problem *of;
    double *barrier; /* (E): mu, in and out */
    double *error, *theta; /* (E): error of the end test, sum of residuals */
    double *falls; /* (E): 1 where the cost falls to second order from where the conditions hold: of `minimum` */
    const double *constant, *least_cost; /* (E): what of the cost does not count, and its least size */
    const double *free_start; /* (E, NX): 1 where a component of the start is a variable; NULL: nowhere */
    Ask *ask; /* Python, where it computes the functions; else NULL */
    int64_t max_iter, acceptable_iter, watchdog_shortened_iter_trigger, watchdog_trial_iter_max, failures;
    int32_t warm, minimum, max_soc;
    double tol, constr_viol_tol, acceptable_tol, bound_push, counts, smoothing;
    double seconds;
    double nlp_scaling_obj_target_gradient, constr_mult_init_max, held;
    double barrier_tol_factor, mu_linear_decrease_factor, mu_floor, mu_min, s_max, rounding;
    double tau_min, tau_max, kappa_sigma, theta_max_fact, theta_min_fact, gamma_theta, gamma_phi, eta_phi, delta;
    double s_theta, s_phi, noise, last_bit, alpha_min;
    double first_hessian_perturbation, min_hessian_perturbation, max_hessian_perturbation;
    double perturb_dec_fact, perturb_inc_fact, perturb_inc_fact_first;
    double pivot, crawl, shift_crawl, recovery_growth, recovery_decay;
    double jacobian_regularization_value, softest, explodes, soft_growth, soft_decay, slight, relaxes;
    double shift_recovery, forced_growth, required_infeasibility_reduction;
} Interior;

/* Linear systems with the matrix of the KKT conditions (see lagrangian.kkt); R rows. */
typedef struct {
    const Problem *of;
    const double *free_start, *active; /* as in Interior; (E, R): 1 where a row holds */
    const double *give; /* (E, R): by which rows that hold give way to their multipliers; NULL: 0 */
    const double *K; /* (E, N, NU, NX): gains; NULL: 0 */
    Ask *ask; /* as in Interior */
    double *a, *b, *c; /* (C, E, N+1, S), (C, E, N, NX), (C, E, R): right hand sides in, z, y, v out */
    double *y, *left; /* (E, N+1, NX): costates; (C, E): largest of what active rows leave open */
    double *responses; /* (E, N d, N d): of d states from `first` on at knots 1..N to forces there; NULL: none are asked */
    int64_t problems, count, rounds, first, d; /* E, C */
    double stiff, slight, pivot;
} Kkt;
