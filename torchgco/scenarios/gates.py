"""Courses through gates: drawn in forests, and a published race."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import INCREASING, Above, AtMost, Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import MAX_DRAWS, Family, equal_spheres, uniform_clear
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor

MOST_GATES = 100
Integrator = Literal["euler", "midpoint", "rk4"]
Gates = Annotated[tuple[Annotated[int, Within(1, MOST_GATES)], Annotated[int, Within(1, MOST_GATES)]], INCREASING]
Factor = Annotated[float, Above(0), AtMost(checks.TOO_LARGE)]
Angle = Annotated[float, Within(0, 3.1415926535, "rad")]

# Foehn, Romero and Scaramuzza, "Time-optimal planning for quadrotor waypoint flight" (Science Robotics, 2021): start,
# end and gates, retyped from github.com/FSC-Lab/TOGT-Planner (MIT licence), resources/racetrack/race_uzh_19wp.yaml.
# Seven places are passed 2.7 times. Published: 17.56 s.
PUBLISHED_START, PUBLISHED_END = (-5.0, 4.5, 1.2), (4.75, -0.9, 1.2)  # m
PUBLISHED = (
    (-1.1, -1.6, 3.6), (9.2, 6.6, 1.0), (9.2, -4.0, 1.2), (-4.5, -6.0, 3.5), (-4.5, -6.0, 0.8), (4.75, -0.9, 1.2),
    (-2.8, 6.8, 1.2),
)  # fmt: skip
PUBLISHED_GATES = tuple(PUBLISHED[i % len(PUBLISHED)] for i in range(19))


@dataclass(frozen=True, kw_only=True)
class GateForest(Quadrotor):
    """Gates that are passed one after the other in the least time, and spheres beside and between them.

    Each gate, and the goal behind the last, lies a drawn distance from the one before, in a drawn direction. The number
    of stages is `stages` for each leg, whose durations are free.

    Args:
        goal: without meaning here: it is drawn.
        stages: of each leg.
        integrator: of the quadrotor: Euler's steps, of which the durations would be 1 to 3 % too long, lead a metre
            or two past the gates.
        num_gates: [least, most] of a layout, any of these alike.
        gate_radius: m.
        spacing: [least, largest] distance from gate to gate, in the plane, m.
        turn: largest angle of a leg to the x axis, seen from above, rad.
        heights: [least, largest] of gates and goal, m.
        width: a course stays within this of the x axis, m.
        obstacle_radius: m.
        density: expected number of spheres per m^3 of the box around the course.
        border: of that box beside the course, m.
        clearance: a sphere is redrawn until its centre is more than this from start, gates and goal, m.
        time_least, time_most: of a stage's length, as multiples of dt.
    """

    name: str = "gates"
    start: checks.Point3 = (0.0, 0.0, 2.0)
    goal: checks.Point3 = (0.0, 0.0, 2.0)
    goal_radius: checks.Size = 0.5
    stages: checks.Stages = 20
    integrator: Integrator = "rk4"
    num_gates: Gates = (3, 12)
    gate_radius: checks.Size = 0.5
    spacing: checks.Sizes = (4.0, 7.0)
    turn: Angle = 1.0
    heights: checks.Range = (1.0, 3.0)
    width: checks.Size = 10.0
    obstacle_radius: checks.Length = 0.6
    density: checks.Density = 0.03
    border: checks.Length = 2.0
    clearance: checks.Length = 1.5
    time_least: Factor = 0.2
    time_most: Factor = 6.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "num_gates", tuple(int(count) for count in self.num_gates))
        if self.time_least > self.time_most:
            raise InputError("scenario.time_least", f"at most scenario.time_most, {self.time_most}", self.time_least)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        count = int(rng.integers(self.num_gates[0], self.num_gates[1] + 1))
        places = self._course(rng, count + 1)
        low, high = places.min(axis=0) - self.border, places.max(axis=0) + self.border
        spheres = int(rng.poisson(self.density * float(np.prod(high - low))))
        if spheres > checks.MOST_OBSTACLES:
            expected = f"at most {checks.MOST_OBSTACLES} spheres around a course"
            raise InputError("scenario.density", expected, f"{self.density}, which makes {spheres}")
        keep_clear = [(point.tolist(), self.clearance) for point in places]
        centers = uniform_clear(rng, np.column_stack([low, high]).tolist(), spheres, keep_clear)
        drawn = self._layout(
            **equal_spheres(centers, self.obstacle_radius),
            gate_centers=places[None, 1:-1],
            gate_radii=np.full((1, count), self.gate_radius),
            free_time=np.array([self.time_least, self.time_most, 1.0]),
        )
        return replace(drawn, goal=places[-1], stages=self.stages * (count + 1))

    def _course(self, rng: np.random.Generator, legs: int) -> np.ndarray:
        """Start, gates and goal (legs + 1, 3), m: each at least the least spacing from all others."""
        places = [np.array(self.start)]
        for _ in range(legs):
            for _ in range(MAX_DRAWS):
                turned, far = rng.uniform(-self.turn, self.turn), rng.uniform(*self.spacing)
                ahead = places[-1][:2] + far * np.array([np.cos(turned), np.sin(turned)])
                point = np.append(ahead, rng.uniform(*self.heights))
                near = min(float(np.linalg.norm(point - other)) for other in places)
                if abs(ahead[1]) <= self.width and near >= self.spacing[0]:
                    break
            else:
                raise InputError("scenario.width", "room for the course", f"{self.width} m")
            places.append(point)
        return np.stack(places)


@dataclass(frozen=True, kw_only=True)
class Race(Family):
    """The published track of 19 gates in the least time (layout 0), and tracks whose gates are moved from there.

    Args:
        start, goal: m, where the vehicle is at rest.
        stages: of each leg.
        gates: (G, 3), m.
        gate_radius: m.
        moved: gates of layouts 1, 2, ... are moved by up to this along each axis, m.
        time_least, time_most: of a stage's length, as multiples of dt.
    """

    name: str = "race"
    vehicle_radius: checks.Length = 0.0
    start: checks.Point3 = PUBLISHED_START
    goal: checks.Point3 = PUBLISHED_END
    goal_radius: checks.Size = 0.01
    stages: checks.Stages = 20
    dt: checks.TimeStep = 0.05
    gates: Sequence[checks.Point3] = PUBLISHED_GATES
    gate_radius: checks.Size = 0.3
    moved: checks.Length = 0.3
    time_least: Factor = 0.02
    time_most: Factor = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.gates) <= MOST_GATES:
            raise InputError("scenario.gates", f"1 to {MOST_GATES} gates", len(self.gates))
        if self.time_least > self.time_most:
            raise InputError("scenario.time_least", f"at most scenario.time_most, {self.time_most}", self.time_least)

    @property
    def states(self) -> int:
        """n of the model that races: its controls are thrusts of rotors."""
        return 13

    def draw(self, ids: Sequence[int], seed: int) -> Layouts:
        """The layouts numbered `ids` (each >= 0) under `seed` (>= 0), in that order: 0 is the track as it is."""
        drawn, published = super().draw(ids, seed), np.array(self.gates)
        centers = np.where((drawn.ids == 0)[:, None, None], published, drawn.gate_centers)  # type: ignore[arg-type]
        return replace(drawn, gate_centers=centers)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        gates = np.array(self.gates)
        return self._layout(
            gate_centers=(gates + rng.uniform(-self.moved, self.moved, gates.shape))[None],
            gate_radii=np.full((1, len(gates)), self.gate_radius),
            free_time=np.array([self.time_least, self.time_most, 1.0]),
        )

    def _layout(self, **parts: Any) -> Layouts:
        return replace(super()._layout(**parts), stages=self.stages * (len(self.gates) + 1))
