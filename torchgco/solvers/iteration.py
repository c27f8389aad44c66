"""Iterations of the inner solve (Algorithm 2) for all running elements: by PyTorch's kernels one, by native ones many.

Both leave the same state behind, up to rounding, and say the same of it; a test compares them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchgco.expansion import linearise
from torchgco.lagrangian import Lagrangian
from torchgco.native.dispatch import engine_of, terms_of
from torchgco.solvers.lifted import LOST, diverges, lifted_search, native_lifted_search
from torchgco.solvers.line_search import Candidates
from torchgco.solvers.riccati import BackwardPass, backward
from torchgco.solvers.state import InnerState
from torchgco.status import Status

if TYPE_CHECKING:
    from torchgco.solvers.ilqr import ILQR

ROUNDING = 1e-14  # share of L_M: an expected change below it means nothing


@dataclass(frozen=True)
class PassEnd:
    """What a pass says of every running element, (B,)."""

    ended: Tensor  # bool: its inner solve has ended
    converged: Tensor  # bool
    stuck: Tensor  # bool: no step length was acceptable, and no regularisation is left to try
    status: Tensor  # int64: RUNNING, or why the whole solve of the element ends here
    alpha: Tensor  # step length of the last iteration
    used: Tensor  # mu_r of it
    failed: Tensor  # bool: its backward pass failed, and no iteration was made


class NativeIterations:
    """Up to `limit` iterations of every element's inner solve in one call of the native library."""

    def __init__(self, inner: ILQR, limit: int) -> None:
        self.inner, self.limit = inner, limit

    def run(self, s: InnerState, lagrangian: Lagrangian) -> PassEnd:
        engine = engine_of(lagrangian.problem)
        assert engine is not None
        state = {}
        for name in ("X", "U", "cost", "merit", "regularisation", "inner", "iterations", "rung"):
            state[name] = getattr(s, name).clone(memory_format=torch.contiguous_format)
            setattr(s, name, state[name])
        options = self.inner.options(ROUNDING, LOST)
        out = engine.iterate(lagrangian.problem, state, terms_of(lagrangian), options, self.limit)
        converged, stuck, lost = (out[name] != 0 for name in ("converged", "refused", "lost"))
        ended, failed = out["status"] == 1, out["status"] > 1
        rows = lost.nonzero().flatten()
        if rows.numel() > 0:
            won = rows[lift(s, lagrangian, rows, native_lifted_search)]
            ended[won] = s.inner[won] >= self.inner.max_iterations
            s.regularisation[won] = 0.0
        status = torch.where(failed, out["status"].long(), int(Status.RUNNING))
        return PassEnd(ended, converged, stuck, status, out["alpha"], out["used"], failed)


