"""Options and constants of the interior point, and which of them a precision can meet."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

NUDGE = 1e-3  # how far from the iterate a row's slope is looked at again: it may vanish in one point alone
GOLDEN = 0.6180339887498949
ROUNDINGS = 2.0**12  # units of the last bit of its terms, up to which a change may be rounding along the stages
ORDINARY = 1e-2  # sizes of variables from here on are those of ordinary units
LEAST_SIZE = 1e-6  # sizes below may be rounding of larger numbers
FILTERED = 64  # entries of a filter; the oldest are forgotten
LONGEST_FALL = 50  # reductions of the barrier parameter in one iteration
LEAST_VIOLATION = 100.0  # units of the last bit of lengths of 1 m, below which a rollout doesn't meet rows


@dataclass(frozen=True)
class BarrierOptions:
    """Names are IPOPT's where it has the option, those of Waechter and Biegler (2006) in brackets, else the paper's;
    what has neither isn't in the paper.
    """

    tol: float  # of the optimality conditions, scaled as in the paper
    constr_viol_tol: float  # up to which rows and dynamics count as met
    max_iter: int
    acceptable_tol: float  # an error below this ends a solve that makes no progress
    bound_push: float  # least slack at the start, and how far guesses are moved inside of their bounds (kappa_1)
    counts: float  # where complementarity makes up more than this share of the cost, mu falls further
    warm: int = 0  # 1: multipliers are given
    minimum: int = 0  # 1: says where the cost falls to second order from where the conditions hold
    smoothing: float = 0.0  # mu, in units of the cost, at which the barrier stays; 0: it falls
    seconds: float = math.inf  # after which problems end with TIME_LIMIT

    # Where the solve begins.
    nlp_scaling_obj_target_gradient: float = 1.0  # slope or curvature of the cost, to which it is scaled
    constr_mult_init_max: float = 1e3  # costates at the start are 0 where larger
    held: float = 1e-3  # of that size, by which curvature changes a slope over a slack: less holds no step

    # The barrier parameter, and the end.
    barrier_tol_factor: float = 10.0  # error, in mu, from which mu falls (kappa_epsilon)
    mu_linear_decrease_factor: float = 0.2  # (kappa_mu)
    mu_floor: float = 0.1  # least mu, as a multiple of tol
    mu_min: float = 1e-30  # least mu where complementarity counts
    s_max: float = 100.0  # mean size of multipliers, from which errors are divided by it
    rounding: float = 1e-10  # errors below this may be due to rounding
    acceptable_iter: int = 3  # iterations in which an error that still falls falls by half

    # The line search.
    tau_min: float = 0.99  # least share of the way to where a slack is 0
    tau_max: float = 1.0 - 1e-12  # and the largest: slacks stay above 0
    kappa_sigma: float = 1e10  # factor by which s z may leave mu
    theta_max_fact: float = 1e4  # theta_max, as a multiple of theta at the start, of 1 at least
    theta_min_fact: float = 1e-4  # theta_min, the same
    gamma_theta: float = 1e-5
    gamma_phi: float = 1e-8
    eta_phi: float = 1e-4
    delta: float = 1.0
    s_theta: float = 1.1
    s_phi: float = 2.3
    noise: float = 10.0  # rounding of phi, in units of its last bit
    last_bit: float = 2.0**-52  # share of a number that is the last bit of what functions give
    alpha_min: float = 1e-10  # least step length
    max_soc: int = 1  # second-order corrections, 0 or 1
    watchdog_shortened_iter_trigger: int = 10  # short steps before the watchdog
    watchdog_trial_iter_max: int = 3  # and its full steps

    # Curvature that is added (delta_w).
    first_hessian_perturbation: float = 1e-4
    min_hessian_perturbation: float = 1e-20
    max_hessian_perturbation: float = 1e20
    perturb_dec_fact: float = 1.0 / 3.0  # (kappa_w^-)
    perturb_inc_fact: float = 8.0  # (kappa_w^+)
    perturb_inc_fact_first: float = 100.0
    pivot: float = 1e-14  # least pivot, as a share of its entry
    crawl: float = 0.02  # share of the longest step below which a step is short, and more curvature is added next
    shift_crawl: float = 1e-8  # what is added then, at least
    recovery_growth: float = 4.0  # factor by which it grows
    recovery_decay: float = 1.0 / 3.0  # and falls after other steps

    # Dual regularisation (delta_c): rows of equalities give way to their multipliers.
    jacobian_regularization_value: float = 1e-8
    softest: float = 1e-2  # and the largest, where multipliers explode
    explodes: float = 1e6  # multipliers from which on they do
    soft_growth: float = 100.0  # factor by which it grows
    soft_decay: float = 0.1  # and falls
    slight: float = 2e-5  # times delta_c: the least share, 1e3 roundings, of what the cost lets equalities give way
    relaxes: float = 0.01  # of constr_viol_tol, by which rows are relaxed there (1e-8: IPOPT's bound_relax_factor)

    # After a line search that fails.
    failures: int = 6  # of them in a row, at most
    shift_recovery: float = 1e-3  # curvature that is added, at least
    forced_growth: float = 10.0  # factor by which it grows
    required_infeasibility_reduction: float = 0.9  # (kappa_resto)


def fitted(options: BarrierOptions, dtype: torch.dtype) -> BarrierOptions:
    """Options for functions that are evaluated in a precision: as they are in float64.

    Shares of rounding grow with the last bit, by 2^29 in float32, and the dual regularisation, whose inverse is added
    to curvatures, with its root. The end test asks for an error that grows with the third root (1e-8 becomes 8e-6), and
    takes one that falls no further below the root (2.3e-4) for rounding. Rows are met to 100 units of the last bit at
    least (1.2e-5).
    """
    coarser = torch.finfo(dtype).eps / options.last_bit
    if coarser == 1.0:
        return options
    rounding = options.tol * coarser**0.5
    return replace(
        options,
        last_bit=torch.finfo(dtype).eps,
        pivot=options.pivot * coarser,
        tau_max=1.0 - (1.0 - options.tau_max) * coarser,
        jacobian_regularization_value=options.jacobian_regularization_value * coarser**0.5,
        tol=options.tol * coarser ** (1.0 / 3.0),
        rounding=rounding,
        acceptable_tol=max(options.acceptable_tol, rounding),
        constr_viol_tol=least_violation(options.constr_viol_tol, dtype),
    )


def least_violation(tolerance: float, dtype: torch.dtype) -> float:
    """The violation up to which a trajectory counts as feasible, at least what its precision can meet."""
    return max(tolerance, LEAST_VIOLATION * torch.finfo(dtype).eps)
