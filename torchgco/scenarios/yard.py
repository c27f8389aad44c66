"""A scenario for the unicycle: discs and rotated boxes between start and goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchgco.scenarios import checks
from torchgco.scenarios.base import Family, uniform_clear
from torchgco.scenarios.layouts import Layouts


@dataclass(frozen=True, kw_only=True)
class Yard(Family):
    """Discs and boxes at any angle, centres uniform in `region`, which may overlap; for the unicycle, n = 4.

    The start is at rest and heads along the x axis. Control bounds are the model's.

    Args:
        num_discs, num_boxes: how many of each.
        disc_radius, box_length, box_width: pairs [least, largest] in m: radii, and the full lengths of a box's sides,
            are uniform between them.
        region: 2 pairs [low, high] in m.
        clearance: a centre is redrawn until it is more than this from start and goal, m.
    """

    name: str = "yard"
    vehicle_radius: checks.Length = 0.3
    start: checks.Point2 = (-5.0, 0.0)
    goal: checks.Point2 = (5.0, 0.0)
    goal_radius: checks.Size = 0.5
    stages: checks.Stages = 150
    dt: checks.TimeStep = 0.1
    num_discs: checks.Number = 8
    num_boxes: checks.Number = 6
    disc_radius: checks.Sizes = (0.3, 0.6)
    box_length: checks.Sizes = (1.0, 2.2)
    box_width: checks.Sizes = (0.3, 0.6)
    region: checks.Region2 = ((-3.5, 3.5), (-2.5, 2.5))
    clearance: checks.Length = 1.5

    zeros: ClassVar[int] = 2

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        keep_clear = ((self.start, self.clearance), (self.goal, self.clearance))
        discs, boxes = self.num_discs, self.num_boxes
        centers = uniform_clear(rng, self.region, discs + boxes, keep_clear)
        length, width = _between(rng, self.box_length, boxes), _between(rng, self.box_width, boxes)
        return self._layout(
            centers=centers[None, :discs],
            radii=_between(rng, self.disc_radius, discs)[None],
            box_centers=centers[None, discs:],
            box_half_sizes=0.5 * np.stack((length, width), axis=-1)[None],
            box_rotations=rng.uniform(0.0, np.pi, boxes)[None],
        )


def _between(rng: np.random.Generator, limits: Sequence[float], count: int) -> np.ndarray:
    """Uniform numbers (count,) between two limits."""
    return rng.uniform(limits[0], limits[1], count)
