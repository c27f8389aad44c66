"""Trajectories in free time as guesses for the same problems a while later, when a part of them is over."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.problem.in_time import times_of
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Elapsed:
    """Where the knots of what is left of trajectories lie on these.

    Attributes:
        factors: of what is left, within the bounds, (B, S).
        place: of each knot among the knots of before, (B, N+1), from 0 to N.
        lengths: of its stage, as a multiple of the length of the one that it lies in, (B, N+1).
    """

    factors: Tensor
    place: Tensor
    lengths: Tensor

    @classmethod
    def of(cls, problem: Problem, factors: Tensor, seconds: float) -> Elapsed:
        """That of problems with a free time, of trajectories with factors (B, S), so many seconds later.

        The knots of the segment that is under way, and of those before, lie evenly from now to its end; later segments
        last as long as before.
        """
        time = problem.time
        assert time is not None
        firsts, dt, N = [*time.segments, problem.N], float(problem.dynamics.dt), problem.N
        sizes = factors.new_tensor([b - a for a, b in itertools.pairwise(firsts)])
        ends = (dt * sizes * factors).cumsum(-1)
        under_way = (ends <= seconds).sum(-1, keepdim=True).clamp(max=time.count - 1)
        even = (ends.gather(1, under_way) - seconds).clamp(min=0.0) / (dt * sizes.cumsum(0)[under_way])
        left = torch.where(torch.arange(time.count, device=factors.device) <= under_way, even, factors)
        old, new = times_of(problem, factors), seconds + times_of(problem, left)
        k = (torch.searchsorted(old, new, right=True) - 1).clamp(0, N - 1)
        stage = old.diff(dim=1)
        index = k + ((new - old.gather(1, k)) / stage.gather(1, k)).clamp(0.0, 1.0)
        durations = new.diff(dim=1)
        lengths = torch.cat((durations, durations[:, -1:]), dim=1) / stage.gather(1, k)
        return cls(left.clamp(time.least, time.most), index, lengths)

    def states(self, X: Tensor) -> Tensor:
        """Those (B, N+1, n) at the knots of what is left, on straight lines between X (B, N+1, n)."""
        return _between(X, self.place)

    def controls(self, U: Tensor, stages: Tensor) -> Tensor:
        """The means (B, N, m) of controls U (B, N, m), whose `stages` (B, N) lasted, s, over those of what is left."""
        added = (U * stages.unsqueeze(-1)).cumsum(1)
        added = torch.cat((torch.zeros_like(added[:, :1]), added), dim=1)
        over = torch.cat((torch.zeros_like(stages[:, :1]), stages.cumsum(1)), dim=1).unsqueeze(-1)
        lasts = _between(over, self.place).diff(dim=1)
        first = self.place[:, :-1].floor().clamp(max=U.shape[1] - 1).long().unsqueeze(-1).expand(-1, -1, U.shape[-1])
        means = _between(added, self.place).diff(dim=1) / torch.where(lasts > 0, lasts, 1.0)
        return torch.where(lasts > 0, means, U.gather(1, first))

    def multipliers(self, lam: Sequence[Tensor], knots: Sequence[Sequence[int]]) -> tuple[Tensor, ...]:
        """Multipliers (B, K, p) of rows at these knots: where the knots follow each other those of the same times, as
        they are of the lengths of the stages; elsewhere as before."""
        return tuple(self._along(values, indices) for values, indices in zip(lam, knots, strict=True))

    def _along(self, lam: Tensor, indices: Sequence[int]) -> Tensor:
        if len(indices) < 2 or lam.shape[2] == 0 or list(indices) != list(range(indices[0], indices[0] + len(indices))):
            return lam
        rows = slice(indices[0], indices[-1] + 1)
        index = (self.place[:, rows] - indices[0]).clamp(0.0, len(indices) - 1.0)
        return self.lengths[:, rows].unsqueeze(-1) * _between(lam, index)


def _between(values: Tensor, index: Tensor) -> Tensor:
    """Values (B, K, ...) at places (B, L) within 0..K-1, on straight lines."""
    k = index.floor().long().clamp(0, max(0, values.shape[1] - 2))
    share = (index - k).unsqueeze(-1)
    low, high = (values.gather(1, i.unsqueeze(-1).expand(-1, -1, values.shape[-1])) for i in (k, k + 1))
    return torch.lerp(low, high, share)
