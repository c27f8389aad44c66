"""Phases as one problem for solvers: stages of all phases, with one stage for each jump between them.

Its states and controls are as many as the largest phase has; those that a phase lacks are 0. A stage has the model and
the cost of its phase, in the form that solvers work on: a free time is a state of the phase's own. The controls of a
jump's stage are the jump's, then the time of the next phase, where that is free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, inf
from torch.nn.functional import pad

from torchgco.base.gradients import recording
from torchgco.base.shapes import Dimensions, repeated
from torchgco.base.tree import PerElement, is_users
from torchgco.constraints.base import Constraint, WrappedConstraint
from torchgco.constraints.bounds import Bounds
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics
from torchgco.phases.phases import Jump, Phases
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem

IDLE = 0.5  # cost of a control that a stage lacks, per unit squared: it makes the minimum, at 0, strict


@dataclass(frozen=True)
class Span:
    """Some stages of the whole: those of a phase, or the one of a jump."""

    first: int
    N: int
    n: int
    m: int

    @property
    def stages(self) -> slice:
        return slice(self.first, self.first + self.N)

    @property
    def knots(self) -> slice:
        """Those of a phase."""
        return slice(self.first, self.first + self.N + 1)

    def own(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """A phase's states (B, N+1, n) and controls (B, N, m) among those of the whole."""
        return X[:, self.knots, : self.n].contiguous(), U[:, self.stages, : self.m].contiguous()


@dataclass(frozen=True)
class Landing(PerElement):
    """A jump in the form that solvers work on."""

    jump: Jump
    frees_time: bool  # of the phase after it
    rest: Tensor  # (B, r): what that phase's further states begin with

    batched: ClassVar[tuple[str, ...]] = ("jump", "rest")

    m = property(lambda self: self.jump.controls + self.frees_time)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        x, m = x[..., : self.jump.n], self.jump.controls
        rest = self.rest[(slice(None), *[None] * (x.dim() - 2))]
        parts = self.jump.after(x, u[..., :m]), u[..., m : self.m], rest.expand(*x.shape[:-1], -1)
        return torch.cat(parts, dim=-1)


class Whole:
    """Phases as one problem.

    Attributes:
        members: the problem of each phase.
        forms: the same as solvers see them.
        landings: the jumps.
        spans: of the phases; of the jumps `spans_between`.
        problem: all of it.
    """

    def __init__(self, phases: Phases) -> None:
        self.phases, self.members = phases, phases.members
        self.forms = tuple(for_solvers(one) for one in self.members)
        self.landings = tuple(
            Landing(jump, one.time is not None, form.x0[:, one.n + (one.time is not None) :])
            for jump, one, form in zip(phases.between, self.members[1:], self.forms[1:], strict=True)
        )
        firsts = [0]
        for form in self.forms:
            firsts.append(firsts[-1] + form.N + 1)
        self.spans = tuple(Span(a, form.N, form.n, form.m) for a, form in zip(firsts, self.forms, strict=False))
        self.spans_between = tuple(
            Span(span.first + span.N, 1, span.n, landing.m)
            for span, landing in zip(self.spans, self.landings, strict=False)
        )
        self.problem = self._problem()

    def _problem(self) -> Problem:
        first, N = self.forms[0], self.spans[-1].first + self.spans[-1].N
        n, m = (max(sizes) for sizes in zip(*((s.n, s.m) for s in (*self.spans, *self.spans_between)), strict=True))
        more = n - first.n
        stretch = Stretch(self.spans, self.spans_between, N, n, m)
        parts: dict[str, Any] = {
            "N": N,
            "x0": pad(first.x0, (0, more)),
            "free_start": None if first.free_start is None else pad(first.free_start, (0, more)),
            "dynamics": _Dynamics(
                stretch, tuple(form.dynamics for form in self.forms), self.landings,
                tuple(form.x0 for form in self.forms),
            ),
            "cost": _Cost(stretch, tuple(form.cost for form in self.forms), self.phases.between),
            "constraints": tuple(self._rows(stretch)),
            "goal": None, "horizon": None, "time": None,
        }  # fmt: skip
        whole = first._with(parts)
        whole._set(given=_Given(self.phases))
        return whole

    def _rows(self, stretch: Stretch) -> Iterator[Constraint]:
        for form, span in zip(self.forms, self.spans, strict=True):
            for row in form.constraints:
                yield _shifted(row, span, stretch)
        for landing, jump, span in zip(self.landings, self.phases.between, self.spans_between, strict=True):
            for row in jump.constraints:
                yield _shifted(row, replace(span, n=landing.jump.n, m=jump.controls), stretch)
        if self.phases.closing is not None:
            x0, common = self.members[0].x0, min(self.members[0].n, self.members[-1].n)
            dims = Dimensions(len(x0), stretch.N, common, stretch.m, None, None, x0)
            yield self.phases.closing.bind(dims)


