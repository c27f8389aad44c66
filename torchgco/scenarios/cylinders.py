"""Forests of cylinders by the rule of a published benchmark for flight in unknown space (SANDO's static forests)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from torchgco.base.options import Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import uniform_clear, upright_capsules
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor


@dataclass(frozen=True, kw_only=True)
class Cylinders(Quadrotor):
    """Upright cylinders, uniform in a rectangle, which may overlap: too tall to fly over, and the ground below.

    The published worlds are three files with 41, 81 and 162 cylinders of 1.0 to 1.5 m on 100 x 40 m; layouts here are
    drawn again by that rule. Cylinders have half spheres as ends, outside of the height that is flown in. How the
    published ones are spread is not known beyond this.

    Args:
        num_obstacles: how many.
        region: 2 pairs [low, high] in x and y, m.
        radii: [least, largest], uniform, m.
        height: z of the cylinders' ends, m.
        clearance: a cylinder is redrawn until its axis is more than this from start and goal, in the plane, m.
    """

    name: str = "cylinders"
    num_obstacles: Annotated[int, Within(0, checks.MOST_OBSTACLES)] = 41
    region: checks.Region2 = ((5.0, 105.0), (-20.0, 20.0))
    radii: checks.Sizes = (1.0, 1.5)
    height: checks.Range = (-3.0, 9.0)
    clearance: checks.Length = 3.0
    vehicle_radius: checks.Length = 0.1
    start: checks.Point3 = (0.0, 0.0, 2.0)
    goal: checks.Point3 = (105.0, 0.0, 2.0)
    goal_radius: checks.Size = 0.5
    stages: checks.Stages = 100

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        clear = ((self.start[:2], self.clearance), (self.goal[:2], self.clearance))
        axes = uniform_clear(rng, self.region, self.num_obstacles, clear)
        radii = rng.uniform(self.radii[0], self.radii[1], self.num_obstacles)
        return self._layout(**upright_capsules(axes, self.height, radii))
