"""A scenario: a named source of layouts, drawn by number from a seed or read from a file."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Seed, check_options, check_value
from torchgco.scenarios import checks
from torchgco.scenarios.layouts import Layouts, concatenate

End = Literal["start", "goal"]
ENDS: tuple[End, ...] = ("start", "goal")
MAX_DRAWS = 5000  # rounds of redrawing points that lie too near, before an InputError


@dataclass(frozen=True, eq=False)
class Footing:
    """The room that a vehicle takes up where it stands at start and goal.

    Args:
        start, goal: the balls that it consists of, centres from the position and radii, (P, d+1), m.
        inner: radius of a ball about the position that it holds, m.
    """

    start: np.ndarray
    goal: np.ndarray
    inner: float

    @classmethod
    def of_ball(cls, radius: float, dimension: int) -> Footing:
        """That of a vehicle that is a ball."""
        ball = np.array([[*[0.0] * dimension, radius]])
        return cls(ball, ball, radius)

    def free(self, end: End, distance: np.ndarray, spacing: float, times: float, more: float = 0.0) -> np.ndarray:
        """At which nodes (X, Y[, Z]) the vehicle can stand with its position, bool.

        Args:
            distance: from obstacles at the nodes, m; beyond them nothing is nearer than at the last ones.
            spacing: of the nodes, m.
            times, more: as free as for balls of so many radii and so many metres more.
        """
        free = np.ones(distance.shape, bool)
        for *center, radius in getattr(self, end):
            steps = np.rint(np.array(center) / spacing).astype(int)
            off = float(np.linalg.norm(center - spacing * steps))  # from the nearest node, which knows as much more
            places = (np.clip(np.arange(n) + by, 0, n - 1) for n, by in zip(distance.shape, steps, strict=True))
            free &= distance[np.ix_(*places)] > times * radius + more + off
        return free


class Scenario(ABC):
    """A named source of obstacle layouts.

    A layout depends only on (seed, id), not on the solver or on the other layouts drawn with it. A
    subclass has a `name` and a `dimension` and overrides `_draw_one`.
    """

    name: str

    model: ClassVar[str | None] = None  # of those whose layouts any model flies, which one does by default; None: any
    footing: ClassVar[Footing | None] = None  # of the vehicle that flies the layouts, where that is known
    shares_map = True  # whether all layouts have one map, where they have any

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Dimension d of space, 2 or 3."""

    @property
    def states(self) -> int | None:
        """Number n of states in start and goal; None where the vehicle gives both."""
        return None

    @property
    def available(self) -> int | None:
        """How many layouts there are; None where any number can be drawn."""
        return None

    def flown_by(self, footing: Footing) -> Self:
        """The scenario with starts and goals, where it draws any on a map, at which this vehicle is free."""
        flown = copy.copy(self)
        object.__setattr__(flown, "footing", footing)
        return flown

    def draw(self, ids: Sequence[int], seed: int) -> Layouts:
        """The layouts numbered `ids` (each >= 0) under `seed` (>= 0), in that order.

        Raises:
            InputError: ids or seed are malformed, or the scenario's rule can't be satisfied.
        """
        numbers = checks.indices(ids, "ids")
        seed = check_value(seed, Seed, "seed")
        drawn = concatenate([self._draw_one(generator(seed, int(number))) for number in numbers])
        return replace(drawn, name=self.name, ids=numbers)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        """One layout (L = 1) from its own stream. The number of rows M should be the same for all."""
        raise NotImplementedError(f"{type(self).__name__} overrides _draw_one or draw")


def generator(seed: Any, number: int) -> np.random.Generator:
    """The stream of layout `number` under `seed`: counter-based, independent of every other number's."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(number,))))


@dataclass(frozen=True, kw_only=True)
class Family(Scenario):
    """Base of the built-in random families: one start at rest, one goal. Their fields have these, too.

    Args:
        start, goal: positions (d,), m; the full states are at rest.
        vehicle_radius, goal_radius: m.
        stages: N.
        dt: s.

    Raises:
        InputError: a field out of its range, named as `scenario.<field>`.
    """

    name: str
    vehicle_radius: checks.Length
    start: Sequence[checks.Coordinate]
    goal: Sequence[checks.Coordinate]
    goal_radius: checks.Size
    stages: checks.Stages
    dt: checks.TimeStep

    zeros: ClassVar[int] = 0  # states after the position, at rest; none where what these are is the model's to say

    def __post_init__(self) -> None:
        check_options(self, "scenario")
        if not self.name:
            raise InputError("scenario.name", "a name", repr(self.name))
        for field in fields(self):
            object.__setattr__(self, field.name, checks.plain(getattr(self, field.name)))

    @property
    def dimension(self) -> int:
        """That of its start."""
        return len(self.start)

    @property
    def states(self) -> int:
        """n."""
        return self.dimension + self.zeros

    def _at_rest(self, position: Sequence[float]) -> np.ndarray:
        return np.array([*position, *[0.0] * self.zeros])

    def _layout(self, **obstacles: Any) -> Layouts:
        """One layout with these fields of Layouts; without `centers` there are no spheres."""
        none = {"centers": np.empty((1, 0, self.dimension)), "radii": np.empty((1, 0))}
        return Layouts(
            start=self._at_rest(self.start),
            goal=self._at_rest(self.goal),
            vehicle_radius=self.vehicle_radius,
            goal_radius=self.goal_radius,
            dt=self.dt,
            stages=self.stages,
            **(none | obstacles),
        )


def equal_spheres(centers: np.ndarray, radius: float) -> dict[str, np.ndarray]:
    """The fields of Layouts for one layout of spheres at `centers` (M, d), NaN where absent, m."""
    return {"centers": centers[None], "radii": np.where(np.isnan(centers[:, 0]), np.nan, radius)[None]}


def upright_capsules(axes: np.ndarray, height: Sequence[float], radii: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of Layouts for one layout of capsules at `axes` (K, 2) with ends at z = `height`, radii (K,), m."""
    low, high = height
    half = np.zeros((1, len(axes), 3))
    half[..., 2] = 0.5 * (high - low)
    centers = np.column_stack([axes, np.full(len(axes), 0.5 * (low + high))])
    return {"box_centers": centers[None], "box_half_sizes": half, "box_radii": radii[None]}


def uniform_clear(
    rng: np.random.Generator,
    region: Sequence[Sequence[float]],
    count: int,
    keep_clear: Iterable[tuple[Sequence[float], float]],
) -> np.ndarray:
    """`count` points (count, d) uniform in the box `region`, each redrawn until it is clear.

    `region` is d pairs [low, high] in m; clear means farther than `distance` from `point` for every
    (point, distance) in `keep_clear`. Raises InputError if some point isn't after `MAX_DRAWS` rounds.
    """
    low, high = np.array(region, np.float64).T
    points = rng.uniform(low, high, (count, len(low)))
    keep_clear = list(keep_clear)
    for _ in range(MAX_DRAWS):
        near = np.zeros(count, bool)
        for point, distance in keep_clear:
            near |= np.linalg.norm(points - np.asarray(point), axis=1) <= distance
        if not near.any():
            return points
        points[near] = rng.uniform(low, high, (int(near.sum()), len(low)))
    distances = " and ".join(f"{distance:g} m from {tuple(point)}" for point, distance in keep_clear)
    raise InputError(
        "scenario.region",
        f"room for {count} centres more than {distances}",
        f"{[list(pair) for pair in region]}, where {MAX_DRAWS} draws found no room",
    )
