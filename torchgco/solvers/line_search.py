"""The forward pass: step lengths tried in parallel (Algorithm 2, lines 14-24).

alpha = 1 is tried for everyone; only those that refuse it try the rest of the ladder, a few rungs at a time and side by
side. What an element accepts is the first rung that fits, as if it had tried one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.lagrangian import Lagrangian
from torchgco.rollout import closed_loop
from torchgco.shapes import InputError
from torchgco.solvers.riccati import BackwardPass

SIDE_BY_SIDE = 256  # trajectories that cost little more than one


@dataclass(frozen=True)
class Candidates:
    """One trajectory per element and what it is worth."""

    X: Tensor
    U: Tensor
    cost: Tensor
    merit: Tensor
    alpha: Tensor
    accepted: Tensor  # (B,) bool


@dataclass(frozen=True)
class LineSearch:
    """Backtracking on the ratio of actual to expected change of L_M.

    Args:
        shrink: phi, factor from one step length to the next.
        ratio_min, ratio_max: accepted range of the ratio.
        smallest: step lengths end with the first one below this.
        accept_last: take that last one whatever it does to L_M (as printed), rather than no step at all.
        parallel: rungs that those who refused alpha = 1 try side by side, at least. More where few refused: rolling
            out some dozens of trajectories costs what one costs.

    Raises:
        InputError: a field out of its range.
    """

    shrink: float = 0.5
    ratio_min: float = 1e-4
    ratio_max: float = 10.0
    smallest: float = 1e-4
    accept_last: bool = True
    parallel: int = 4

    def __post_init__(self) -> None:
        if not 0 < self.shrink < 1:
            raise InputError("line_search.shrink", "a factor between 0 and 1", self.shrink)
        if not 0 < self.ratio_min < self.ratio_max:
            raise InputError("line_search.ratio_min", f"between 0 and ratio_max {self.ratio_max}", self.ratio_min)
        if not 0 < self.smallest < 1:
            raise InputError("line_search.smallest", "between 0 and 1", self.smallest)
        if self.parallel < 1:
            raise InputError("line_search.parallel", "at least 1", self.parallel)

    @property
    def ladder(self) -> list[float]:
        """1, phi, phi^2, ... down to the first below `smallest` (left out where it is never taken)."""
        rungs = [1.0]
        while rungs[-1] >= self.smallest:
            rungs.append(rungs[-1] * self.shrink)
        return rungs if self.accept_last else rungs[:-1]

    def search(self, lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor, step: BackwardPass) -> Candidates:
        """The first acceptable trajectory of each element, from X, U with L_M = merit (B,).

        Where there is none, `accepted` is False, alpha is 0, and the trajectory is not to be used.
        """
        found = self._try(lagrangian, X, U, merit, step, torch.ones_like(merit))
        rungs = self.ladder[1:]
        while rungs:
            refused = (~found.accepted).nonzero().flatten()
            if refused.numel() == 0:
                break
            width = max(self.parallel, SIDE_BY_SIDE // refused.numel())
            chunk, rungs = rungs[:width], rungs[width:]
            rows = refused.repeat_interleave(len(chunk))
            alpha = merit.new_tensor(chunk).repeat(refused.numel())
            part = BackwardPass(step.gains[:, rows], *(t[rows] for t in step[1:]))
            tried = self._try(lagrangian.take(rows), X[rows], U[rows], merit[rows], part, alpha)
            found = self._first_accepted(found, tried, refused, len(chunk))
        return replace(found, alpha=torch.where(found.accepted, found.alpha, 0.0))

    def _try(
        self, lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor, step: BackwardPass, alpha: Tensor
    ) -> Candidates:
        new_X, new_U = closed_loop(lagrangian.problem.dynamics, X, U, step.gains, alpha)
        cost, value = lagrangian.value(new_X, new_U)
        ratio = (value - merit) / step.expected_change(alpha)
        accepted = (ratio >= self.ratio_min) & (ratio <= self.ratio_max)
        if self.accept_last:
            accepted = accepted | (alpha < self.smallest)
        return Candidates(new_X, new_U, cost, value, alpha, accepted & torch.isfinite(value))

    @staticmethod
    def _first_accepted(found: Candidates, tried: Candidates, refused: Tensor, rungs: int) -> Candidates:
        """Write the first accepted rung of each refused element into a copy of `found`."""
        ok = tried.accepted.view(-1, rungs)
        rung = ok.to(torch.int8).argmax(dim=1)  # the first True
        pick = torch.arange(refused.numel(), device=refused.device) * rungs + rung
        won = ok.any(dim=1)
        target, source = refused[won], pick[won]
        merged = {}
        for name in ("X", "U", "cost", "merit", "alpha", "accepted"):
            merged[name] = getattr(found, name).clone()
            merged[name][target] = getattr(tried, name)[source]
        return Candidates(**merged)
