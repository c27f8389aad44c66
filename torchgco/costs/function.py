"""A cost given as functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions
from torchgco.base.values import asks_for_knot, bound_values
from torchgco.costs.base import Cost


@dataclass(frozen=True)
class FunctionCost(Cost):
    """A cost given as functions; derivatives by PyTorch.

        cost = FunctionCost(
            lambda x, u, goal: (x[..., :2] - goal).square().sum(-1) + 0.1 * u.square().sum(-1),
            lambda x, goal: 50.0 * (x[..., :2] - goal).square().sum(-1),
            values={"goal": goals},  # (B, 2)
        )

    Numbers that change from solve to solve belong into `values`, or in captured tensors: with another captured Python
    number the code is compiled again. A solver looks for paths among obstacles only where it knows the goal: pass
    `goal` to `Problem`.

    Args:
        stage_function: function(x, u) of (..., n), (..., m) to costs (...); may take an argument k (without a
            default), the number of the stage, or arange(N) where x is (B, N, n).
        terminal_function: function(x) of the last knot to costs (...), which may take k = N; None: no terminal cost.
        values: numbers per problem by name, (B, ...), which the functions take as arguments of these names, shaped to
            fit x: (B, ...), or (B, 1, ...) where x has an axis of knots or samples.
        knot_values: the same per knot, (B|1, N+1, ...); a function sees the rows of its knots.

    Raises:
        InputError: on `Problem(...)`: no functions, values of another shape or that no function takes; costs of another
            shape, that depend on other problems, or whose derivatives are wrong.
    """

    stage_function: Callable[..., Tensor]
    terminal_function: Callable[..., Tensor] | None = None
    values: Any = None
    knot_values: Any = None

    batched: ClassVar[tuple[str, ...]] = ("values",)
    calls_function: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        if not callable(self.stage_function):
            raise InputError("cost.stage_function", "a function of x and u", shown(self.stage_function))
        if self.terminal_function is not None and not callable(self.terminal_function):
            raise InputError("cost.terminal_function", "a function of x, or None", shown(self.terminal_function))
        functions = self.stage_function, self.terminal_function
        return replace(self, values=bound_values(self.values, self.knot_values, functions, dims, "cost"))

    @property
    def reads_knots(self) -> bool:
        """Whether the cost of a stage takes its number, or values of it."""
        return bool(self.values.knot_names) or asks_for_knot(self.stage_function)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self.values.call(self.stage_function, x, u, k=k)

    def terminal(self, x: Tensor) -> Tensor:
        if self.terminal_function is None:
            return x.new_zeros(x.shape[:-1])
        return self.values.call(self.terminal_function, x, k=self.values.stages)

    def names_by_stage(self) -> set[str]:
        return set(self.values.knot_names)
