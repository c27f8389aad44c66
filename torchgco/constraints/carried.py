"""What solvers carry from knot to knot as further states, so that rows of several knots are rows of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.tree import PerElement


class Carrying(PerElement):
    """How r further states change over a stage."""

    @property
    def by_stage(self) -> bool:
        """Whether they change in another way at another stage."""
        raise NotImplementedError

    def __len__(self) -> int:
        raise NotImplementedError

    def after(
        self, x: Tensor, u: Tensor, carried: Tensor, k: int | Tensor | None, model: Any, pace: Tensor | None = None
    ) -> Tensor:
        """The further states after a stage k, or stages k (K,), from x (..., n), u (..., m) and those before it.

        Args:
            model: of the stage, with the first n states.
            pace: (..., 1), how many times as long as dt the stage is, where the time is free; None: once.
        """
        raise NotImplementedError

    def along(self, start: Tensor, X: Tensor, U: Tensor, model: Any, pace: Tensor | None = None) -> Tensor:
        """The further states (B, N+1, r) of trajectories X (B, N+1, n), U (B, N, m) from `start` (B, r).

        Args:
            model: of all stages together.
            pace: as of `after`, (B, N, 1).
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Taken(Carrying):
    """After some stages they are components of that stage's [x, u], else as before."""

    components: Tensor  # (r,) int64
    stages: Tensor | None = None  # (N, r): 1 where they are taken, else 0; None: after every stage

    by_stage = property(lambda self: self.stages is not None)  # type: ignore[assignment]

    def __len__(self) -> int:
        return len(self.components)

    def after(
        self, x: Tensor, u: Tensor, carried: Tensor, k: int | Tensor | None, model: Any, pace: Tensor | None = None
    ) -> Tensor:
        new = torch.cat((x, u), dim=-1)[..., self.components]
        if self.stages is None:
            return new
        taken = self.stages[k]
        return taken * new + (1.0 - taken) * carried

    def along(self, start: Tensor, X: Tensor, U: Tensor, model: Any, pace: Tensor | None = None) -> Tensor:
        k = torch.arange(U.shape[1], device=U.device)
        each = torch.cat((start.unsqueeze(1), torch.cat((X[:, :-1], U), dim=-1)[..., self.components]), dim=1)
        if self.stages is None:
            return each
        last = torch.where(self.stages > 0, k.unsqueeze(-1) + 1, 0).cummax(0).values  # knots of `each`
        last = torch.cat((torch.zeros_like(last[:1]), last)).expand(len(X), -1, -1)
        return each.gather(1, last)


@dataclass(frozen=True)
class Several(Carrying):
    """Further states of several kinds, one after the other."""

    parts: tuple[Carrying, ...]

    batched: ClassVar[tuple[str, ...]] = ("parts",)

    by_stage = property(lambda self: any(part.by_stage for part in self.parts))  # type: ignore[assignment]

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def after(
        self, x: Tensor, u: Tensor, carried: Tensor, k: int | Tensor | None, model: Any, pace: Tensor | None = None
    ) -> Tensor:
        pairs = zip(self.parts, carried.split([len(part) for part in self.parts], -1), strict=True)
        return torch.cat([part.after(x, u, before, k, model, pace) for part, before in pairs], dim=-1)

    def along(self, start: Tensor, X: Tensor, U: Tensor, model: Any, pace: Tensor | None = None) -> Tensor:
        pairs = zip(self.parts, start.split([len(part) for part in self.parts], -1), strict=True)
        return torch.cat([part.along(first, X, U, model, pace) for part, first in pairs], dim=-1)


@dataclass(frozen=True)
class Carried:
    """Further states of solvers, and what they are at first."""

    start: Tensor  # (B|1, r), at knot 0
    taken: Carrying

    def along(self, X: Tensor, U: Tensor, model: Any, pace: Tensor | None = None) -> Tensor:
        """The further states (B, N+1, r) of trajectories; arguments are those of `Carrying.along`."""
        return self.taken.along(self.start.expand(len(X), -1), X, U, model, pace)


def joined(parts: Sequence[Carried], B: int, N: int) -> Carried:
    """The states of several, of B problems with N stages, one after the other."""
    start = torch.cat([carried.start.expand(B, -1) for carried in parts], dim=-1)
    kinds = [carried.taken for carried in parts]
    each = [taken for taken in kinds if isinstance(taken, Taken)]
    if len(each) < len(kinds):
        return Carried(start, kinds[0] if len(kinds) == 1 else Several(tuple(kinds)))
    stages = None
    if any(taken.stages is not None for taken in each):
        stages = [start.new_ones(N, len(taken)) if taken.stages is None else taken.stages for taken in each]
        stages = torch.cat(stages, dim=-1)
    return Carried(start, Taken(torch.cat([taken.components for taken in each]), stages))
