"""The numbers that all problems of a form share, which C reads beside those of each problem."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.native.codegen.cost import CostSource
from torchgco.native.codegen.dynamics import DynamicsSource
from torchgco.native.codegen.knot import KnotSource
from torchgco.tracing import Traced, contents


@dataclass(frozen=True)
class Shared:
    """Such numbers as they were when they were read, (s,) float64 of each function."""

    model: Tensor
    cost: tuple[Tensor, Tensor]  # of stages, and of the last knot
    rows: Mapping[int, Tensor]  # of constraints, by their place

    def copy(self) -> Shared:
        stage, last = self.cost
        rows = {i: numbers.clone() for i, numbers in self.rows.items()}
        return Shared(self.model.clone(), (stage.clone(), last.clone()), rows)

    def take_over(self, other: Shared) -> None:
        """Write the numbers of another one of the same form into this one's memory."""
        for old, new in zip(self._all, other._all, strict=True):
            old.copy_(new)

    def is_same(self, other: Shared) -> bool:
        return all(torch.equal(*pair) for pair in zip(self._all, other._all, strict=True))

    @property
    def _all(self) -> tuple[Tensor, ...]:
        return self.model, *self.cost, *self.rows.values()


class Captured:
    """What the functions of a form read from outside: tensors that they capture, weights of modules."""

    def __init__(self, model: DynamicsSource, cost: CostSource | None, functions: Mapping[int, KnotSource]) -> None:
        self._places, self._has_cost = tuple(functions), cost is not None
        self.traces: list[Traced] = [model.traced]
        self.traces += () if cost is None else (source.span.traced for source in cost.parts)
        self.traces += (rows.span.traced for rows in functions.values())
        self._outside = list({id(tensor): tensor for traced in self.traces for tensor in traced.outside}.values())
        self._last: tuple[tuple[Hashable, ...] | None, Shared | None] = None, None

    @property
    def is_mixed(self) -> bool:
        """Whether numbers that differ between problems depend on it, too."""
        return any(traced.is_mixed for traced in self.traces)

    @property
    def reads_own(self) -> bool:
        """Whether a function's code has read the numbers of a problem that others may not have."""
        return any(traced.reads_own for traced in self.traces)

    @property
    def nbytes(self) -> int:
        """The size of all these tensors, of sparse ones as if they were dense."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self._outside)

    def is_still(self, last: Shared | None) -> bool:
        """Whether `read` would give what it gave before, `last`; done without PyTorch's operations."""
        then, known = self._last
        return then is not None and last is known and contents(self._outside) == then

    def read(self) -> Shared | None:
        """The numbers as they are now, not to be written to; None where a function is to be traced again.

        The same object as at the last call where nothing has changed.
        """
        seen, (then, last) = contents(self._outside), self._last
        if seen is None or seen != then:
            last = self._read()
            self._last = seen, last  # seen before it was read: what changes meanwhile is read at the next call
        return last

    def _read(self) -> Shared | None:
        shared = list[Tensor]()
        for traced in self.traces:
            numbers = traced.shared_numbers()
            if numbers is None:
                return None
            shared.append(numbers)
        of_model, *others = shared
        of_cost = (others.pop(0), others.pop(0)) if self._has_cost else (of_model[:0], of_model[:0])
        return Shared(of_model, of_cost, dict(zip(self._places, others, strict=True)))