@dataclass(frozen=True)
class _Given:
    """What the problem of all phases was made of, as `problem.given` tells it."""

    phases: Phases

    asks = property(lambda self: self.phases.asks)

    def current(self, problem: Problem) -> Problem:
        """The problem: phases are looked at when it is made of them."""
        return problem

    def recorded(self, problem: Problem) -> Problem:
        """The same with gradients recorded."""
        live = self.phases.recorded()
        with recording():
            return Whole(live).problem

    def followed(self, whole: Problem, by: Callable[[Problem], Problem]) -> None:
        """Nothing of what is made of it."""


@dataclass(frozen=True)
class Stretch:
    """The spans of all phases, and of the jumps between them, in N stages of n states and m controls."""

    phases: tuple[Span, ...]
    jumps: tuple[Span, ...]
    N: int
    n: int
    m: int

    def of(self, k: int) -> tuple[int, bool]:
        """The number of the phase, or jump, of stage k, and whether it is a jump."""
        i = max(i for i, span in enumerate(self.phases) if span.first <= k)
        return i, k == self.phases[i].first + self.phases[i].N

    def in_order(self) -> Iterator[tuple[int, bool, Span]]:
        """Phases and jumps in time, as of `of`, each with its span."""
        for i, span in enumerate(self.phases):
            yield i, False, span
            if i < len(self.jumps):
                yield i, True, self.jumps[i]


@dataclass(frozen=True)
class _Dynamics(Dynamics):
    """The model of each stage."""

    stretch: Stretch
    models: tuple[Dynamics, ...]
    landings: tuple[Landing, ...]
    starts: tuple[Tensor, ...]  # (B, n) of each phase
    k: Any = field(default=None, repr=False)  # the stage or the stages (K,), set by `at`

    batched: ClassVar[tuple[str, ...]] = ("models", "landings", "starts")

    n = property(lambda self: self.stretch.n)  # type: ignore[assignment]
    m = property(lambda self: self.stretch.m)  # type: ignore[assignment]
    dt = None  # type: ignore[assignment]
    is_integrated = False  # type: ignore[assignment]
    calls_function = property(lambda self: any(map(is_users, (*self.models, *(l.jump for l in self.landings)))))

    def at(self, k: int | Tensor) -> Self:
        return replace(self, k=k)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        if isinstance(self.k, int):
            return self._step(*self.stretch.of(self.k), x, u, self.k)
        if len(self.k) < self.stretch.N:  # some of the stages
            pairs = ((k, self.at(k)) for k in self.k.tolist())
            return torch.stack([model.step(x[:, i], u[:, i]) for i, (k, model) in enumerate(pairs)], dim=1)
        rows = ((i, jumps, span.stages) for i, jumps, span in self.stretch.in_order())
        return torch.cat([self._step(i, jumps, x[:, k], u[:, k]) for i, jumps, k in rows], dim=1)

    def _step(self, i: int, jumps: bool, x: Tensor, u: Tensor, k: int | None = None) -> Tensor:
        """The states after stage k, or all stages (None), of phase or jump i."""
        if jumps:
            ahead = self.landings[i].step(x, u)
        else:
            span = self.stretch.phases[i]
            model = self.models[i].at(torch.arange(span.N, device=x.device) if k is None else k - span.first)
            ahead = model.step(x[..., : span.n], u[..., : span.m])
        return pad(ahead, (0, self.n - ahead.shape[-1]))

    def factor_controls(self, k: int) -> slice:
        """See `in_time.factor_controls`."""
        i, jumps = self.stretch.of(k)
        own: Any = self.models[i]
        if not jumps:
            return own.factor_controls(k) if hasattr(own, "factor_controls") else slice(0, 0)
        return slice(self.landings[i].jump.controls, self.landings[i].m)

    def at_rest(self, x0: Tensor, N: int) -> Tensor:
        each = ((start, span.N + 1) for start, span in zip(self.starts, self.stretch.phases, strict=True))
        return torch.cat([repeated(pad(start, (0, self.n - start.shape[-1])), count) for start, count in each], dim=1)


