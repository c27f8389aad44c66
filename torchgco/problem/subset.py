"""Problems of a batch that know it: parts are taken when they are asked for, and nothing is found again."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.tree import Rows, is_users, take
from torchgco.constraints.base import Distance

OF_BATCH = "dynamics", "cost", "constraints"  # what a subset takes of its batch when it is asked for
ITS_OWN = "x0", "goal", "horizon", "free_start", "time"


class Subset:
    """Mixin of `Problem`, which may be some problems of a batch.

    Attributes:
        derived: what was computed from these very parts, by name; a problem made of others has what its maker hands on,
            else none.
        part_of: the batch that these are some problems of, and which, int64 (B,); None: they are no subset.
    """

    derived: ClassVar[dict[str, Any]]
    part_of: ClassVar[tuple[Any, Tensor] | None] = None
    B: Any
    x0: Any
    dynamics: Any
    cost: Any
    constraints: Any

    def subset(self, index: Rows) -> Self:
        """The problems in `index` (int64, (B',), or a slice)."""
        rows = torch.arange(self.B, device=self.x0.device)[index] if isinstance(index, slice) else index.clone()
        batch, rows = (self, rows) if self.part_of is None else (self.part_of[0], self.part_of[1][rows])
        made = object.__new__(type(self))
        sizes = {name: getattr(self, name) for name in ("N", "n", "m", "known")}
        parts = ((name, getattr(self, name)) for name in ITS_OWN)
        numbers = {
            name: part if part is None else part[index] if isinstance(part, Tensor) else part.take(index)
            for name, part in parts
        }
        vars(made).update(numbers, **sizes, derived={}, part_of=(batch, rows))
        return made

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A part of a subset; kernels in C read those of the whole batch."""
            if name not in OF_BATCH or self.part_of is None:
                raise AttributeError(f"{type(self).__name__} has no attribute {name}")
            whole, rows = self.part_of
            vars(self)[name] = part = take(getattr(whole, name), rows)
            return part

    @cached_property
    def users(self) -> tuple[Any, ...]:
        """The parts whose code is a user's; of a subset those of the batch."""
        whole = self if self.part_of is None else self.part_of[0]
        return tuple(part for part in (*whole.constraints, whole.cost, whole.dynamics) if is_users(part))

    @cached_property
    def bends(self) -> bool:
        """Whether positions may leave the straight lines between their knots: by Euler's steps they don't."""
        return self.dynamics.stretches and self.dynamics.integrator != "euler"

    @cached_property
    def distances(self) -> tuple[Any, ...]:
        """The user's constraints that keep a distance, which is measured between knots, too."""
        return tuple(row for constraint in self.constraints if isinstance(row := constraint.bare, Distance))

    def derive(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` computes from this problem's parts, once; kept in `derived` under the name."""
        if name not in self.derived:
            self.derived[name] = make()
        return self.derived[name]

    def derive_rows(self, name: str, make: Callable[[Any], Any]) -> Any:
        """The same of what has a row per problem; of a subset the rows of what the batch has, or finds as soon."""
        if name not in self.derived and self.part_of is not None:
            batch, rows = self.part_of
            if name in batch.derived or batch.B <= self.B:
                found = batch.derive(name, lambda: make(batch))
                self.derived[name] = found.subset(rows) if isinstance(found, Subset) else take(found, rows)
        return self.derive(name, lambda: make(self))
