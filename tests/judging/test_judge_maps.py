"""The judge's distances from cells and points, against dense sampling; certificates of maps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.maps.test_field import bound, brute_clearance, points_around, random_grid
from torchgco import Field, FunctionDynamics, Goal, Problem, QuadraticCost, certify, judge
from torchgco.maps import DistanceField, OccupancyGrid, PointCloud
from torchgco.maps.field import BoundField
from torchgco.maps.measured import EXACT_TO


def along(part: BoundField, p: torch.Tensor) -> torch.Tensor:
    """Distances (K-1,) of the segments between points p (1, K, d) from what a map holds."""
    return part.measured(p)[1][0, :, 0] + part.vehicle_radius


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_segments_from_cells(d: int) -> None:
    grid = random_grid(d, share=0.03)
    part = bound(DistanceField.of(grid))
    p = torch.from_numpy(points_around(grid, 40, beyond=0.8)).view(1, 40, d)
    found = along(part, p).numpy()
    due = brute_clearance(grid, p[0, :-1], p[0, 1:])
    clear = due > 0
    assert clear.any() and (~clear).any()
    assert (found <= due + 1e-8)[clear].all() and (due - found)[clear].max() < 1e-3  # of the sampling
    assert (found[~clear] < 1e-8).all()


def test_points_deep_inside_and_points_that_are_lost() -> None:
    cells = np.zeros((40, 40), bool)
    cells[5:35, 5:35] = True
    part = bound(DistanceField.of(OccupancyGrid(cells, [0, 0], 0.1)))
    p = torch.tensor([[[2.0, 2.0], [2.0, 2.1], [2.0, 9.0], [torch.nan, 0], [100.0, 100], [100.0, 101]]]).double()
    found = along(part, p)
    assert bool((found[:2] < 0).all()) and bool(torch.isnan(found[2:4]).all())
    far = 2**0.5 * (100 - 3.5)
    assert EXACT_TO < float(found[4]) <= far


def test_clouds_and_empty_maps() -> None:
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.uniform(-1, 1, (40, 3)), 0.05)
    p = torch.from_numpy(rng.uniform(-1.5, 1.5, (1, 30, 3)))
    found = along(bound(DistanceField.of(cloud)), p).numpy()
    share = np.linspace(0, 1, 2001)[:, None, None]
    lines = p[0, :-1].numpy() + share * p[0].diff(dim=0).numpy()
    due = np.linalg.norm(lines[:, :, None] - cloud.points, axis=-1).min((0, 2)) - 0.05
    np.testing.assert_allclose(found, due, atol=2e-3)
    assert (found <= due + 1e-8).all()
    empty = bound(DistanceField.of(OccupancyGrid(np.zeros((3, 3), bool), [0, 0], 1.0)))
    assert bool(torch.isposinf(along(empty, torch.zeros(1, 4, 2).double())).all())


def test_verdicts_and_certificates_count_the_cells() -> None:
    """A straight flight beside, and through, a wall of one cell."""
    cells = np.zeros((20, 20), bool)
    cells[10, :10] = True  # x in [1, 1.1], y in [0, 1]
    model = FunctionDynamics(lambda x, u: x + 0.1 * u, 2, 2, 0.1, "none", position=slice(0, 2))
    cost = QuadraticCost([1.0, 1], [1.0, 1], [1.0, 1], [2.0, 1.0])
    x0 = torch.tensor([[0.0, 1.3], [0.0, 0.5], [0.0, 1.05]], dtype=torch.float64)
    problem = Problem(
        model,
        cost,
        [Field(OccupancyGrid(cells, [0, 0], 0.1), 0.2)],
        x0,
        3,
        Goal([[2.1, 1.3], [2.1, 0.5], [2.1, 1.05]], 0.2),
    )
    U = torch.tensor([7.0, 0.0]).double().expand(3, 3, 2)  # 0.7 m a step: the wall lies between knots
    verdict = judge(problem, U)
    np.testing.assert_allclose(verdict.clearance[0], 0.3 - 0.199, atol=1e-8)
    assert float(verdict.clearance[1]) < -0.199 < 0 < float(verdict.clearance_knots[1])
    assert float(verdict.clearance[2]) < 0
    assert verdict.clear_95.all() and verdict.feasible.tolist() == verdict.reached.tolist() == [True, False, False]
    X = torch.stack([x0 + 0.7 * k * torch.tensor([1.0, 0.0]) for k in range(4)], dim=1)
    certificate = certify(problem, X, U)
    np.testing.assert_allclose(certificate.clearance[0], 0.3 - 0.2, atol=1e-8)
    assert float(certificate.clearance[1]) < -0.2
