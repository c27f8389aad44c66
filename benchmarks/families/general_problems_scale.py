"""Set 4 of the general families: many states, many stages."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import INF, D, Drawn, Draws, balls, limits, toward
from benchmarks.families.general_problems_classics import cartpole_of
from benchmarks.families.general_problems_obstacles import PLANE, unicycle_field
from torchgco import ControlBounds, FunctionDynamics, Problem, Spheres


def springs(draw: Draws, count: int, N: int) -> Drawn:
    """Masses in a row between two walls, joined by springs; five forces bring them to rest.

    x = [displacements (count, m), velocities], u = forces (5, N) on masses at equal distances.
    """
    pushed = torch.zeros(count, 5, dtype=D)
    pushed[(torch.arange(5) * (count - 1)).div(4, rounding_mode="floor"), torch.arange(5)] = 1.0

    def field(x: Tensor, u: Tensor) -> Tensor:
        p, v = x[..., :count], x[..., count:]
        ends = torch.zeros_like(p[..., :1])
        row = torch.cat((ends, p, ends), dim=-1)
        a = row[..., 2:] - 2.0 * p + row[..., :-2] - 0.05 * v
        return torch.cat((v, a + (pushed * u.unsqueeze(-2)).sum(-1)), dim=-1)

    x0 = torch.cat((draw(-0.8, 0.8, count), draw(-0.4, 0.4, count)), dim=-1)
    end = torch.zeros_like(x0)
    cost = toward(end, [0.1] * (2 * count), [0.1] * 5, [1.0] * (2 * count))
    parts = [ControlBounds(-0.5, 0.5), limits(*[2.0] * count, *[INF] * count)]
    return Drawn(Problem(FunctionDynamics(field, 2 * count, 5, 0.1, "rk4"), cost, parts, x0, N), end)


def springs12(draw: Draws) -> Drawn:
    return springs(draw, 12, 100)


def springs30(draw: Draws) -> Drawn:
    return springs(draw, 30, 100)


def springs30_long(draw: Draws) -> Drawn:
    return springs(draw, 30, 1000)


def cartpole_fine(draw: Draws) -> Drawn:
    return cartpole_of(draw, 1000)


def unicycle_long(draw: Draws) -> Drawn:
    """A differential drive over 60 m among forty discs."""
    x0, end = draw.states(0, draw(-1, 1), 0), draw.states(60, draw(-1, 1), 0)
    discs = Spheres(*balls(draw, 40, ([3.0, -4.0], [57.0, 4.0]), (0.6, 1.4), 0.3, x0[:, :2], end[:, :2]), 0.3)
    cost = toward(end, [1e-4, 1e-4, 0], [0.02, 0.02], [50, 50, 10])
    model = FunctionDynamics(unicycle_field, 3, 2, 0.05, "rk4", PLANE)
    return Drawn(Problem(model, cost, [ControlBounds([-0.5, -1.5], [2, 1.5]), discs], x0, 1000), end)


SCALE = (springs12, springs30, springs30_long, cartpole_fine, unicycle_long)
