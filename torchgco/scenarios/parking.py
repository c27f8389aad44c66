"""Parallel parking: a slot between two cars at a kerb, hardly longer than the car."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from torchgco.base.options import Above, AtMost, Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import Family
from torchgco.scenarios.layouts import Layouts

KERB_END = 10.0  # m: the kerb goes on so far behind the parked cars
KERB = 2.0  # m, its depth

Lengths = Annotated[float, Above(0, "car lengths"), AtMost(checks.TOO_LARGE, "car lengths")]
Angle = Annotated[float, Within(0, 3.1415926535, "rad")]


@dataclass(frozen=True, kw_only=True)
class Parking(Family):
    """A car parks between two others at a kerb, forwards or backwards, from a drawn pose beside them; n = 5.

    The kerb lies along the x axis. At the end the car stands at `goal`, still, with its heading along the kerb: these
    are constraints, and the effort is the cost. The model says how large the car is.

    Args:
        vehicle_radius: m, of a model that says no size of its car.
        start, start_within: the rear axle begins within `start_within` of `start` along each axis, m.
        start_turn: and heads within this of the x axis, rad.
        goal: of the rear axle, m.
        gap: between the parked cars, in lengths of these.
        length, width: of the parked cars, whose middles are at y = 0, m.
        kerb: from their sides to the kerb, m.
    """

    name: str = "parking"
    vehicle_radius: checks.Length = 0.9
    start: checks.Point2 = (3.25, 2.7)
    start_within: checks.Sizes2 = (1.75, 0.3)
    start_turn: Angle = 0.15
    goal: checks.Point2 = (-1.3, 0.0)
    goal_radius: checks.Size = 0.01
    stages: checks.Stages = 120
    dt: checks.TimeStep = 0.1
    gap: Lengths = 1.35
    length: checks.Size = 4.0
    width: checks.Size = 1.8
    kerb: checks.Length = 0.25

    zeros: ClassVar[int] = 3

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        within = np.array([*self.start_within, self.start_turn])
        start = self._at_rest(self.start)
        start[:3] += rng.uniform(-within, within)
        beside = (self.gap + 1.0) * self.length / 2.0
        centers = [[-beside, 0.0], [beside, 0.0], [0.0, -(self.width + KERB) / 2.0 - self.kerb]]
        parked = [self.length / 2.0, self.width / 2.0]
        half = [parked, parked, [beside + self.length / 2.0 + KERB_END, KERB / 2.0]]
        among = self._layout(box_centers=np.array([centers]), box_half_sizes=np.array([half]), goal_required=True)
        return replace(among, start=start)
