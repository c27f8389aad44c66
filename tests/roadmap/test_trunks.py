"""The roadmap and the default solver among capsules: trunks from the ground to above the vehicle, and posts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.problems import quick_gco
from tests.reference import boxes as brute_force
from tests.reference.graph_search import searched_by_torch
from tests.search.scenes import NONE, spheres
from torchgco import Capsules, ControlBounds, Goal, Planar, Problem, QuadraticCost, QuadrotorPlanning, Spheres, judge
from torchgco.base.tree import take
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.roadmap.geometry import Inflated, Scene
from torchgco.roadmap.points import around_boxes, between_boxes
from torchgco.roadmap.roadmap import Roadmap

VEHICLE = 0.36  # m
START, GOAL = (-12.0, 0.0, 1.0), (12.0, 0.0, 1.0)


def flat_price(points: torch.Tensor, rows: slice) -> torch.Tensor:
    """Heights other than the start's cost more, as those of a vehicle with a reference."""
    return 1.0 + 0.5 * (points[..., 2] - 1.0).square()


def trunks(B: int, K: int, tilt: float = 0.0) -> tuple[Scene, tuple[np.ndarray, ...]]:
    """A forest of trunks 8 m long around the start's height, and their starts, ends and radii."""
    rng = np.random.default_rng(K)
    middle = np.concatenate((rng.uniform([-7.5, -10], [7.5, 10], (B, K, 2)), np.ones((B, K, 1))), axis=-1)
    up = np.concatenate((tilt * rng.normal(size=(B, K, 2)), np.ones((B, K, 1))), axis=-1)
    up *= 4.0 / np.linalg.norm(up, axis=-1, keepdims=True)
    parts = middle - up, middle + up, rng.uniform(0.25, 0.45, (B, K))
    boxes = bound(parts)
    start, goal = (torch.tensor(p, dtype=torch.float64).expand(B, 3) for p in (START, GOAL))
    return Scene(start, goal, Inflated(spheres([[START]] * B, [[NONE]] * B), boxes), flat_price), parts


def bound(parts: tuple[np.ndarray, ...]) -> Cuboids:
    """Capsules with these starts, ends and radii in the roadmap's form."""
    model = QuadrotorPlanning(dt=0.1)
    x0 = torch.zeros(len(parts[0]), model.n, dtype=torch.float64)
    cost = QuadraticCost(Q=[1.0] * model.n, R=[1.0] * model.m, Qf=[1.0] * model.n)
    (found,) = Problem(model, cost, [Capsules(*parts, VEHICLE)], x0, 3).constraints
    return found.inflated()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_paths_through_a_forest_are_free_and_the_same_in_c_and_in_pytorch(tilt: float) -> None:
    scene, (starts, ends, radii) = trunks(B=4, K=40, tilt=tilt)
    paths, found = Roadmap().paths(scene, 2)
    with searched_by_torch():
        slow_paths, slow_found = Roadmap().paths(scene, 2)
    assert bool(found.all()) and torch.equal(found, slow_found)
    torch.testing.assert_close(paths, slow_paths, rtol=0, atol=1e-12)
    for b in range(4):
        points = np.concatenate([np.linspace(p, q, 40) for p, q in pairwise(paths[b, 0].numpy())])
        for start, end, radius in zip(starts[b], ends[b], radii[b], strict=True):
            share = np.clip((points - start) @ (end - start) / 64.0, 0, 1)  # the trunks are 8 m long
            away = np.linalg.norm(points - start - share[:, None] * (end - start), axis=1)
            assert away.min() > radius + VEHICLE - 1e-9
    if tilt == 0:
        assert float((paths[:, 0, :, 2] - 1.0).abs().max()) < 0.5, "around the trunks, not over them"


def test_points_around_trunks_lie_where_the_straight_line_passes() -> None:
    """Also where the trunks' middles are far above it."""
    foot, top = np.array([[[0, 0.3, -1.0], [0, -1.5, -1.0]]]), np.array([[[0, 0.3, 11.0], [0, -1.5, 9.0]]])
    boxes = bound((foot, top, np.full((1, 2), 0.3)))
    start, goal = torch.tensor([START], dtype=torch.float64), torch.tensor([GOAL], dtype=torch.float64)
    points, exists = between_boxes(boxes, spheres([[[0.0] * 3]], [[NONE]]), start, goal)
    assert points[exists].tolist() == [pytest.approx([0, -0.6, 1.0])] * 2  # midway, seen from either trunk
    points, exists = around_boxes(boxes, start, goal, (1.15,))
    level = points[0, (points[0, :, 2] - 1.0).abs() < 1e-9]
    assert bool(exists.all()) and len(level) == 16
    away = torch.cdist(level, torch.tensor([[0, 0.3, 1.0], [0, -1.5, 1.0]], dtype=torch.float64)).amin(-1)
    assert away.tolist() == pytest.approx([1.15 * 0.66] * 16)


def test_gaps_do_not_depend_on_the_other_problems() -> None:
    scene, _ = trunks(B=70, K=30, tilt=0.3)  # more than are projected at once
    none, boxes, _ = scene.obstacles
    assert boxes is not None
    parts = boxes, none, scene.start, scene.goal
    points, exists = between_boxes(*parts)
    for b in (0, 36, 69):
        row = slice(b, b + 1)
        alone = between_boxes(*take(parts, row))
        assert torch.equal(alone[0], points[row]) and torch.equal(alone[1], exists[row])


@pytest.mark.slow
def test_posts_in_the_plane_are_flown_around() -> None:
    x0 = torch.zeros(2, 6, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.0, torch.tensor([-0.1, 0.1])
    posts = Capsules([[0.0, -0.8], [0.5, 0.1]], [[0.0, 0.3], [0.7, 0.9]], [0.05, 0.04], 0.06)
    problem = Problem(
        Planar(dt=0.05),
        QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.0, 0, 0, 0, 0]),
        [posts, Spheres([[0.3, -0.5]], [0.1], 0.06), ControlBounds([-10, -10], [10, 10])],
        x0, 160, Goal([1.0, 0.0], 0.3),
    )  # fmt: skip
    assert isinstance(problem.constraints[0], BoundBoxes)
    solution = quick_gco(problem).solve(problem, torch.zeros(2, 160, 2, dtype=torch.float64))
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all()), verdict
    path = solution.X[:, :, :2].numpy()
    for b in range(2):
        for start, end, radius in (((0.0, -0.8), (0.0, 0.3), 0.05), ((0.5, 0.1), (0.7, 0.9), 0.04)):
            away = [brute_force.distance_from_capsule(p, np.array(start), np.array(end), radius) for p in path[b]]
            assert min(away) > 0.06 - 2e-3
