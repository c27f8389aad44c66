"""What solvers compute with, in PyTorch: any device, any dtype, any code that PyTorch can differentiate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchgco.dynamics import rollout
from torchgco.eager import sampling
from torchgco.ilqr.riccati import BackwardPass, backward
from torchgco.ilqr.step import Descent, iterate
from torchgco.kernels.outer import NativeOuter
from torchgco.lagrangian.barrier import ROUNDINGS
from torchgco.lagrangian.lagrangian import InnerState, Lagrangian, PassEnd, State, linearise
from torchgco.lagrangian.quality import violation
from torchgco.native.called import CalledInterior
from torchgco.native.interior import InteriorKernels
from torchgco.native.kept_problem import KeptDescent
from torchgco.problem.problem import Problem


class Judged(NamedTuple):
    """What is found along trajectories with their multipliers, for the verdict on them."""

    step: BackwardPass  # the backward pass on J_var + lam'c
    slack: Tensor  # (B,), see `Lagrangian.slack`
    worst: Tensor  # (B,): the largest violation
    sensitive: Tensor  # (B,) bool: whether rounding may decide where a rollout by PyTorch ends
    run: Callable[[Tensor], BackwardPass]  # the backward pass for regularisations mu_r (B,)


class Kernels:
    """Everything that solvers compute with, for the problems of one form.

    Here in PyTorch; `kernels.in_c.NativeKernels` computes the same in C, up to rounding. `kernels.choice.kernels_of`
    chooses once per form of problems. Trajectories are X (B, N+1, n), U (B, N, m).

    Attributes:
        name: "native" or "pytorch", as solutions and tables say it.
        compiled: the problem's functions are compiled from a trace: all that is asked of them works, in any precision,
            without autodiff and its memory; they may differ from the user's code.
        affine: whether the dynamics are known to be affine in states and controls.
    """

    name = "pytorch"
    compiled = False
    affine = False

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        """X from the problem's start and controls U."""
        return rollout.open_loop(problem.dynamics, problem.x0, U)

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        """The rollout of U + K (x - X) from the first knots of X; gains K (B, N, m, n)."""
        G = torch.nn.functional.pad(K, (0, 1)).transpose(0, 1).contiguous()
        return rollout.closed_loop(problem.dynamics, X, U, G, torch.zeros_like(X[:, 0, 0]))

    def value(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """J_var (B,) and L_M (B,)."""
        return lagrangian.value(X, U)

    def begun(self, lagrangian: Lagrangian, U: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """X from the problem's start and controls U, J_var (B,) and L_M (B,)."""
        X = self.open_loop(lagrangian.problem, U)
        return X, *self.value(lagrangian, X, U)

    def scale(self, problem: Problem) -> None:
        """Have the problem keep its `cost_scale`, where that can be computed without autodiff."""

    def violation(self, problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
        """The largest violation (B,), of all constraints or of `obstacles` alone (geometric ones)."""
        return violation(problem.geometric if obstacles else problem.constraints, X, U)

    def chord_clearance(self, problem: Problem, X: Tensor, share: float | None) -> Tensor:
        """See `kernels.chord_clearance`."""
        return clearance_of(problem.distances, X, share)

    def rolled_out(self, problem: Problem, X: Tensor, U: Tensor, gains: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `kernels.rolled_out`."""
        K = gains[..., :-1].nan_to_num(0.0, 0.0, 0.0)
        rollout = self.closed_loop(problem, X, U, K)
        rows = (~_is_rounding(X, rollout[0])).nonzero().flatten()
        if rows.numel() > 0:
            alone = self.closed_loop(problem.take(rows), X[rows], U[rows], torch.zeros_like(K[rows]))
            better = _is_rounding(X[rows], alone[0])
            for whole, single in zip(rollout, alone, strict=True):
                whole[rows[better]] = single[better]
        return *rollout, self.violation(problem, *rollout)

    def judged(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Judged:
        """What a verdict on trajectories needs."""
        problem = lagrangian.problem
        F, H = linearise(problem, X, U), lagrangian.expand_optimality(X, U)
        run, worst = partial(backward, F, H), self.violation(problem, X, U)
        step = run(torch.zeros_like(worst))
        return Judged(step, lagrangian.slack(X, U), worst, torch.zeros_like(worst, dtype=torch.bool), run)

    def descend(self, lagrangian: Lagrangian, s: InnerState, how: Descent, limit: int, begins: bool = False) -> PassEnd:
        """Iterations of every problem's inner solve, in place: one at least, `limit` at most.

        Where they are `compiled` also the beginning: of `s` only the first states and U are then read.
        """
        return iterate(how, s, lagrangian)

    def kept_descent(self, problem: Problem, how: Descent, phr: bool) -> KeptDescent | None:
        """Inner solves of problems that stay packed; None: the caller makes them from `descend`."""
        return None

    def outer_passes(self, problem: Problem, s: State, how: Descent, **limits: Any) -> NativeOuter | None:
        """Whole passes of the outer loop; None: the caller makes them from `descend`."""
        return None

    def interior(self, problem: Problem) -> InteriorKernels:
        """The interior point, in C here, too.

        Raises:
            InputError: rows that join knots.
            NativeError: no compiler.
        """
        known = problem.known
        if known.interior is None:
            known.interior = CalledInterior(problem)
        return known.interior

    def sample(self, problem: Problem, U: Tensor, how: sampling.Sampling) -> Tensor:
        """Controls (B, N, m): the weighted mean of the last round's samples, the first drawn around U."""
        return sampling.sample(problem, U, how)


def _is_rounding(old: Tensor, new: Tensor) -> Tensor:
    """Whether trajectories (B, N+1, n) are one, up to rounding along the stages, (B,)."""
    most = ROUNDINGS * torch.finfo(old.dtype).eps * old.abs().amax(1, keepdim=True)
    return ((new - old).abs() <= most).flatten(1).all(-1)


def clearance_of(parts: Sequence[Any], X: Tensor, share: float | None, least: Tensor | None = None) -> Tensor:
    """Smallest distance (B,) from the lines between knots to parts that keep a distance, or `least`."""
    least = X.new_full(X.shape[:1], torch.inf) if least is None else least
    for row in parts:
        away = row.chord_clearance(X) if share is None else row.chord_clearance(X, share)
        least = torch.minimum(least, away)
    return least
