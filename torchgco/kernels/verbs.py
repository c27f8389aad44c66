"""What solvers ask of a problem's kernels, whichever these are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.bounds import Bounds
from torchgco.costs.base import ShiftedCost
from torchgco.dynamics import rollout
from torchgco.kernels.choice import kernels_of, native
from torchgco.kernels.in_pytorch import clearance_of
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.native.interior import InteriorKernels
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale
from torchgco.problem.times import bulge, paths


def open_loop(problem: Problem, U: Tensor) -> Tensor:
    """X (B, N+1, n) from controls U (B, N, m)."""
    return kernels_of(problem).open_loop(problem, U)


def followed(problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The rollout, X and U, that brings the problem's start back to X (B, N+1, n) by the feedback u = U + K (x - X).

    Free components of the start are those of X.
    Gains K (B, N, m, n) that aren't finite count as 0.
    """
    start = problem.start_in(X[:, 0])
    K, away = K.nan_to_num(0.0, 0.0, 0.0), start - X[:, 0]
    U = torch.cat((U[:, :1] + (K[:, 0] * away.unsqueeze(1)).sum(-1).unsqueeze(1), U[:, 1:]), dim=1)
    return kernels_of(problem).closed_loop(problem, torch.cat((start.unsqueeze(1), X[:, 1:]), dim=1), U, K)


def rolled_out(problem: Problem, X: Tensor, U: Tensor, gains: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rollout that a solve's states X (B, N+1, n) and controls U (B, N, m) stand for, and its violation (B,).

    It follows X by the feedback u = U + K (x - X), which closes gaps; but where U alone leads to X up to rounding,
    there are none to close. Active rows of a tight solution may be so stiff that rounding decides on the gains, which
    then make a change that counts of one in the last bit: where they do, U alone.

    Args:
        X: from the problem's start, or what is chosen of it.
        gains: (B, N, m, n+1), of which K is used; those that aren't finite count as 0.
    """
    return kernels_of(problem).rolled_out(problem, X, U, gains)


def reproducible(problem: Problem, X: Tensor, U: Tensor, rows: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """X (B, N+1, n) and U (B, N, m) of a problem's kernels, repaired where PyTorch's rollout of U would not give X.

    The two kinds of kernels differ in the last bits. In the problems `rows` (b,), unstable dynamics amplify this, as a
    rollout of slightly different controls has shown: PyTorch tracks X with the gains K (b, N, m, n), and X and U of
    that rollout are returned.
    """
    G = torch.cat((K, torch.zeros_like(K[..., :1])), dim=-1).nan_to_num(0.0).transpose(0, 1)
    X, U, alpha = X.clone(), U.clone(), torch.zeros_like(X[rows, 0, 0])
    X[rows], U[rows] = rollout.closed_loop(problem.dynamics.take(rows), X[rows], U[rows], G.contiguous(), alpha)
    return X, U


def value(lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
    """J_var (B,) and L_M (B,)."""
    return kernels_of(lagrangian.problem).value(lagrangian, X, U)


def costates(problem: Problem, X: Tensor, U: Tensor, lam: Sequence[Tensor]) -> Tensor | None:
    """Slopes (B, N+1, n) of J_var + lam'c by the states, where later states follow from each; but those of the start.

    None where no kernels in C have worked on problems of just this form, and where the time is free.
    """
    if not problem.known.in_c or not native() or problem.horizon is not None or problem.time is not None:
        return None
    if any(row.joins_knots for row in problem.constraints):
        return None
    return problem.known.in_c.costates(problem, X, U, lam)


def regulated(problem: Problem, X: Tensor, U: Tensor, *found: Any) -> tuple[Tensor, Tensor]:
    """By how much steps F (B, N, n+2, n+2+m) of [x, 1, t, u], as those of `judging.steps`, change J_var + lam'c, (B,).

    To first and to second order, where controls answer by feedback. Further arguments are multipliers, F and what
    `costates` has found.
    """
    return problem.known.in_c.regulated(problem, X, U, *found)


def measured(problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
    """The largest violation (B,) of trajectories, of all constraints or of `obstacles` alone (geometric ones)."""
    return kernels_of(problem).violation(problem, X, U, obstacles)


def cost_scale(problem: Problem) -> CostScale:
    """`problem.cost_scale`, computed without autodiff where compiled code can; the problem keeps it."""
    if (known := problem.derived.get("cost_scale")) is not None:
        return known
    whole = problem if problem.part_of is None else problem.part_of[0]
    if "cost_scale" not in whole.derived:
        first = whole if whole.B <= problem.B else problem
        kernels_of(first).scale(first)
    return problem.cost_scale


def is_convex(problem: Problem) -> bool:
    """Whether a problem is known to be convex: affine dynamics, a quadratic cost, and bounds."""
    cost = problem.cost.cost if isinstance(problem.cost, ShiftedCost) else problem.cost
    bounded = all(isinstance(constraint, Bounds) for constraint in problem.constraints)
    return bounded and cost.kernel == "quadratic" and kernels_of(problem).affine


def chord_clearance(problem: Problem, X: Tensor, share: float | None = None) -> Tensor:
    """Smallest distance (B,) from the straight lines between knots to obstacles, m, negative in contact.

    Counted from a `share` of an obstacle's margin beneath its surface, by default from where bodies touch; infinite
    without obstacles and positions that keep a distance.
    """
    return kernels_of(problem).chord_clearance(problem, X, share)


def path_clearance(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The same (B,) of where bodies touch, from the paths that the integrator takes between the knots.

    Exact where a path may touch; elsewhere that of its chords, which are then farther away than it leaves them.
    """
    if not problem.distances:
        return X.new_full(X.shape[:1], torch.inf)
    clearance = kernels_of(problem).chord_clearance(problem, X, None)
    if not problem.bends:
        return clearance
    off = bulge(problem, X, U)
    near = (clearance < off).nonzero().flatten()
    if near.numel() == 0:
        return clearance
    for path in paths(problem.take(near), X[near], U[near], off[near]):
        if path.pieces > 1:
            rows = near[path.rows]
            fine = [row.in_pieces(path.pieces) for row in problem.take(rows).distances]
            clearance[rows] = clearance_of(fine, path.X, None)
    return clearance


def interior_of(problem: Problem) -> InteriorKernels:
    """The interior point's kernels for problems of this form.

    Raises:
        InputError: rows that join knots.
        NativeError: no compiler.
    """
    return kernels_of(problem).interior(problem)
