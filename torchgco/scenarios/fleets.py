"""Fleets that swap places: on a circle, through a door, and in a forest.

A layout's start and goal have a row for each vehicle, which is at rest there. Each horizon is as long as the way takes
at a mean speed, with some time more where vehicles wait for each other.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import AtLeast, Share, Within, check_options
from torchgco.scenarios import checks
from torchgco.scenarios.base import MAX_DRAWS, Scenario
from torchgco.scenarios.layouts import Layouts

WALL = 4.0  # m, length of the walls on either side of a door


@dataclass(frozen=True, kw_only=True)
class Swaps(Scenario):
    """Base of the families of fleets, in the plane: positions alone, so that any model moves there. Common fields:

    Args:
        vehicles: V, how many a fleet has.
        apart: what their centres keep from each other, m; None: twice the vehicle's radius.
        vehicle_radius, goal_radius: m.
        pace: horizons are as long as the way takes at this mean speed, m/s.
        dt: s.

    Raises:
        InputError: a field out of its range, named as `scenario.<field>`; on `draw`: vehicles or trunks that find no
            room.
    """

    name: str
    vehicles: Annotated[int, Within(2, 1000)] = 4
    apart: checks.Size | None = None
    vehicle_radius: checks.Length = 0.2
    goal_radius: checks.Size = 0.3
    pace: checks.Pace = 0.9
    dt: checks.TimeStep = 0.1

    model: ClassVar[str | None] = "disc"

    @property
    def dimension(self) -> int:
        """2, in the plane."""
        return 2

    def __post_init__(self) -> None:
        check_options(self, "scenario")
        for field in fields(self):
            object.__setattr__(self, field.name, checks.plain(getattr(self, field.name)))

    @property
    def kept(self) -> float:
        """The distance that centres keep, m."""
        return 2.0 * self.vehicle_radius if self.apart is None else self.apart

    def _fleet(self, starts: np.ndarray, goals: np.ndarray, way: float, **obstacles: Any) -> Layouts:
        """One layout from places (V, d) and the length of the way that its horizon is for, m."""
        d = starts.shape[1]
        none = {"centers": np.empty((1, 0, d)), "radii": np.empty((1, 0))}
        return Layouts(
            start=starts[None], goal=goals[None], apart=self.kept, vehicle_radius=self.vehicle_radius,
            goal_radius=self.goal_radius, dt=self.dt, stages=checks.stages_for(way, self.pace, self.dt),
            **(none | obstacles),
        )  # fmt: skip

    @abstractmethod
    def _draw_one(self, rng: np.random.Generator) -> Layouts: ...


@dataclass(frozen=True, kw_only=True)
class FleetCircle(Swaps):
    """All start on a circle, and each has its goal on the opposite side.

    Args:
        radius: of the circle, m, at least.
        spacing: between neighbours along the circle, m, at least.
        jitter: share of the angle between two neighbours by which each may deviate.
        heights: [least, largest] of starts and goals in space, m; None: in the plane.
    """

    name: str = "fleet_circle"
    radius: checks.Size = 2.5
    spacing: checks.Size = 1.75
    jitter: Share = 0.15
    heights: checks.Range | None = None

    @property
    def dimension(self) -> int:
        """3 where starts have heights."""
        return 2 if self.heights is None else 3

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        starts = self._ring(rng)
        goals = -starts
        if self.heights is not None:
            starts, goals = (np.column_stack([p, rng.uniform(*self.heights, self.vehicles)]) for p in (starts, goals))
        return self._fleet(starts, goals, 2.0 * self._wide, **self._obstacles(rng))

    @property
    def _wide(self) -> float:
        """The radius of the circle, m."""
        return max(self.radius, self.spacing * self.vehicles / (2.0 * np.pi))

    def _ring(self, rng: np.random.Generator) -> np.ndarray:
        V = self.vehicles
        angle = 2.0 * np.pi * (np.arange(V) + rng.uniform(-self.jitter, self.jitter, V)) / V
        return self._wide * np.column_stack([np.cos(angle), np.sin(angle)])

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        return {}


@dataclass(frozen=True, kw_only=True)
class FleetForest(FleetCircle):
    """A circle with trunks inside.

    Args:
        density: trunks per m^2 of the circle.
        trunks: [least, largest] radius, uniform, m.
        path: room between two trunks, m, at least.
        clearing: m from the starts to the trunks' centres, at least.
    """

    name: str = "fleet_forest"
    radius: checks.Size = 4.0
    spacing: checks.Size = 2.0
    density: checks.Density = 0.1
    trunks: checks.Sizes = (0.2, 0.35)
    path: checks.Length = 0.75
    clearing: checks.Size = 1.2
    heights: None = None  # trunks are discs

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        count, inner = int(self.density * np.pi * self._wide**2), self._wide - self.clearing
        rows = np.empty((0, 3))
        for _ in range(MAX_DRAWS):
            if len(rows) == count:
                return {"centers": rows[None, :, :2], "radii": rows[None, :, 2]}
            one = np.array([*rng.uniform(-inner, inner, 2), rng.uniform(*self.trunks)])
            room = np.hypot(*(rows[:, :2] - one[:2]).T) - rows[:, 2] - one[2]
            if np.hypot(*one[:2]) < inner and (room > self.path).all():
                rows = np.vstack([rows, one])
        raise InputError("scenario.density", f"room for {count} trunks", f"{self.density:g} per m^2")


@dataclass(frozen=True, kw_only=True)
class FleetDoor(Swaps):
    """A wall with a door; each vehicle of one side ends where one of the other side starts.

    Args:
        door: its width, m.
        thickness: of the wall, m.
        spacing: between two starts beside or behind each other, m.
        abreast: how many start beside each other.
        before: m from the wall's middle to the nearest starts.
        waiting: s that horizons have for each vehicle beside the time of the way.
    """

    name: str = "fleet_door"
    door: checks.Size = 1.0
    thickness: checks.Size = 0.2
    spacing: checks.Size = 0.9
    abreast: Annotated[int, Within(1, 1000)] = 4
    before: checks.Size = 1.8
    waiting: Annotated[float, AtLeast(0, "s")] = 0.75

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        count = (self.vehicles + 1) // 2
        few = self.vehicles - count  # start on the right; of an odd number one place is free there
        wide, j = min(count, self.abreast), np.arange(count)
        across = self.spacing * (j % wide - 0.5 * (wide - 1))
        away = self.before + self.spacing * (j // wide)
        left, right = (np.column_stack([side * away, across]) for side in (-1.0, 1.0))
        starts = np.vstack([left, right[rng.permutation(count)[:few]]])
        goals = np.vstack([right[rng.permutation(count)], left[rng.permutation(count)[:few]]])
        way = 2.0 * float(away.max()) + self.waiting * self.vehicles * self.pace
        middle, half = 0.5 * (self.door + WALL), [[0.5 * self.thickness, 0.5 * WALL]] * 2
        walls = {"box_centers": np.array([[[0.0, middle], [0.0, -middle]]]), "box_half_sizes": np.array([half])}
        return self._fleet(starts, goals, way, **walls)
