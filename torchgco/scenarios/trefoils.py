"""Fields of boxes on trefoil curves and of bars at rest, by the rule of a published benchmark (SANDO's)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Share, Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import MAX_DRAWS
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor

UPRIGHT_SHARE = 0.35  # share of bars that stand upright; of the others every second one lies along y, the rest along x
TILL = 20  # moments of the time of grace at which boxes are looked at


@dataclass(frozen=True, kw_only=True)
class Trefoils(Quadrotor):
    """Cubes that each move on a trefoil curve around a random point, and thin bars at rest. They may overlap.

    A cube at time t is at s = t / slower + offset of its curve,

        x0 + sx / 6 (sin s + 2 sin 2s),  y0 + sy / 5 (cos s - 2 cos 2s),  z0 - sz / 2 sin 3s

    with points x0, y0, z0 and all other letters uniform in their ranges. Published: 50, 100 and 200 boxes, of which
    65 % move, a vehicle of 0.2 m, 50 s at most (SANDO, `run_sim.py`). Here start and goal are kept clear besides.

    Args:
        num_obstacles: boxes in all.
        moving: share of them that moves, rounded down.
        region: 3 pairs [low, high] of the points, m.
        side: of a cube, m.
        bars: thickness and length of a bar, m. Those upright stand on the ground.
        scales: [least, largest] of sx, sy and sz, m.
        offsets, slower: [least, largest], rad and s.
        clearance: a box is redrawn until its surface stays farther than this from start and goal, m: from the start for
            `grace`, from the goal for all times at which a cube could be there.
        grace: s; before, the vehicle can hardly have left.
    """

    name: str = "trefoils"
    num_obstacles: checks.Number = 50
    moving: Share = 0.65
    region: checks.Region3 = ((5.0, 100.0), (-6.0, 6.0), (0.5, 4.5))
    side: checks.Size = 0.8
    bars: tuple[checks.Size, checks.Size] = (0.4, 4.0)
    scales: checks.Sizes = (2.0, 4.0)
    offsets: checks.Range = (0.0, 3.0)
    slower: checks.Sizes = (4.0, 6.0)
    clearance: checks.Length = 0.5
    grace: Annotated[float, Within(0, 60, "s")] = 1.0
    vehicle_radius: checks.Length = 0.1
    start: checks.Point3 = (0.0, 0.0, 2.0)
    goal: checks.Point3 = (105.0, 0.0, 2.0)
    goal_radius: checks.Size = 0.5
    stages: checks.Stages = 100

    @property
    def movers(self) -> int:
        """The number of cubes."""
        return int(self.moving * self.num_obstacles)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        parts = self._boxes(rng)
        for _ in range(MAX_DRAWS):
            near = self._near(parts)
            if not near.any():
                return self._layout(**{name: array[None] for name, array in parts.items()})
            again = self._boxes(rng)
            for name, array in parts.items():
                array[near] = again[name][near]
        raise InputError(
            "scenario.clearance",
            f"room for {self.num_obstacles} boxes that stay {self.clearance:g} m from start and goal",
            f"none in {MAX_DRAWS} draws",
        )

    def _boxes(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """The arrays of all boxes, as layouts hold them: cubes first."""
        low, high = np.array(self.region).T
        count, cubes = self.num_obstacles, self.movers
        centers = rng.uniform(low, high, (count, 3))
        sx, sy, sz = rng.uniform(*self.scales, (3, cubes))
        offset, rate = rng.uniform(*self.offsets, cubes), 1.0 / rng.uniform(*self.slower, cubes)
        upright = rng.uniform(size=count - cubes) < UPRIGHT_SHARE
        across = rng.uniform(size=count - cubes) < 0.5
        half = np.full((count, 3), 0.5 * self.side)
        half[cubes:] = 0.5 * self.bars[0]
        axis = np.where(upright, 2, np.where(across, 1, 0))
        half[cubes + np.arange(count - cubes), axis] = 0.5 * self.bars[1]
        centers[cubes:][upright, 2] = 0.5 * self.bars[1]
        sines: dict[str, Any] = {name: np.zeros((count, 2, 3)) for name in ("amplitudes", "rates", "phases")}
        none, turn = np.zeros(cubes), 0.5 * np.pi
        first, second = (sx / 6.0, sy / 5.0, -sz / 2.0), (sx / 3.0, -2.0 * sy / 5.0, none)
        sines["amplitudes"][:cubes] = np.moveaxis(np.array([first, second]), 2, 0)
        sines["rates"][:cubes] = rate[:, None, None] * np.array([[1.0, 1.0, 3.0], [2.0, 2.0, 0.0]])
        phase = offset[:, None, None] * np.array([[1.0, 1.0, 3.0], [2.0, 2.0, 0.0]])
        sines["phases"][:cubes] = phase + np.array([[0.0, turn, 0.0], [0.0, turn, 0.0]])
        return {"box_centers": centers, "box_half_sizes": half, **{f"box_{name}": sines[name] for name in sines}}

    def _near(self, parts: dict[str, np.ndarray]) -> np.ndarray:
        """Which boxes come near the start within the time of grace, or near the goal ever, (K,)."""
        amplitudes, rates, phases = (parts[f"box_{name}"] for name in ("amplitudes", "rates", "phases"))
        center, half = parts["box_centers"], parts["box_half_sizes"]
        t = np.linspace(0.0, self.grace, TILL)[:, None, None, None]
        places = center + (amplitudes * np.sin(rates * t + phases)).sum(axis=2)
        gap = np.linalg.norm(np.maximum(np.abs(places - self.start) - half, 0.0), axis=-1).min(axis=0)
        reach = half + np.abs(amplitudes).sum(axis=1)
        goal = np.linalg.norm(np.maximum(np.abs(center - self.goal) - reach, 0.0), axis=-1)
        return (gap <= self.clearance) | (goal <= self.clearance)
