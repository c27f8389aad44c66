"""Phases that are compiled once, and what a call of them gives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Number, numbers_of_fields
from torchgco.base.tree import passed_on
from torchgco.compiled.answer import Answer
from torchgco.compiled.compiled import Compiled, plainly
from torchgco.compiled.numbers import (
    KeptLifted,
    numbers_of,
    overwrite,
    owned,
    with_numbers_as_they_are,
    with_own_numbers,
)
from torchgco.kernels import cost_scale, current, interior_of
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.quality import violation
from torchgco.native.interior import InteriorEngine
from torchgco.phases import OfPhases, Phases, PhasesSolution
from torchgco.phases.lowered import Whole
from torchgco.problem.in_time import Elapsed, factors_in, states_in_time, times_of
from torchgco.problem.problem import Problem
from torchgco.problem.times import times
from torchgco.solution import Solution

START = "phases[0].x0"


@dataclass(frozen=True)
class PhasesAnswer(OfPhases):
    """What one call of compiled phases gives: an `Answer` for each of them, and how all of them ended together."""

    whole: Whole
    found: Answer  # of the problem that solvers were given

    status, statuses, iterations, violation, warm, seconds = passed_on(
        "found", "status", "statuses", "iterations", "violation", "warm", "seconds"
    )

    @property
    def u(self) -> Tensor:
        """The first controls of the first phase, (B, m)."""
        return self.found.U[:, 0, : self.phases.members[0].m].clone()

    def _part(self, i: int) -> Answer:
        member, form = self.whole.members[i], self.whole.forms[i]
        X, U, K = self._trajectory(i)
        t = None if member.time is None else times_of(member, factors_in(member, X))
        if t is None and getattr(member.dynamics, "dt", None) is not None:
            t = times(member).expand(len(X), -1)
        return replace(
            self.found, X=X[..., : member.n].contiguous(), U=U[..., : member.m].contiguous(), K=K,
            violation=violation(form.constraints, X, U), t=t,
        )  # fmt: skip


class KeptPhases(KeptLifted):
    """Kept phases, as one problem.

    Args:
        kernels: of its form.
        problem: all of them.
        phases: what the user's numbers are written to.
        options: see `Kept`.
    """

    def __init__(self, kernels: InteriorEngine, problem: Problem, phases: Phases, options: BarrierOptions) -> None:
        super().__init__(kernels, problem, cost_scale(problem), options, phases.members[0])
        self.phases = phases

    def shift(self, by: float) -> None:
        """Let all trajectories begin `by` seconds later, in the first phase; see `Elapsed`."""
        if by == 0:
            return
        first, count = self.phases.members[0], len(self.phases.members[0].constraints)
        X, U = self.X[:, : first.N + 1], self.U[:, : first.N]
        factors = factors_in(first, X)
        span = Elapsed.of(first, factors, by)
        x, u = span.states(X[..., : first.n]), span.controls(U[..., : first.m], times_of(first, factors).diff(dim=1))
        lam = span.multipliers(self.lam[:count], self._knots[2 : 2 + count])
        for z, new in zip((X, U), states_in_time(first, x, u, span.factors), strict=True):
            z[..., : new.shape[-1]] = new
        for values, new in zip(self.lam, lam, strict=False):
            values.copy_(new)

    def read(self, changed: set[str | int], now: Phases) -> set[str | int]:
        """See `KeptLifted`: phases are lowered anew, where anything but the start is another one."""
        if not changed - {START}:
            return set()
        kept, new, parts = self.problem, Whole(now).problem, set[str | int]()
        self._x0[:, self._first :] = new.x0[:, self._first :].numpy()
        pairs: Iterable[tuple[str | int, Any, Any]] = [
            ("dynamics", kept.dynamics, new.dynamics), ("cost", kept.cost, new.cost),
            *((i, *pair) for i, pair in enumerate(zip(kept.constraints, new.constraints, strict=True))),
        ]  # fmt: skip
        for place, old, other in pairs:
            overwrite(old, other)
            parts.add(place)
        return parts


def _owning(phases: Phases) -> Phases:
    """The same phases, with memory of its own for every number of every problem."""
    members = [with_own_numbers(one) for one in phases.members]
    return phases.of_parts(members, [owned(jump, phases.B) for jump in phases.between])


def _refreshed(phases: Phases) -> Phases:
    """The same phases after numbers were written, with nothing that was computed from the previous ones."""
    jumps = (replace(one, constraints=tuple(row.remade() for row in one.constraints)) for one in phases.between)
    return phases.of_parts(map(with_numbers_as_they_are, phases.members), jumps)


def _numbers_of(phases: Phases) -> list[Number]:
    collected = list[Number]()
    for i, one in enumerate(phases.members):
        numbers = numbers_of(one, f"phases[{i}].")
        collected += numbers if i == 0 else [number for number in numbers if number.part != "x0"]
    for i, jump in enumerate(phases.between):
        where = f"jumps[{i}]"
        collected += numbers_of_fields(jump, where, where)
        for j, row in enumerate(jump.constraints):
            collected += row.numbers(f"{where}.constraints[{j}]", j)
    for number in collected:
        number.part = number.name
    return collected


class CompiledPhases(Compiled):
    """Compiled phases; `compile` makes them. Numbers have the phase before their name: "phases[0].x0".

    A call's answer is a `PhasesAnswer`, and `solution()` a `PhasesSolution`.
    """

    _owning: ClassVar[Any] = staticmethod(_owning)
    _refreshed: ClassVar[Any] = staticmethod(_refreshed)
    _form: ClassVar[Any] = staticmethod(lambda phases: Whole(phases).problem)
    _numbers_of: ClassVar[Any] = staticmethod(_numbers_of)
    _kept: KeptPhases | None
    _problem: Any

    @property
    def _in_time(self) -> bool:
        return self._problem.members[0].time is not None

    def _packed(self, phases: Phases) -> None:
        self._whole = Whole(phases)
        form = current(self._whole.problem)
        if phases.B == 0 or phases.closing is not None or phases.members[0].free_start is not None:
            return
        kernels = interior_of(form)
        if isinstance(kernels, InteriorEngine) and not kernels.engine.captured.reads_own:
            self._unit = cost_scale(form).unit
            self._kept = KeptPhases(kernels, form, phases, self.interior.options(warm=True))

    def _moved(self, shift: Any, elapsed: Any) -> float:
        if shift is not None or (elapsed is not None and not self._in_time):
            name, given = ("shift", shift) if shift is not None else ("elapsed", elapsed)
            raise InputError(name, "None of phases: of those that begin in a free time `elapsed` serves", shown(given))
        return super()._moved(None, elapsed)

    def _guess(self, now: Phases, last: Solution, moved: float) -> PhasesSolution:
        return PhasesSolution(Whole(now), last, self.interior)

    def _answer(self, good: np.ndarray, began: float) -> Any:
        return PhasesAnswer(self._whole, super()._answer(good, began))

    def solution(self) -> Any:
        """The last answer with multipliers, costs and statuses, as of `torchgco.solve`; see `Compiled.solution`."""
        with plainly():
            last = self._last
            if last is None:
                raise InputError("mpc", "a call before its solution is asked for", "none")
            whole = Whole(self.now)
            cost = torch.where(torch.isnan(last.cost), whole.problem.cost.total(last.X, last.U), last.cost)
            return PhasesSolution(whole, replace(last, cost=cost), self.interior)

    def begin_after(self, before: CompiledPhases, without: Sequence[int]) -> None:
        """Begin with what the last answer of longer phases leaves, once their first one, and the jump, are over.

        Args:
            without: the places of rows of their second phase that this first one lacks.
        """
        last, whole = before._last, before._whole
        if last is None:
            return
        over = len(whole.forms[0].constraints)
        jumps, count = sum(len(form.constraints) for form in whole.forms), len(whole.phases.between[0].constraints)
        gone = {*range(over), *(over + i for i in without), *range(jumps, jumps + count)}
        lam = tuple(values for i, values in enumerate(last.multipliers.lam) if i not in gone)
        problem, knots = self._whole.problem, slice(whole.spans[1].first, None)
        n, m = problem.n, problem.m
        left = replace(
            last, X=last.X[:, knots, :n].clone(), U=last.U[:, knots, :m].clone(), K=last.K[:, knots, :m, :n].clone(),
            d=last.d[:, knots, :m].clone(), multipliers=replace(last.multipliers, lam=lam),
        )  # fmt: skip
        if self._kept is not None:
            self._kept.take_over(torch.arange(problem.B), left)
        self._found, self._warm = left, before._warm.copy()