class EagerIterations:
    """One iteration of every element by PyTorch's kernels: on a GPU, in single precision, and as the reference."""

    def __init__(self, inner: ILQR) -> None:
        self.inner = inner

    def run(self, s: InnerState, lagrangian: Lagrangian) -> PassEnd:
        problem, inner = lagrangian.problem, self.inner
        F, H = linearise(problem, s.X, s.U), lagrangian.expand(s.X, s.U)
        step = backward(F, H, s.regularisation)
        status = torch.full_like(s.rows, Status.RUNNING)
        expected = step.expected_change(torch.ones_like(s.merit)).abs()
        settled = expected <= ROUNDING * s.merit.abs()
        moving = ~step.failed & ~settled
        if bool(step.failed.any()):
            self._raise_regularisation(s, step, F, H, status)
        old_merit, alpha, refused = self._move(s, lagrangian, step, moving)
        refused = self._lift(s, lagrangian, step, refused)
        change, damped = (s.merit - old_merit).abs(), s.regularisation > inner.damping
        s.inner, s.iterations = s.inner + ~step.failed, s.iterations + ~step.failed
        used = s.regularisation
        s.regularisation = torch.where(step.failed, s.regularisation, self._damping(s, refused))
        stuck = refused & (s.regularisation == 0)
        flat = (torch.maximum(change, expected) <= inner.tolerance * s.merit.abs()) & ~damped
        converged = settled | (moving & ~refused & (flat | (change < inner.absolute_tolerance)))
        ended = ~step.failed & (converged | stuck | (s.inner >= inner.max_iterations))
        return PassEnd(ended, converged, stuck, status, alpha, used, step.failed)

    def _damping(self, s: InnerState, refused: Tensor) -> Tensor:
        """mu_r of the next pass (B,): zero as printed; with damping, up where the search failed and down elsewhere."""
        now, first = s.regularisation, self.inner.damping
        if first == 0:
            return torch.zeros_like(now)
        up, down = (10.0 * now).clamp(min=first), now / 3.0
        up = torch.where(up > self.inner.regularisation_max, 0.0, up)
        return torch.where(refused, up, torch.where(down < first, 0.0, down))

    def _raise_regularisation(self, s: InnerState, step: BackwardPass, F: Tensor, H: Tensor, status: Tensor) -> None:
        """mu_r up for elements whose Cholesky failed (Algorithm 2, line 9): they try again in the next pass."""
        inner = self.inner
        higher = (s.regularisation * inner.regularisation_growth).clamp(min=inner.regularisation_first)
        s.regularisation = torch.where(step.failed, higher, s.regularisation)
        finite = torch.isfinite(F).all(-1).all(-1).all(0) & torch.isfinite(H).all(-1).all(-1).all(0)
        status[step.failed & (s.regularisation > inner.regularisation_max)] = Status.NOT_POSITIVE_DEFINITE
        status[step.failed & ~finite] = Status.NON_FINITE

    def _move(
        self, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, moving: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Forward pass of the elements in `moving`; returns the merit before, the step lengths, and who was refused."""
        old_merit = s.merit
        alpha, refused = torch.zeros_like(old_merit), torch.zeros_like(moving)
        rows = moving.nonzero().flatten()
        if rows.numel() == 0:
            return old_merit, alpha, refused
        if rows.numel() == moving.numel():
            found = self.inner.line_search.search(lagrangian, s.X, s.U, s.merit, step, s.rung)
        else:
            part = BackwardPass(step.gains[:, rows], *(t[rows] for t in step[1:]))
            found = self.inner.line_search.search(
                lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows], part, s.rung[rows]
            )
        won = rows[found.accepted]
        for name in ("X", "U", "cost", "merit"):
            values = getattr(s, name).clone()
            values[won] = getattr(found, name)[found.accepted]
            setattr(s, name, values)
        s.rung = s.rung.index_copy(0, rows, self.inner.line_search.next_rung(found))
        alpha[rows] = found.alpha
        refused[rows] = ~found.accepted
        return old_merit, alpha, refused

    def _lift(self, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, refused: Tensor) -> Tensor:
        """Another search for elements whose rollouts diverge whatever the step length; returns who is still refused.

        In the first iteration of an inner solve alone: later on there are gains that have held the states.
        """
        inner = self.inner
        rows = (refused & (s.inner == 0)).nonzero().flatten()
        if inner.damping == 0 or rows.numel() == 0:
            return refused
        part, X, U, merit = lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows]
        lost = diverges(part, X, U, merit, step.gains[:, rows], inner.line_search.smallest).nonzero().flatten()
        refused = refused.clone()
        if lost.numel() > 0:
            refused[rows[lost][lift(s, lagrangian, rows[lost], lifted_search)]] = False
        return refused


def lift(s: InnerState, lagrangian: Lagrangian, rows: Tensor, search: Callable[..., Candidates]) -> Tensor:
    """Put what a lifted search finds in place of the iterates in `rows`; which of them it found something for."""
    found = search(lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows])
    won = rows[found.accepted]
    for name in ("X", "U", "cost", "merit"):
        getattr(s, name)[won] = getattr(found, name)[found.accepted]
    return found.accepted
