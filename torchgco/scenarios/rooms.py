"""Mazes of rooms: walls and floors with doors, most ways of which are dead ends."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Share, Within
from torchgco.scenarios import checks
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor

Count = Annotated[int, Within(1, 50)]


@dataclass(frozen=True, kw_only=True)
class Rooms(Quadrotor):
    """A box that walls and floors cut into equal rooms. Its outer walls are closed.

    The walls between two rooms are taken in random order; one gets a door where its rooms aren't joined by doors yet
    (Kruskal's algorithm with random weights), so that one way leads from each room to each other. Of the other walls,
    a random share gets doors, too. A door is an opening whose centre is uniform in the wall.

    Args:
        rooms: how many along x, y and z.
        region: the space that they fill: 3 pairs [low, high], m.
        thickness: of walls and floors, m.
        door: sides of an opening, across and along z; in a floor, along x and y; m.
        loops: share of the walls between rooms that get doors beyond the ones that join all rooms.
    """

    name: str = "rooms"
    rooms: tuple[Count, Count, Count] = (5, 4, 2)
    region: checks.Region3 = ((-2.0, 18.0), (-2.0, 14.0), (-1.5, 4.5))
    thickness: checks.Size = 0.3
    door: tuple[checks.Size, checks.Size] = (1.6, 1.6)
    loops: Share = 0.1
    vehicle_radius: checks.Length = 0.3
    start: checks.Point3 = (0.0, 0.0, 0.0)
    goal: checks.Point3 = (16.0, 12.0, 3.0)
    goal_radius: checks.Size = 0.5
    stages: checks.Stages = 280

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "rooms", tuple(map(int, self.rooms)))
        low, high = np.array(self.region).T
        room = (high - low) / self.rooms
        if (room - self.thickness <= [max(self.door), max(self.door), self.door[1]]).any():
            raise InputError("scenario.door", "openings that fit into the walls of a room", self.door)
        for name, point in (("start", self.start), ("goal", self.goal)):
            scaled = (np.array(point) - low) / room
            off = np.abs(scaled - np.round(scaled)) * room
            if (
                (scaled < 0).any()
                or (scaled > self.rooms).any()
                or (off <= 0.5 * self.thickness + self.vehicle_radius).any()
            ):
                raise InputError(f"scenario.{name}", "a point of scenario.region clear of its walls", point)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        from scipy.cluster.hierarchy import DisjointSet  # slow to load

        walls = [
            (room, axis) for axis in range(3) for room in product(*map(range, self.rooms)) if self._next(room, axis)
        ]
        joined = DisjointSet(product(*map(range, self.rooms)))
        order, spare = rng.permutation(len(walls)), rng.uniform(size=len(walls)) < self.loops
        places = rng.uniform(size=(len(walls), 2))
        boxes = self._outer()
        for i in order.tolist():
            room, axis = walls[i]
            opens = joined.merge(room, self._next(room, axis)) or spare[i]
            boxes += self._wall(room, axis, places[i] if opens else None)
        centers, halves = (np.array(column)[None] for column in zip(*boxes, strict=True))
        return self._layout(box_centers=centers, box_half_sizes=halves)

    def _next(self, room: tuple[int, ...], axis: int) -> tuple[int, ...] | None:
        """The room beyond the upper wall along an axis; None: there is none."""
        other = tuple(n + (i == axis) for i, n in enumerate(room))
        return other if other[axis] < self.rooms[axis] else None

    def _outer(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Centres and half sides of the six outer walls, which lie outside of the region."""
        low, high = np.array(self.region).T
        boxes, thick = [], self.thickness
        for axis, side in product(range(3), (0, 1)):
            first, last = low - thick, high + thick
            first[axis], last[axis] = (low[axis] - thick, low[axis]) if side == 0 else (high[axis], high[axis] + thick)
            boxes.append((0.5 * (first + last), 0.5 * (last - first)))
        return boxes

    def _wall(self, room: tuple[int, ...], axis: int, share: np.ndarray | None) -> list[tuple[np.ndarray, np.ndarray]]:
        """Centres and half sides of the boxes of a room's upper wall along an axis.

        Args:
            share: where its opening is, shares (2,) of the room that it has along the wall's two axes; None: closed.
        """
        low, high = np.array(self.region).T
        size = (high - low) / self.rooms
        first = low + size * room
        last = first + size
        level = last[axis]
        first[axis], last[axis] = level - 0.5 * self.thickness, level + 0.5 * self.thickness
        if share is None:
            return [(0.5 * (first + last), 0.5 * (last - first))]
        across, up = [i for i in range(3) if i != axis]
        inset = 0.5 * (self.thickness + np.array(self.door))
        middle = first[[across, up]] + inset + share * (size[[across, up]] - 2.0 * inset)
        edge = np.array([middle - 0.5 * np.array(self.door), middle + 0.5 * np.array(self.door)])
        boxes = []
        for begin, end in (
            ((first[across], first[up]), (edge[0, 0], last[up])), ((edge[1, 0], first[up]), (last[across], last[up])),
            ((edge[0, 0], first[up]), (edge[1, 0], edge[0, 1])), ((edge[0, 0], edge[1, 1]), (edge[1, 0], last[up])),
        ):  # fmt: skip
            a, b = first.copy(), last.copy()
            a[[across, up]], b[[across, up]] = begin, end
            boxes.append((0.5 * (a + b), 0.5 * (b - a)))
        return boxes
