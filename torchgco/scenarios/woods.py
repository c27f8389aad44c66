"""Woods: trunks all over the space between start and goal, too wide and too tall to fly around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchgco.base.errors import InputError
from torchgco.scenarios import checks
from torchgco.scenarios.base import uniform_clear, upright_capsules
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor


@dataclass(frozen=True, kw_only=True)
class Woods(Quadrotor):
    """Vertical trunks (capsules) at the points of a Poisson process, which may overlap.

    Args:
        density: expected number of trunks per m^2 of the region; the number itself varies from layout to layout.
        region: 2 pairs [low, high] in x and y, m.
        radii: [least, largest] of the trunks, uniform, m.
        height: z of the trunks' ends, m.
        clearance: a trunk is redrawn until its axis is more than this from start and goal, in the plane, m.
    """

    name: str = "woods"
    density: checks.Density = 0.4
    region: checks.Region2 = ((2.0, 17.0), (-14.0, 16.0))
    radii: checks.Sizes = (0.25, 0.45)
    height: checks.Range = (-8.0, 8.0)
    clearance: checks.Length = 1.26
    stages: checks.Stages = 240

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.expected_count > checks.MOST_OBSTACLES / 2:  # a Poisson number hardly ever exceeds its double
            expected = f"at most {checks.MOST_OBSTACLES // 2} trunks in scenario.region"
            raise InputError("scenario.density", expected, f"{self.density}, which makes {self.expected_count:.0f}")

    @property
    def expected_count(self) -> float:
        """Expected number of trunks."""
        return self.density * float(np.prod([high - low for low, high in self.region]))

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        count = int(rng.poisson(self.expected_count))
        clear = ((self.start[:2], self.clearance), (self.goal[:2], self.clearance))
        axes = uniform_clear(rng, self.region, count, clear)
        radii = rng.uniform(self.radii[0], self.radii[1], count)
        return self._layout(**upright_capsules(axes, self.height, radii))
