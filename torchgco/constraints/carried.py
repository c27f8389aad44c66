"""What solvers carry from knot to knot as further states, so that rows of two knots are rows of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Taken:
    """How r further states change: after some stages they are components of that stage's [x, u], else as before."""

    components: Tensor  # (r,) int64
    stages: Tensor | None = None  # (N, r): 1 where they are taken, else 0; None: after every stage

    def __len__(self) -> int:
        return len(self.components)

    def after(self, x: Tensor, u: Tensor, carried: Tensor, k: int | Tensor | None) -> Tensor:
        """The further states after a stage k, or stages k (K,), from x (..., n), u (..., m) and those before it."""
        new = torch.cat((x, u), dim=-1)[..., self.components]
        if self.stages is None:
            return new
        taken = self.stages[k]
        return taken * new + (1.0 - taken) * carried


@dataclass(frozen=True)
class Carried:
    """Further states of solvers, and what they are at first."""

    start: Tensor  # (B|1, r), at knot 0
    taken: Taken

    def along(self, X: Tensor, U: Tensor) -> Tensor:
        """The further states (B, N+1, r) of trajectories X (B, N+1, n), U (B, N, m)."""
        taken, k = self.taken, torch.arange(U.shape[1], device=U.device)
        first = self.start.expand(len(X), -1).unsqueeze(1)
        each = torch.cat((first, torch.cat((X[:, :-1], U), dim=-1)[..., taken.components]), dim=1)
        if taken.stages is None:
            return each
        last = torch.where(taken.stages > 0, k.unsqueeze(-1) + 1, 0).cummax(0).values  # knots of `each`
        last = torch.cat((torch.zeros_like(last[:1]), last)).expand(len(X), -1, -1)
        return each.gather(1, last)


def joined(parts: Sequence[Carried], B: int, N: int) -> Carried:
    """The states of several, of B problems with N stages, one after the other."""
    start = torch.cat([carried.start.expand(B, -1) for carried in parts], dim=-1)
    each, stages = [carried.taken for carried in parts], None
    if any(taken.stages is not None for taken in each):
        stages = [start.new_ones(N, len(taken)) if taken.stages is None else taken.stages for taken in each]
        stages = torch.cat(stages, dim=-1)
    return Carried(start, Taken(torch.cat([taken.components for taken in each]), stages))
