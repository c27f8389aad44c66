"""Plans drawn as cells: rooms by recursive division, furniture in them, and serpentine tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RIM = 0.4  # m of solid around a plan
LEAST_FILLED = 0.6  # share of the space that a plan of rooms fills along each axis, at least
LONGER = 0.8  # probability that a room is divided across its longer side
WHOLE = 5.0  # squares of the least width: a room as large as so many is divided for sure, smaller ones more seldom
WALL_TRIES = 10  # places that are tried for a wall
JAMB = 0.2  # m of wall on either side of a door
OFF = 0.3  # m that furniture keeps off doors
TURNED = 0.5  # probability that a piece of furniture stands at an angle
TURNS = 0.3  # share of a lane's length by which its ends differ


@dataclass(frozen=True, eq=False)
class Canvas:
    """Cells of a plan, all of them solid at first.

    Args:
        occupied: (X, Y) bool; drawn into.
        resolution: side of a cell, m; the first one has its lowest corner at 0.
    """

    occupied: NDArray[np.bool_]
    resolution: float

    @classmethod
    def of(cls, size: Sequence[float], resolution: float) -> Canvas:
        """Solid cells on an area (2,), m."""
        return cls(np.ones([max(1, round(side / resolution)) for side in size], bool), resolution)

    @property
    def size(self) -> Array:
        """(2,), m."""
        return self.resolution * np.array(self.occupied.shape, float)

    @cached_property
    def centers(self) -> Array:
        """Of the cells, (X, Y, 2), m."""
        axes = (self.resolution * (np.arange(n) + 0.5) for n in self.occupied.shape)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def fill(self, low: Array, high: Array, solid: bool) -> None:
        """Make the cells with centres in a box solid, or free."""
        self.occupied[((self.centers >= low) & (self.centers < high)).all(-1)] = solid


def rooms(
    rng: np.random.Generator, canvas: Canvas, thickness: Sequence[float], room: float, door: Sequence[float],
    loops: float, furniture: float, piece: Sequence[float],
) -> None:  # fmt: skip
    """Draw rooms; the options are those of `Floors`."""
    low = np.full(2, RIM)
    high = low + rng.uniform(LEAST_FILLED, 1.0, 2) * (canvas.size - 2 * RIM)
    canvas.fill(low, high, False)
    openings: list[tuple[Array, Array]] = []
    left = [(low, high)]
    while left:
        first, last = left.pop()
        if rng.uniform() > np.prod(last - first) / (WHOLE * room**2):
            continue
        wall = _wall(rng, first, last, openings, thickness, room, door)
        if wall is None:
            continue
        axis, begin, end = wall
        canvas.fill(begin, end, True)
        for _ in range(1 + (rng.uniform() < loops)):
            opening = _door(rng, axis, begin, end, door)
            canvas.fill(*opening, False)
            openings.append(opening)
        one, other = last.copy(), first.copy()
        one[axis], other[axis] = begin[axis], end[axis]
        left += [(first, one), (other, last)]
    for _ in range(rng.poisson(furniture * float(np.prod(high - low)))):
        _piece(rng, canvas, low, high, openings, piece)


def _wall(
    rng: np.random.Generator, low: Array, high: Array, openings: list[tuple[Array, Array]], thickness: Sequence[float],
    room: float, door: Sequence[float],
) -> tuple[int, Array, Array] | None:  # fmt: skip
    """The axis across which a room is divided, and the corners of the wall; None where no place was found.

    A wall doesn't end at a door.
    """
    for _ in range(WALL_TRIES):
        longer = int(np.argmax(high - low))
        axis = longer if rng.uniform() < LONGER else 1 - longer
        thick = math.exp(rng.uniform(math.log(thickness[0]), math.log(thickness[1])))
        if high[axis] - low[axis] < 2 * room + thick or (high - low)[1 - axis] < door[1] + 2 * JAMB:
            continue
        begin, end = low.copy(), high.copy()
        begin[axis] = rng.uniform(low[axis] + room, high[axis] - room - thick)
        end[axis] = begin[axis] + thick
        beyond = np.full(2, JAMB)
        beyond[1 - axis] = thickness[1]  # openings in the walls that it ends at
        if not any(((begin - beyond < b) & (a < end + beyond)).all() for a, b in openings):
            return axis, begin, end
    return None


def _door(rng: np.random.Generator, axis: int, begin: Array, end: Array, door: Sequence[float]) -> tuple[Array, Array]:
    """The corners of an opening in a wall."""
    low, high, across = begin.copy(), end.copy(), 1 - axis
    wide = rng.uniform(door[0], door[1])
    low[across] = rng.uniform(begin[across] + JAMB, end[across] - JAMB - wide)
    high[across] = low[across] + wide
    return low, high


def _piece(
    rng: np.random.Generator, canvas: Canvas, low: Array, high: Array, openings: list[tuple[Array, Array]],
    piece: Sequence[float],
) -> None:  # fmt: skip
    """Draw a piece of furniture, unless it would stand at a door."""
    center, half = rng.uniform(low, high), 0.5 * rng.uniform(piece[0], piece[1], 2)
    angle = rng.uniform(0.0, math.pi) if rng.uniform() < TURNED else 0.0
    reach = float(np.hypot(*half)) + OFF
    for a, b in openings:
        if np.linalg.norm(np.maximum(np.maximum(a - center, center - b), 0.0)) < reach:
            return
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    inside = (np.abs((canvas.centers - center) @ turn) < half).all(-1)
    canvas.occupied[inside] = True


def track(
    rng: np.random.Generator, canvas: Canvas, thickness: Sequence[float], lane: Sequence[float], lanes: Sequence[int]
) -> tuple[Array, Array]:
    """Draw a lane that turns back several times; returns its two ends (2,), m."""
    size = canvas.size - 2 * RIM
    along = int(rng.integers(2))  # the axis of the lanes
    wide = rng.uniform(lane[0], lane[1])
    pitch = wide + math.exp(rng.uniform(math.log(thickness[0]), math.log(thickness[1])))
    most = 1 + int((size[1 - along] - wide) / pitch)
    count = max(1, min(int(rng.integers(lanes[0], lanes[1] + 1)), most))
    reach = rng.uniform(LEAST_FILLED, 1.0) * size[along] - wide
    across = RIM + 0.5 * wide + pitch * np.arange(count)
    ends = RIM + 0.5 * wide + reach * rng.uniform(0.0, TURNS, count + 1)  # of lane i: at i and i + 1
    ends[1::2] = 2 * RIM + wide + reach - ends[1::2]
    corners = np.empty((2 * count, 2))
    corners[:, 1 - along] = across.repeat(2)
    corners[0::2, along], corners[1::2, along] = ends[:-1], ends[1:]
    norm = np.inf if rng.uniform() < 0.5 else 2  # square corners, or round ones
    for a, b in pairwise(corners):
        near = np.clip(canvas.centers, np.minimum(a, b), np.maximum(a, b))
        canvas.occupied[np.linalg.norm(canvas.centers - near, norm, axis=-1) <= 0.5 * wide] = False
    return corners[0], corners[-1]
