"""Mazes: walls of boxes with one opening each, and loose boxes between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Within
from torchgco.scenarios import checks
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor

MOST_WALLS = 1000


@dataclass(frozen=True, kw_only=True)
class Mazes(Quadrotor):
    """Walls across the way, at even distances, each with a rectangular opening, and loose boxes turned about z.

    A loose box may close an opening.

    Args:
        walls: how many.
        region: the space that walls and loose boxes fill: 3 pairs [low, high], m.
        extent: [[low, high] in y, [low, high] in z] of each wall, m.
        thickness: of a wall, m.
        opening: its sides in y and z, m.
        opening_region: [[low, high] in y, [low, high] in z], in which the centres of openings are uniform, m.
        loose: number of loose boxes, with centres uniform in the region.
        sizes: [least, largest] half side of a loose box, each uniform, m.
    """

    name: str = "mazes"
    walls: Annotated[int, Within(0, MOST_WALLS)] = 3
    region: checks.Region3 = ((2.0, 17.0), (-3.0, 5.0), (-2.0, 2.0))
    extent: checks.Region2 = ((-24.0, 26.0), (-8.0, 8.0))
    thickness: checks.Size = 0.4
    opening: tuple[checks.Size, checks.Size] = (1.8, 1.8)
    opening_region: checks.Region2 = ((-3.0, 5.0), (-2.0, 2.0))
    loose: checks.Number = 6
    sizes: checks.Sizes = (0.3, 0.9)
    stages: checks.Stages = 280

    def __post_init__(self) -> None:
        super().__post_init__()
        for side, (low, high), (first, last) in zip(self.opening, self.opening_region, self.extent, strict=True):
            if not (first < low - 0.5 * side and high + 0.5 * side < last):
                expected = "openings that lie inside scenario.extent, wherever they are drawn"
                raise InputError("scenario.opening", expected, f"{self.opening}")

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        (low, high), pieces = self.region[0], []
        low_end, high_end = np.array(self.opening_region).T
        for x in np.linspace(low, high, self.walls + 2)[1:-1]:
            pieces.append(self._wall(x, rng.uniform(low_end, high_end)))
        walls = np.concatenate(pieces) if pieces else np.empty((0, 2, 3))
        low_end, high_end = np.array(self.region).T
        loose = np.stack(
            [
                rng.uniform(low_end, high_end, (self.loose, 3)),
                rng.uniform(self.sizes[0], self.sizes[1], (self.loose, 3)),
            ],
            axis=1,
        )
        half_turn = 0.5 * rng.uniform(-np.pi, np.pi, self.loose)
        turns = np.zeros((len(walls) + self.loose, 4))
        turns[: len(walls), 0] = 1.0
        turns[len(walls) :, 0], turns[len(walls) :, 3] = np.cos(half_turn), np.sin(half_turn)
        boxes = np.concatenate([walls, loose])
        return self._layout(box_centers=boxes[None, :, 0], box_half_sizes=boxes[None, :, 1], box_rotations=turns[None])

    def _wall(self, x: float, opening: np.ndarray) -> np.ndarray:
        """Centres and half sides (4, 2, 3) of the boxes around an opening (2,): at its sides, above and below it."""
        (left, right), (bottom, top) = self.extent
        side, height = 0.5 * np.array(self.opening)
        y, z = opening
        around = (
            (left, y - side, bottom, top), (y + side, right, bottom, top),
            (y - side, y + side, bottom, z - height), (y - side, y + side, z + height, top),
        )  # fmt: skip
        first, last, under, over = np.array(around).T
        middle = np.column_stack([np.full(4, x), 0.5 * (first + last), 0.5 * (under + over)])
        half = np.column_stack([np.full(4, 0.5 * self.thickness), 0.5 * (last - first), 0.5 * (over - under)])
        return np.stack([middle, half], axis=1)