@dataclass(frozen=True)
class _Cost(Cost):
    """The cost of each stage: of a jump's that of the last knot before it, and the jump's own."""

    stretch: Stretch
    costs: tuple[Cost, ...]
    jumps: tuple[Jump, ...]

    batched: ClassVar[tuple[str, ...]] = ("costs", "jumps")

    calls_function = property(lambda self: any(map(is_users, (*self.costs, *self.jumps))))
    reads_knots = property(lambda self: any(cost.reads_knots for cost in self.costs))  # type: ignore[assignment]

    def rest_controls(self, like: Tensor) -> Tensor:
        rest = torch.zeros_like(like)
        for cost, span in zip(self.costs, self.stretch.phases, strict=True):
            rest[:, span.stages, : span.m] = cost.rest_controls(like[:, span.stages, : span.m])
        return rest

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        if isinstance(k, int):
            return self._stage(*self.stretch.of(k), x, u, k)
        rows = ((i, jumps, span.stages) for i, jumps, span in self.stretch.in_order())
        return torch.cat([self._stage(i, jumps, x[:, k], u[:, k]) for i, jumps, k in rows], dim=1)

    def _stage(self, i: int, jumps: bool, x: Tensor, u: Tensor, k: int | None = None) -> Tensor:
        span = (self.stretch.jumps if jumps else self.stretch.phases)[i]
        own, idle = x[..., : span.n], u[..., span.m :]
        if jumps:
            cost, jump = self.costs[i], self.jumps[i]
            last = cost.terminal(own) if x.dim() == 2 or k is not None else cost.terminal(own[:, 0]).unsqueeze(1)
            value = last if jump.cost is None else last + jump.costs(x[..., : jump.n], u[..., : jump.controls])
        else:
            stages = torch.arange(span.N, device=x.device) if k is None else k - span.first
            value = self.costs[i].stage(own, u[..., : span.m], stages)
        return value + IDLE * idle.square().sum(-1) if idle.shape[-1] else value

    def terminal(self, x: Tensor) -> Tensor:
        return self.costs[-1].terminal(x[..., : self.stretch.phases[-1].n])


def _shifted(row: Constraint, span: Span, stretch: Stretch) -> Constraint:
    """A phase's constraint in all of it."""
    if isinstance(row, Bounds) and not is_users(row):
        more = (stretch.m if row.of == "u" else stretch.n) - row.lower.shape[-1]
        sides = {
            side: pad(getattr(row, side), (0, more), value=free) for side, free in (("lower", -inf), ("upper", inf))
        }
        return replace(row, **sides, knots=_later(row.knots, span.first))
    return PhaseRows(row, span)


def _later(knots: Any, by: int) -> Any:
    return slice(knots.start + by, knots.stop + by) if isinstance(knots, slice) else knots + by


@dataclass(frozen=True)
class PhaseRows(WrappedConstraint):
    """A constraint of one phase."""

    span: Span

    batched: ClassVar[tuple[str, ...]] = ("constraint",)
    keeps_rows: ClassVar[bool] = True
    geometric = False  # type: ignore[assignment]
    row_radii = None  # type: ignore[assignment]

    knots = property(lambda self: _later(self.constraint.knots, self.span.first))  # type: ignore[assignment]
    bare = property(lambda self: self)  # type: ignore[assignment]
    in_metres = property(lambda self: self.constraint.in_metres)  # type: ignore[assignment]

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.value(*self.span.own(X, U))

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.violation(*self.span.own(X, U))

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        x, u = self.span.own(X, U)
        n, m, count = self.span.n, self.span.m, X.shape[-1]
        blocks = H.new_zeros(len(H), self.span.N + 1, n + 1 + m, n + 1 + m)
        self.constraint.accumulate(x, u, g, h, blocks)
        index = torch.tensor([*range(n), *range(count, count + 1 + m)], device=H.device)
        H[:, self.span.knots, index.unsqueeze(-1), index] += blocks

    def start_is_clear(self, x0: Tensor) -> Tensor:
        if self.span.first > 0:
            return super(WrappedConstraint, self).start_is_clear(x0)
        return self.constraint.start_is_clear(x0[:, : self.span.n])

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return self.constraint.told(row, knot - self.span.first, dynamics)
