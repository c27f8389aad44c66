"""The forward pass: step lengths tried in parallel (Algorithm 2, lines 14-24).

The first rung of the ladder is tried for all problems. Only problems that refuse it try the other rungs, several in
parallel. A problem accepts the first rung that fits, as if it had tried one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Checked, Natural
from torchgco.dynamics.rollout import closed_loop
from torchgco.ilqr.riccati import BackwardPass
from torchgco.lagrangian.lagrangian import Lagrangian

SIDE_BY_SIDE = 256  # rollouts that cost little more than one
PARALLEL = 4  # least number of rungs tried together, by problems that refused the first


@dataclass(frozen=True)
class Rollouts:
    """One rollout per problem with its cost and L_M."""

    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    cost: Tensor  # (B,): J_var
    merit: Tensor  # (B,): L_M
    alpha: Tensor  # (B,): step length
    accepted: Tensor  # (B,) bool


@dataclass(frozen=True)
class LineSearch(Checked, named="line_search"):
    """Backtracking on the ratio of actual to expected change of L_M, with the constants of the paper.

    Args:
        back: the next search begins this many rungs above the last accepted one, which spares rollouts and shortens
            steps; None: each search begins with a full step.

    Raises:
        InputError: a field out of its range.
    """

    back: Natural | None = None

    shrink: ClassVar[float] = 0.5  # phi, factor from one step length to the next
    ratio_min: ClassVar[float] = 1e-4  # accepted range of the ratio
    ratio_max: ClassVar[float] = 10.0
    smallest: ClassVar[float] = 1e-4  # no shorter step is tried, but for one as printed: the first below this

    def ladder(self, accept_last: bool) -> list[float]:
        """See `rungs_of`."""
        return rungs_of(self.shrink, self.smallest, accept_last)

    def search(
        self,
        lagrangian: Lagrangian,
        X: Tensor,
        U: Tensor,
        merit: Tensor,
        step: BackwardPass,
        rung: Tensor,
        accept_last: bool,
    ) -> Rollouts:
        """The first acceptable rollout of each problem, from X, U with L_M = merit (B,), by the ladder from `rung`.

        Where no rung is acceptable: with `accept_last` (as printed) the last one is accepted if its L_M is finite, else
        `accepted` is False, alpha is 0, and the rollout is not to be used.
        """
        ladder = merit.new_tensor(self.ladder(accept_last))
        rollouts = self._try(lagrangian, X, U, merit, step, ladder[rung], accept_last)
        rungs = list(range(1, len(ladder)))
        while rungs:
            refused = (~rollouts.accepted & (rung + rungs[0] < len(ladder))).nonzero().flatten()
            if refused.numel() == 0:
                break
            width = max(PARALLEL, SIDE_BY_SIDE // refused.numel())
            chunk, rungs = rungs[:width], rungs[width:]
            rows = refused.repeat_interleave(len(chunk))
            places = rung[rows] + torch.tensor(chunk, device=rung.device).repeat(refused.numel())
            alpha = ladder[places.clamp(max=len(ladder) - 1)]  # trying the last rung twice does no harm
            repeats = BackwardPass(step.gains[:, rows], *(t[rows] for t in step[1:]))
            tried = self._try(lagrangian.take(rows), X[rows], U[rows], merit[rows], repeats, alpha, accept_last)
            rollouts = self._first_accepted(rollouts, tried, refused, len(chunk))
        return replace(rollouts, alpha=torch.where(rollouts.accepted, rollouts.alpha, 0.0))

    def next_rung(self, rollouts: Rollouts, accept_last: bool) -> Tensor:
        """The first rung of the next search of each problem, (B,) int64: 0 after one that found nothing."""
        ladder = self.ladder(accept_last)
        landed = (rollouts.alpha.unsqueeze(-1) == rollouts.alpha.new_tensor(ladder)).to(torch.int8).argmax(-1)
        back = len(ladder) if self.back is None else self.back
        return torch.where(rollouts.accepted, (landed - back).clamp(min=0), 0)

    def _try(
        self,
        lagrangian: Lagrangian,
        X: Tensor,
        U: Tensor,
        merit: Tensor,
        step: BackwardPass,
        alpha: Tensor,
        accept_last: bool,
    ) -> Rollouts:
        new_X, new_U = closed_loop(lagrangian.problem.dynamics, X, U, step.gains, alpha)
        cost, value = lagrangian.value(new_X, new_U)
        ratio = (value - merit) / step.expected_change(alpha)
        accepted = (ratio >= self.ratio_min) & (ratio <= self.ratio_max)
        if accept_last:
            accepted = accepted | (alpha < self.smallest)
        return Rollouts(new_X, new_U, cost, value, alpha, accepted & torch.isfinite(value))

    @staticmethod
    def _first_accepted(rollouts: Rollouts, tried: Rollouts, refused: Tensor, rungs: int) -> Rollouts:
        """Write the first accepted rung of each problem that refused the first into a copy of `rollouts`."""
        ok = tried.accepted.view(-1, rungs)
        rung = ok.to(torch.int8).argmax(dim=1)  # the first True
        pick = torch.arange(refused.numel(), device=refused.device) * rungs + rung
        won = ok.any(dim=1)
        target, source = refused[won], pick[won]
        merged = {}
        for name in ("X", "U", "cost", "merit", "alpha", "accepted"):
            merged[name] = getattr(rollouts, name).clone()
            merged[name][target] = getattr(tried, name)[source]
        return Rollouts(**merged)


def rungs_of(shrink: float, smallest: float, accept_last: bool) -> list[float]:
    """1, phi, phi^2, ... down to `smallest`, and with `accept_last` the first one below."""
    rungs = [1.0]
    while rungs[-1] >= smallest:
        rungs.append(rungs[-1] * shrink)
    return rungs if accept_last else rungs[:-1]
