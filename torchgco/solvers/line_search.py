"""The forward pass: step lengths tried in parallel (Algorithm 2, lines 14-24).

The first rung is tried for everyone; only those that refuse it try the rest of the ladder, a few at a time and side by
side. What an element accepts is the first rung that fits, as if it had tried one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.errors import InputError
from torchgco.lagrangian import Lagrangian
from torchgco.rollout import closed_loop
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
        parallel: rungs that those who refused the first try side by side, at least. More where few refused: rolling
            out some dozens of trajectories costs what one costs.
        back: rungs above the last accepted one at which the next search begins, which spares rollouts and shortens
            steps; None: each begins with a full step (as printed).

    Raises:
        InputError: a field out of its range.
    """

    shrink: float = 0.5
    ratio_min: float = 1e-4
    ratio_max: float = 10.0
    smallest: float = 1e-4
    accept_last: bool = True
    parallel: int = 4
    back: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.shrink < 1:
            raise InputError("line_search.shrink", "a factor between 0 and 1", self.shrink)
        if not 0 < self.ratio_min < self.ratio_max:
            raise InputError("line_search.ratio_min", f"between 0 and ratio_max {self.ratio_max}", self.ratio_min)
        if not 0 < self.smallest < 1:
            raise InputError("line_search.smallest", "between 0 and 1", self.smallest)
        if self.parallel < 1:
            raise InputError("line_search.parallel", "at least 1", self.parallel)
        if self.back is not None and self.back < 0:
            raise InputError("line_search.back", "at least 0, or null", self.back)

    @property
    def ladder(self) -> list[float]:
        """1, phi, phi^2, ... down to the first below `smallest` (left out where it is never taken)."""
        rungs = [1.0]
        while rungs[-1] >= self.smallest:
            rungs.append(rungs[-1] * self.shrink)
        return rungs if self.accept_last else rungs[:-1]

    def search(
        self, lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor, step: BackwardPass, rung: Tensor
    ) -> Candidates:
        """The first acceptable trajectory of each element, from X, U with L_M = merit (B,), by the ladder from `rung`.

        Where there is none, `accepted` is False, alpha is 0, and the trajectory is not to be used.
        """
        ladder = merit.new_tensor(self.ladder)
        found = self._try(lagrangian, X, U, merit, step, ladder[rung])
        rungs = list(range(1, len(ladder)))
        while rungs:
            refused = (~found.accepted & (rung + rungs[0] < len(ladder))).nonzero().flatten()
            if refused.numel() == 0:
                break
            width = max(self.parallel, SIDE_BY_SIDE // refused.numel())
            chunk, rungs = rungs[:width], rungs[width:]
            rows = refused.repeat_interleave(len(chunk))
            places = rung[rows] + torch.tensor(chunk, device=rung.device).repeat(refused.numel())
            alpha = ladder[places.clamp(max=len(ladder) - 1)]  # the last one once more does no harm
            part = BackwardPass(step.gains[:, rows], *(t[rows] for t in step[1:]))
            tried = self._try(lagrangian.take(rows), X[rows], U[rows], merit[rows], part, alpha)
            found = self._first_accepted(found, tried, refused, len(chunk))
        return replace(found, alpha=torch.where(found.accepted, found.alpha, 0.0))

    def next_rung(self, found: Candidates) -> Tensor:
        """At which the next search of each element begins, (B,) int64; the first after one that found nothing."""
        landed = (found.alpha.unsqueeze(-1) == found.alpha.new_tensor(self.ladder)).to(torch.int8).argmax(-1)
        back = len(self.ladder) if self.back is None else self.back
        return torch.where(found.accepted, (landed - back).clamp(min=0), 0)

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
