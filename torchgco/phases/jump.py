"""What lies between two phases: the first state of the next one from the last of the one before, at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError, first_line, shown
from torchgco.base.gradients import is_recording
from torchgco.base.options import Natural, check_value
from torchgco.base.shapes import MISTAKES, Dimensions, describe
from torchgco.base.tree import PerElement
from torchgco.base.values import NO_VALUES, Values, bound_values
from torchgco.constraints.base import Constraint
from torchgco.constraints.link import Link
from torchgco.problem.given import bound
from torchgco.problem.joined import mixes_problems
from torchgco.problem.problem import Problem

ROWS = "rows of the controls, or of the state before and the controls; rows of a state are those of a phase's own knots"


@dataclass(frozen=True)
class Jump(PerElement):
    """x+ = function(x-) between two phases, or function(x-, v) with controls v that the solver chooses.

        bounce = Jump(lambda x: torch.stack((x[..., 0], -0.8 * x[..., 1]), -1))  # an impact
        burn = Jump(push, controls=2, cost=lambda x, v: v.norm(dim=-1))  # an impulse, at a time that phases may choose
        Jump(lambda x, v: v, controls=4, constraints=[rows])  # any x+ that keeps rows of x- and x+

    Args:
        function: of the last state (..., n) of a phase, and of v (..., m) where there are any, the first state of the
            next phase (..., n'). None: x+ = x-.
        controls: how many numbers v.
        cost: of x- and v, (...), beside those of the phases; None: 0.
        constraints: on v, as `ControlBounds` and `NormBounds("u")`, or on x- and v: `FunctionConstraint(of="xu")`.
        values: numbers per problem by name, (B, ...), which function and cost take as arguments of these names.

    Raises:
        InputError: on `Phases(...)`: a function or cost that returns another shape, or mixes problems; constraints that
            don't fit; a cost or constraints without controls.
    """

    function: Callable[..., Tensor] | None = None
    controls: int = 0
    cost: Callable[..., Tensor] | None = None
    constraints: Sequence[Constraint] = ()
    values: Any = None
    n: int = field(default=0, repr=False)  # states before, once bound

    batched: ClassVar[tuple[str, ...]] = ("constraints", "values")
    calls_function: ClassVar[bool] = True

    def bind(self, before: Problem, after: Problem, where: str) -> Jump:
        """The jump between two phases."""
        check_value(self.controls, Natural, f"{where}.controls")
        for name in ("function", "cost"):
            if (given := getattr(self, name)) is not None and not callable(given):
                raise InputError(f"{where}.{name}", "a function, or None", shown(given))
        if self.function is None and before.n != after.n:
            raise InputError(f"{where}.function", f"a function from {before.n} states to {after.n}", "None")
        if not isinstance(self.constraints, Sequence):
            raise InputError(f"{where}.constraints", "a list of constraints", shown(self.constraints))
        if self.controls == 0 and (self.cost is not None or self.constraints):
            raise InputError(f"{where}.controls", "at least 1 beside a cost or constraints", 0)
        dims = Dimensions(before.B, 1, before.n, self.controls, None, None, before.x0)
        rows = tuple(_row(row, dims, f"{where}.constraints[{i}]") for i, row in enumerate(self.constraints))
        values = bound_values(self.values, None, (self.function, self.cost), dims, where)
        jump = replace(self, constraints=rows, values=values, n=before.n)
        if not is_recording():  # it is the same as before
            jump._check(before, after, where)
        return jump

    def after(self, x: Tensor, v: Tensor) -> Tensor:
        """x+ (..., n') of x- (..., n) and v (..., m)."""
        if self.function is None:
            return x
        return self._values.call(self.function, x, *([v] if self.controls else []))

    def costs(self, x: Tensor, v: Tensor) -> Tensor:
        """The cost (...)."""
        return 0.0 * x[..., 0] if self.cost is None else self._values.call(self.cost, x, v)

    def violation(self, x: Tensor, v: Tensor) -> Tensor:
        """The largest violation (B,) of its rows at x- (B, n) with v (B, m)."""
        worst, X, U = torch.zeros_like(x[:, 0]), torch.stack((x, x), dim=1), v.unsqueeze(1)
        for row in self.constraints:
            worst = torch.maximum(worst, row.worst(X, U))
        return worst

    @property
    def _values(self) -> Values:
        return self.values or NO_VALUES

    def _check(self, before: Problem, after: Problem, where: str) -> None:
        """Try the functions on the guesses of the phases."""
        x, v = before.x0, before.x0.new_zeros(before.B, self.controls)
        for of, name, shape in ((Jump.after, "function", (before.B, after.n)), (Jump.costs, "cost", (before.B,))):
            expected = f"values of shape {shape} for states {tuple(x.shape)} and controls {tuple(v.shape)}"
            try:
                value: Any = of(self, x, v)
            except MISTAKES as error:
                raise InputError(f"{where}.{name}", expected, f"{type(error).__name__}: {first_line(error)}") from None
            if not isinstance(value, Tensor) or tuple(value.shape) != shape or value.dtype != x.dtype:
                raise InputError(f"{where}.{name}", expected, describe(value))
            two = torch.tensor([0, before.B - 1], device=x.device)
            if mixes_problems(lambda rows, x, v, of=of: of(self.take(rows), x, v), two, x[two], v[two]):
                raise InputError(f"{where}.{name}", "values of a problem that depend on its own row alone", "others")


def _row(constraint: Any, dims: Dimensions, where: str) -> Constraint:
    """A constraint of a jump, bound as that of a stage."""
    if not isinstance(constraint, Constraint):
        raise InputError(where, "a constraint", shown(constraint))
    if constraint.joins_knots or getattr(constraint, "of", "u") == "x":
        raise InputError(where, ROWS, type(constraint).__name__)
    row = bound(constraint, dims, where, Constraint)
    if row.holds_at(1):
        raise InputError(where, ROWS, type(constraint).__name__)
    return row


def linked(link: Link, before: Problem, after: Problem, where: str) -> Jump:
    """Rows of the last state of a phase and the first of the next, which the solver chooses, as a jump."""
    if link.knots != (0, -1) or link.earlier is not None:
        expected = "the default: between phases it joins a phase's last knot and the first of the next"
        raise InputError(f"{where}.knots", expected, shown(link.knots))
    each = []
    for problem in (before, after):
        dims = Dimensions(problem.B, 1, problem.n, problem.m, None, None, problem.x0)
        each.append(bound(link, dims, where, Link))
    first, second = each
    if len(first.components) != len(second.components):
        expected = f"states that both phases have, of {before.n} and {after.n}"
        raise InputError(f"{where}.components", expected, shown(link.components))
    return Jump(lambda x, v: v, after.n, constraints=[first.at_once(second)])
