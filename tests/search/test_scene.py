"""The scales and directions of a scene, by which the search measures."""

from __future__ import annotations

import pytest
import torch

from torchgco import ControlBounds, Goal, Planar, Problem, QuadraticCost, Spheres
from torchgco.roadmap.geometry import scales, scene_of
from torchgco.roadmap.points import directions


def sized(radius: float) -> Problem:
    start = torch.tensor([[-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]).double()
    cost = QuadraticCost(Q=[2.0, 2.0, 0, 0, 0, 0], R=[0.1, 0.1], Qf=[0.0] * 6, x_ref=[1.0, 0, 0, 0, 0, 0])
    spheres = Spheres([[0.0, 0.0], [0.3, 0.5], [0.0, -0.7]], [radius] * 2 + [3 * radius], radius)
    bounds = ControlBounds([-1.0, -1.0], [1.0, 1.0])
    return Problem(Planar(dt=0.05), cost, [spheres, bounds], start, 10, Goal([1.0, 0.0], 0.1))


@pytest.mark.parametrize("radius", [0.05, 0.15])
def test_scales_are_the_mean_size_and_the_cost_of_resting_over_its_fourth_power(radius: float) -> None:
    problem = sized(radius)
    rest = torch.zeros(1, 10, 2, dtype=torch.float64)
    seen = scene_of(problem, rest)
    assert seen is not None
    R, unit = scales(problem, seen, rest)
    size = radius * (2 + 2 + 4) / 3
    assert float(R) == pytest.approx(size)
    # The stage cost at rest at the start is 1/2 * 2 * 2^2 = 4.
    assert float(unit) == pytest.approx(4.0 / size**4)


def test_directions_are_unit_vectors_all_around_the_line_to_the_goal() -> None:
    goals = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 3.0, 0.0], [1.0, -2.0, 0.5]]).double()
    start = torch.zeros_like(goals)
    for rows in (torch.arange(4), torch.tensor([1]), torch.tensor([0])):
        rays = directions(start[rows], goals[rows])
        assert torch.allclose(rays.norm(dim=-1), torch.ones(()).double())
        assert float((rays * goals[rows].unsqueeze(1)).sum(-1).abs().max()) < 1e-12
        assert float(rays.sum(1).abs().max()) < 1e-12  # evenly all around
        assert torch.linalg.matrix_rank(rays).tolist() == [2] * len(rows)
    plane = directions(start[:, :2], goals[:, :2])
    assert torch.allclose(plane.norm(dim=-1), torch.ones(()).double()) and float(plane.sum(1).abs().max()) < 1e-12
