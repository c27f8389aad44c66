"""Who plans for the vehicles of a flight: a protocol, and the planner that knows all obstacles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor

from torchgco.missions.log import SeenLog
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.planning_problem import settled
from torchgco.problem.problem import Problem

SEED_STEP = 7_919  # between the seeds of two control steps


class Pilot(Protocol):
    """Plans for vehicles in lockstep: in every control period `sense`, then `plan`; `take` where some have ended.

    `Mission.begin` makes the one of a mission. `Flight(mission, problem, begin=...)` takes another: a function of
    (problem, x, seed, ids) that returns one, for planning problems (B), plants x (B, 17), and the key of all draws.
    """

    @property
    def knots(self) -> int:
        """Of a plan, N+1: as many positions are logged."""
        ...

    @property
    def seen(self) -> list[SeenLog]:
        """What each vehicle sees, kept up to date by `sense`; empty for pilots without a sensor."""
        ...

    def sense(self, step: int, x: Tensor, measured: Tensor) -> None:
        """Look around at a control step, from true states x (b, 17) that are measured as `measured`."""

    def plan(
        self, step: int, x: Tensor, before: MissionPlan | None, measured: Tensor | None = None
    ) -> tuple[MissionPlan, float]:
        """Plans from states x (b, 17), measured or predicted from those `measured`, and the seconds they took.

        `before` are the plans of the period before; None: there are none to continue.
        """
        ...

    def take(self, index: Tensor) -> None:
        """Keep the vehicles in `index`, int64."""

    def parts(self) -> Mapping[str, Tensor]:
        """Seconds of the period by part, (b,), under names of `MissionLog`; empty where they aren't measured."""
        ...


class KnownMap:
    """The planner where all obstacles are known from the start."""

    def __init__(self, planner: Planner, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> None:
        self.planner, self.problem, self.seed, self.ids = planner, settled(problem), seed, ids
        self._posed = planner.problem(problem, x)  # the problems of the plans before
        self.knots, self.seen = problem.N + 1, list[SeenLog]()

    def sense(self, step: int, x: Tensor, measured: Tensor) -> None:
        """Nothing: see `Pilot`."""

    def plan(
        self, step: int, x: Tensor, before: MissionPlan | None, measured: Tensor | None = None
    ) -> tuple[MissionPlan, float]:
        """See `Pilot`."""
        seed = self.seed + SEED_STEP * step
        plan, self._posed, seconds = self.planner.plan(
            self.problem, self._posed, x, step, before, seed, self.ids, measured
        )
        return plan, seconds

    def take(self, index: Tensor) -> None:
        """See `Pilot`."""
        # Kernels for fewer vehicles may solve fewer side by side.
        self.problem, self._posed = settled(self.problem.take(index)), settled(self._posed.take(index))
        self.ids = self.ids[index]

    def parts(self) -> Mapping[str, Tensor]:
        """None: see `Pilot`."""
        return {}
