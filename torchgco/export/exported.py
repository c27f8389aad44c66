"""A problem that is exported, and what its files say of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from torchgco.compiled import Compiled
from torchgco.compiled.stages import previous_of
from torchgco.export.beginning import Beginning
from torchgco.export.numbers import Changing
from torchgco.export.source import Solver
from torchgco.native.interior import Kept
from torchgco.problem.problem import Problem
from torchgco.receding.plan import stages_between

NEAR = 1e-3  # of the range of controls along the test's plans, that those in single precision may differ from Python's


FIXED_NOTE = """\
- `stages` is by how many stages of {} s time has gone on since the last step; parts of one count, too. Where a period
  has several, u is the plan's mean over `w.period`, s: set it to yours."""
FREE_NOTE = """\
- The third argument is the time since the last step, s. `w.t` has the times of the plan's knots, s, and u is the plan's
  mean over `w.period`, s: set it to yours. The first step begins with a plan that was found when this was written."""
RATES_NOTE = """\
- Rates count from `w.numbers.previous`, in which each step leaves the controls that it returned: where the vehicle did
  something else, write that there. A step of no time, for the same states, counts from where the one before did."""
ELEMENTS_NOTE = """\
- There are {} elements: `NAME_init(&w, 0)` to `NAME_init(&w, {})` load the numbers of one of them."""


@dataclass(frozen=True)
class Exported:
    """What is written."""

    compiled: Compiled
    kept: Kept
    solver: Solver
    changing: Changing
    begin: Beginning
    name: str
    receding: bool
    number: int  # bytes of a number: 8 or 4
    seconds: float | None = None  # from one step to the next; None: a stage

    @property
    def problem(self) -> Problem:
        """The user's."""
        return self.compiled.problem

    @property
    def is_free(self) -> bool:
        """Whether the time is."""
        return self.begin.time is not None

    @property
    def title(self) -> str:
        p, free = self.problem, ", a free time" if self.is_free else ""
        many = f", {p.B} elements" if p.B > 1 else ""
        return f"{p.n} states, {p.m} controls, {p.N} stages{free}{many}"

    @property
    def dt(self) -> float:
        """The length of a stage, s."""
        return float(torch.as_tensor(self.problem.dynamics.dt, dtype=torch.float64).flatten()[0])

    @property
    def stage(self) -> str:
        """The same as text."""
        return f"{self.dt:g}"

    @property
    def period(self) -> float:
        """By how much the horizon moves from step to step: stages, or seconds where the time is free."""
        seconds = self.period_seconds
        return float(seconds if self.is_free else stages_between(seconds / self.dt))

    @property
    def period_seconds(self) -> float:
        """The same, s."""
        return float(self.receding * (self.dt if self.seconds is None else self.seconds))

    @property
    def words(self) -> dict[str, Any]:
        """What files say of its numbers."""
        near = f"controls within {NEAR:g} of their range"
        same, real = ("the same bits, status and iterations", "doubles") if self.number == 8 else (near, "floats")
        many, free = self.problem.B > 1, self.is_free
        elements = ELEMENTS_NOTE.format(self.problem.B, self.problem.B - 1)
        return {
            "SAME": same, "REAL": real, "FIRST": ", 0" if many else "",
            "MOVED": "workspace.t[1]" if free else "NAME_STAGES", "USUAL": "NAME_PERIOD" if free else "NAME_STAGES",
            "NOTES": "\n".join(
                [FREE_NOTE if free else FIXED_NOTE.format(self.stage)]
                + [RATES_NOTE] * bool(self.previous)
                + [elements] * many
            ),
            "GUESSED": ", t" * free,
        }  # fmt: skip

    @property
    def previous(self) -> list[str]:
        """The names of numbers in which each step leaves its controls."""
        return previous_of(self.problem) if self.receding else []

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of X, U and K."""
        p = self.problem
        return (p.N + 1) * p.n, p.N * p.m, p.N * p.m * p.n

    @property
    def sizes_of_iterate(self) -> tuple[int, int]:
        """Numbers of the solver's states and controls."""
        p = self.kept.problem
        return (p.N + 1) * p.n, p.N * p.m
