"""Phases: what they are, and what is wrong with some."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from operator import is_
from typing import Any

from torchgco.base.errors import InputError, shown
from torchgco.base.gradients import asking, recording, without_gradients
from torchgco.constraints.link import Link
from torchgco.costs.base import Cost
from torchgco.phases.jump import Jump, linked
from torchgco.problem.given import facts_of
from torchgco.problem.problem import Problem

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
    if type(one.cost).total is not Cost.total and not hasattr(one.cost, "diagonal"):
        raise InputError(f"{where}.cost", "a sum over stages", f"{type(one.cost).__name__}.total")


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
