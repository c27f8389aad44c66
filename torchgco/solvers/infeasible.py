"""Whether the violation of trajectories can't be lowered any further from where they are."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.status import STALLED, Status
from torchgco.base.tree import put, take
from torchgco.constraints.bounds import Bounds
from torchgco.ilqr.riccati import backward
from torchgco.kernels import cost_unit, measured
from torchgco.lagrangian.lagrangian import Iterate, Lagrangian, Multipliers, SolveEnd, linearise
from torchgco.problem.problem import Problem
from torchgco.solvers.contracts import Call
from torchgco.solvers.convexity import is_affine, looks_convex_row
from torchgco.solvers.ilqr import ILQR, descend

WITHOUT_END = Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, Status.NOT_POSITIVE_DEFINITE, Status.NON_FINITE
HEAVY = 1e11  # penalty beside which a cost of one unit counts for nothing
STUCK = 1e-3  # share of the squared violation that one Gauss-Newton step could save: about 1 where it can be closed
STEP_REGULARISATION = 1e-9  # regularisation of that step, as a share of the largest entry of its Hessians
ROUNDING = 1e-6  # share of the squared violation that is left to rounding where rows contradict each other
REPAIR = ILQR(max_iterations=200, tolerance=1e-12)


def least_violated(call: Call, end: SolveEnd, tolerance: float) -> SolveEnd:
    """The same, with STALLED where a solve failed and no step from its end lowers the violation any further."""
    failed = torch.stack([end.status == status for status in WITHOUT_END]).any(0)
    rows = (failed & ~(end.best.violation <= tolerance)).nonzero().flatten()
    if rows.numel() == 0 or call.late:
        return end
    problem, old = call.problem.take(rows).held_at(end.best.X[rows, 0]), take(end.best, rows)
    cost_unit(problem)
    multipliers = Multipliers.zero(problem, HEAVY)
    repaired, ended = descend(REPAIR, Lagrangian(problem.in_cost_units(), multipliers, None, phr=True), old.U)
    X, U, violation = repaired.X, repaired.U, measured(problem, repaired.X, repaired.U)
    # A problem without a feasible trajectory ends at a stationary point of the violation; others may do so, too.
    stuck = (ended != Status.NON_FINITE) & (ended != Status.NOT_POSITIVE_DEFINITE)
    stuck &= left_to_close(problem, X, U) <= STUCK
    stuck |= contradicts(problem, X, U, tolerance) & (call.problem.free_start is None)
    stuck &= violation > tolerance
    less = (stuck & (violation < old.violation)).nonzero().flatten()
    new = Iterate(X, U, old.multipliers, problem.cost.total(X, U), violation)
    put(end.best, rows[less], take(new, less))
    end.status[rows[stuck]] = STALLED
    return end


def left_to_close(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The share (B,) of the squared violation that one Gauss-Newton step is predicted to save; NaN without any step."""
    s = problem.n + 1 + problem.m
    H, squares = X.new_zeros(*X.shape[:2], s, s), X.new_zeros(X.shape[0])
    for constraint in problem.constraints:
        c = constraint.value(X, U)
        if constraint.sense == "inequality":
            c = c.clamp(min=0.0)
        constraint.accumulate(X, U, c, (c != 0).to(c.dtype), H)
        squares = squares + 0.5 * c.square().sum(-1).sum(-1)
    H = H.transpose(0, 1)
    step = backward(linearise(problem, X, U), H, STEP_REGULARISATION * H.abs().amax(dim=(0, 2, 3)))
    saved = -step.expected_change(torch.ones_like(squares)) / squares
    flat = (H == 0).all(0).flatten(1).all(-1) & (squares > 0)  # no violated row has a slope: no step saves anything
    return torch.where(flat, 0.0, torch.where(step.failed, torch.nan, saved))


def contradicts(problem: Problem, X: Tensor, U: Tensor, tolerance: float) -> Tensor:
    """Whether rows can't all be met within a tolerance by controls within their bounds, whatever these are, (B,) bool.

    Of an affine model with convex rows, others left out. Their squared violations lie above their tangent at any
    trajectory X (B, N+1, n), U (B, N, m): where that is above 0 for all controls within the bounds, none meets the
    rows. That is Farkas' lemma with the violations as multipliers.
    """
    s, n = problem.n + 1 + problem.m, problem.n
    H, squares = X.new_zeros(*X.shape[:2], s, s), X.new_zeros(X.shape[0])
    for constraint in problem.constraints:
        if isinstance(constraint, Bounds) and constraint.of == "u":
            continue
        c = constraint.value(X, U)
        excess = torch.where(c > tolerance, c - tolerance, 0.0)
        if constraint.sense == "equality":
            excess = excess + torch.where(c < -tolerance, c + tolerance, 0.0)
        convex = looks_convex_row(problem, constraint, X, U)
        excess = torch.where(convex.view(-1, 1, 1), excess, 0.0)
        constraint.accumulate(X, U, excess, torch.zeros_like(excess), H)
        squares = squares + excess.square().sum(-1).sum(-1)
    F, by_state = linearise(problem, X, U), H[:, -1, :n, n]
    least, bounds = 0.5 * squares, problem.control_bounds
    sides = [U.new_tensor(end) for end in (-torch.inf, torch.inf)] if bounds is None else bounds.over(problem.N)
    low, high = (side.expand_as(U) for side in sides)
    for k in range(problem.N - 1, -1, -1):
        slope = H[:, k, n + 1 :, n] + (by_state.unsqueeze(1) @ F[k, :, :n, n + 1 :]).squeeze(1)
        ends = [slope * (end[:, k] - U[:, k]) for end in (low - tolerance, high + tolerance)]
        least = least + torch.where(slope != 0, torch.minimum(*ends), 0.0).sum(-1)
        by_state = H[:, k, :n, n] + (by_state.unsqueeze(1) @ F[k, :, :n, :n]).squeeze(1)
    return (least > ROUNDING * squares) & is_affine(problem, X, U)
