"""Phases: what they are, what lies between two of them, and what is wrong with some."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from operator import is_
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError, first_line, shown
from torchgco.base.gradients import asking, is_recording, recording, without_gradients
from torchgco.base.options import Natural, check_value
from torchgco.base.shapes import MISTAKES, Dimensions, describe
from torchgco.base.tree import PerElement, Rows
from torchgco.base.values import NO_VALUES, Values, bound_values
from torchgco.constraints.base import Constraint
from torchgco.constraints.link import Link
from torchgco.problem.given import bound, facts_of
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


RENEWED = "renewed"  # what phases keep: the ones of other numbers that were made last


@dataclass(frozen=True)
class Phases:
    """Problems one after the other, each with its own model, and what happens between them.

        flight, after = (Problem(ball, cost, [floor], x0, N=20, time=FreeTime(0.1, 4.0)) for x0 in starts)
        solution = torchgco.solve(Phases([flight, after], jumps=[Jump(bounce)]))

    Numbers of states and controls, cost, constraints, N and dt are each phase's own; so is the duration, where its
    problem has a `FreeTime`. Costs add up. A phase begins where the jump leads from the end of the one before: its x0
    is a guess of that alone, but in the first phase. Rows of a phase hold at its own knots; state bounds at knots 1..N,
    as always.

    Args:
        problems: one for each phase, each a batch of B. The same object may stand several times.
        jumps: one between two phases each: a `Jump`; a `Link`, whose rows bind the state after it to the state before,
            as the solver chooses the former; or None, as if x+ = x-. None: no state changes between phases.
        loop: a `Link` between the first state of all and the last one, as in a periodic gait; `free_start` of the first
            problem says what the solver chooses there.

    Raises:
        InputError: no phase, phases with another batch, dtype or device, with a horizon per problem or a cost with a
            `total` of its own, a free start but in the first; jumps of another number, or that don't fit.
    """

    problems: Sequence[Problem]
    jumps: Sequence[Jump | Link | None] | None = None
    loop: Link | None = None
    members: tuple[Problem, ...] = field(init=False, repr=False)
    between: tuple[Jump, ...] = field(init=False, repr=False)  # bound, one fewer
    closing: Link | None = field(init=False, repr=False)  # the loop's numbers without gradients, as those of all else
    derived: dict[str, Any] = field(init=False, repr=False, compare=False, default_factory=dict)
    facts: tuple[Hashable, ...] = field(init=False, repr=False, compare=False)  # of the numbers of jumps

    def __post_init__(self) -> None:
        if not isinstance(self.problems, Sequence) or not all(isinstance(one, Problem) for one in self.problems):
            raise InputError("phases.problems", "a list of problems, one for each phase", shown(self.problems))
        if not self.problems:
            raise InputError("phases.problems", "at least one", "none")
        for i, one in enumerate(self.problems):
            _check(one, self.problems[0], i)
        object.__setattr__(self, "members", tuple(self.problems))
        object.__setattr__(self, "facts", self._facts())
        self._bind(without_gradients(self.jumps), without_gradients(self.loop))
        if not isinstance(self.loop, Link | None):
            raise InputError("phases.loop", "a Link, or None", shown(self.loop))
        if self.closing is not None:
            linked(self.closing, self.members[-1], self.members[0], "phases.loop")

    def _bind(self, jumps: Any, loop: Link | None) -> None:
        object.__setattr__(self, "between", _between(jumps, self.members))
        object.__setattr__(self, "closing", loop)

    def __len__(self) -> int:
        return len(self.members)

    @property
    def B(self) -> int:
        """How many problems of phases."""
        return self.members[0].B

    @property
    def x0(self) -> Tensor:
        """The starts (B, n) of the first phase."""
        return self.members[0].x0

    def of_parts(self, members: Iterable[Problem], between: Iterable[Jump]) -> Phases:
        """Phases of other problems and jumps, which are checked and bound already."""
        made = copy(self)
        parts: dict[str, Any] = {"members": tuple(members), "between": tuple(between), "derived": {}}
        for name, value in parts.items():
            object.__setattr__(made, name, value)
        return made

    def take(self, index: Rows) -> Phases:
        """The phases of the problems in `index` (int64, (b,), or a slice)."""
        return self.of_parts([one.take(index) for one in self.members], [jump.take(index) for jump in self.between])

    def renewed(self) -> Phases:
        """The same, with nothing kept that was computed from their parts."""
        return self.of_parts([one.renewed() for one in self.members], self.between)

    def current(self) -> Phases:
        """The same phases with numbers as they are now, where these were changed in place since; else these."""
        members, facts = tuple(one.current() for one in self.members), self._facts()
        for made in (self, self.derived.get(RENEWED, self)):
            if facts == made.facts and all(map(is_, members, made.members)):
                return made
        self.derived[RENEWED] = renewed = replace(self, problems=members)
        return renewed

    @property
    def asks(self) -> bool:
        """Whether tensors in phases or jumps ask for gradients."""
        given = (one.given for one in self.members)
        return any(one is not None and one.asks for one in given) or bool(asking((self.jumps, self.loop)))

    def recorded(self) -> Phases:
        """The same phases with gradients recorded, from the tensors that were given on."""
        live = copy(self)
        with recording():
            object.__setattr__(live, "members", tuple(one.recorded() for one in self.members))
            live._bind(self.jumps, self.loop)
        return live

    def _facts(self) -> tuple[Hashable, ...]:
        return tuple(facts_of((self.jumps, self.loop)))


def _kind(one: Problem) -> tuple[Any, ...]:
    """What problems of all phases have in common."""
    return f"a batch of {one.B}", one.x0.dtype, one.x0.device


def _check(one: Problem, first: Problem, i: int) -> None:
    where = f"phases.problems[{i}]"
    for mine, theirs in zip(_kind(one), _kind(first), strict=True):
        if mine != theirs:
            raise InputError(where, f"{theirs}, as of the first phase", mine)
    if one.horizon is not None:
        raise InputError(f"{where}.horizon", "None: the N of a phase is that of all problems", "a horizon")
    if i > 0 and one.free_start is not None:
        raise InputError(f"{where}.free_start", "None: only the first start may be free", "a free start")


def _between(jumps: Any, members: tuple[Problem, ...]) -> tuple[Jump, ...]:
    count = len(members) - 1
    given = [None] * count if jumps is None else jumps
    if not isinstance(given, Sequence) or len(given) != count:
        got = f"{len(given)} of them" if isinstance(given, Sequence) else shown(given)
        raise InputError("phases.jumps", f"{count}, one between two of the {len(members)} phases each, or None", got)
    bound = []
    for i, (jump, before, after) in enumerate(zip(given, members, members[1:], strict=False)):
        where = f"phases.jumps[{i}]"
        if isinstance(jump, Link):
            jump = linked(jump, before, after, where)
        if not isinstance(jump, Jump | None):
            raise InputError(where, "a Jump, a Link or None", shown(jump))
        bound.append((jump or Jump()).bind(before, after, where))
    return tuple(bound)
