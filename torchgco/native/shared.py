"""The numbers that all problems of a form share, which C reads beside those of each problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.native.codegen.cost import CostSource
from torchgco.native.codegen.dynamics import DynamicsSource
from torchgco.native.codegen.knot import KnotSource


@dataclass(frozen=True)
class Shared:
    """Such numbers as they were when they were read, (s,) float64 of each function."""

    model: Tensor
    cost: tuple[Tensor, Tensor]  # of stages, and of the last knot
    rows: Mapping[int, Tensor]  # of constraints, by their place

    @property
    def _all(self) -> tuple[Tensor, ...]:
        return self.model, *self.cost, *self.rows.values()

    def take_over(self, other: Shared) -> bool:
        """Write the numbers of another one of the same form into this one's memory; whether any differ."""
        pairs = [(old, new) for old, new in zip(self._all, other._all, strict=True) if not torch.equal(old, new)]
        for old, new in pairs:
            old.copy_(new)
        return bool(pairs)

    def is_same(self, other: Shared) -> bool:
        return all(torch.equal(*pair) for pair in zip(self._all, other._all, strict=True))


def read(model: DynamicsSource, cost: CostSource | None, functions: Mapping[int, KnotSource]) -> Shared | None:
    """The numbers of these functions as they are now; None where a function is to be traced again."""
    traces = [model.traced, *(part.span.traced for part in (() if cost is None else cost.parts))]
    traces += [rows.span.traced for rows in functions.values()]
    found = list[Tensor]()
    for traced in traces:
        numbers = traced.shared_numbers()
        if numbers is None:
            return None
        found.append(numbers)
    own, *others = found
    none = torch.zeros(0, dtype=torch.float64)
    of_cost = (none, none) if cost is None else (others.pop(0), others.pop(0))
    return Shared(own, of_cost, dict(zip(functions, others, strict=True)))
