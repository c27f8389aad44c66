"""The roadmap among boxes: free paths, the same in C and in PyTorch; classes; and walls with an opening."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.engines import engine_of
from tests.reference import boxes as brute_force
from tests.reference.graph_search import searched_by_torch
from tests.search.scenes import first_of_class
from tests.slow import mostly
from torchgco import (
    Boxes,
    ControlBounds,
    Goal,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Spheres,
    judge,
    presets,
    solve,
)
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.roadmap.geometry import Inflated, Scene, scales, scene_of
from torchgco.roadmap.roadmap import Roadmap


def uneven(points: Tensor, rows: slice) -> Tensor:
    """A price without mirror symmetry."""
    return 1.0 + 0.1 * (points[..., 0] * 0.3 + points[..., 1]).sin()


def scene(d: int, B: int = 4, seed: int = 0, spheres: int = 3, boxes: int = 5) -> tuple[Scene, list[np.ndarray]]:
    """Rotated boxes, one absent in every other problem, with spheres; and the boxes' centres, half sizes, rotations."""
    rng = np.random.default_rng(seed)
    plain = Planar(dt=0.1) if d == 2 else QuadrotorPlanning(dt=0.1)
    x0 = torch.zeros(B, plain.n, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.2, torch.as_tensor(rng.uniform(-0.2, 0.2, B))
    goal = torch.zeros(B, d, dtype=torch.float64)
    goal[:, 0] = 1.2
    centers, half = rng.uniform(-0.8, 0.8, (B, boxes, d)), rng.uniform(0.03, 0.3, (B, boxes, d))
    turns = rng.normal(size=(B, boxes, 4))
    rotations = turns[..., 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    centers[1::2, -1], half[1::2, -1], rotations[1::2, -1] = np.nan, np.nan, np.nan
    parts = [Boxes(centers, half, 0.05, rotations)]
    if spheres:
        parts.append(Spheres(rng.uniform(-0.8, 0.8, (B, spheres, d)), rng.uniform(0.03, 0.1, (B, spheres)), 0.05))
    cost = QuadraticCost(Q=[1.0] * plain.n, R=[1.0] * plain.m, Qf=[1.0] * plain.n)
    problem = Problem(plain, cost, parts, x0, 5, Goal(goal, 0.1))
    seen = scene_of(problem, torch.zeros(B, 5, plain.m, dtype=torch.float64))
    assert seen is not None and seen.obstacles.boxes is not None
    return replace(seen, traversal_cost=uneven), [centers, half, rotations]


def absent(boxes: Cuboids) -> Cuboids:
    """The same boxes, none of them present."""
    none = {name: torch.zeros_like(getattr(boxes, name)) for name in ("centers", "radii", "half_sizes")}
    return replace(boxes, absent=torch.ones_like(boxes.absent), **none)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("spheres", mostly([0, 3], 0))
@pytest.mark.parametrize("d", [2, 3])
def test_paths_are_free_and_the_same_in_c_and_in_pytorch(d: int, spheres: int) -> None:
    s, parts = scene(d, B=6, spheres=spheres)
    roadmap = Roadmap()
    paths, found = roadmap.paths(s, 3)
    with searched_by_torch():
        slow_paths, slow_found = roadmap.paths(s, 3)
    assert torch.equal(found, slow_found) and int(found.sum()) >= 4
    torch.testing.assert_close(paths, slow_paths, rtol=0, atol=1e-12)
    for b in found.nonzero().flatten().tolist():
        path = paths[b, 0].numpy()
        assert np.array_equal(path[0], s.start[b]) and np.array_equal(path[-1], s.goal[b])
        for i in range(5):
            box = tuple(part[b, i] for part in parts)
            if np.isnan(box[0]).any():
                continue
            for p, q in pairwise(path):
                if not np.array_equal(p, q):
                    assert brute_force.segment_distance(p, q, *box, samples=301) > 0.05 - 1e-9


def test_without_its_boxes_a_scene_is_that_of_spheres_alone() -> None:
    s, _ = scene(2)
    spheres, boxes, _ = s.obstacles
    assert boxes is not None
    for by in (nullcontext(), searched_by_torch()):
        with by:
            with_boxes = Roadmap().paths(replace(s, obstacles=Inflated(spheres, absent(boxes))), 2)
            alone = Roadmap().paths(replace(s, obstacles=Inflated(spheres)), 2)
        assert torch.equal(with_boxes[0], alone[0]) and torch.equal(with_boxes[1], alone[1])


def test_paths_on_either_side_of_a_box_are_of_different_classes() -> None:
    s, _ = scene(2, B=1, boxes=1, spheres=0)
    spheres, boxes, _ = s.obstacles
    assert boxes is not None
    boxes = replace(boxes, centers=torch.zeros_like(boxes.centers), radii=torch.full_like(boxes.radii, 0.05))
    corners = torch.tensor([[0.0, 0.9], [0.1, 0.8], [0.0, -0.9]], dtype=torch.float64)
    paths = torch.stack([torch.stack((s.start[0], corner, s.goal[0])) for corner in corners]).unsqueeze(0)
    assert first_of_class(paths, Inflated(spheres, boxes)).tolist() == [[True, False, True]]
    assert first_of_class(paths, Inflated(spheres, absent(boxes))).tolist() == [[True, False, False]]


def wall_in_the_plane(B: int = 2) -> Problem:
    """A wall across the path with an opening of 0.22 m off the straight line, and a disc behind it."""
    x0 = torch.zeros(B, 6, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.0, torch.linspace(-0.1, 0.1, B, dtype=torch.float64)
    wall = Boxes([[0.0, -0.55], [0.0, 0.92]], [[0.04, 0.75], [0.04, 0.5]], 0.06, [0.0, 0.0])
    return Problem(
        Planar(dt=0.05),
        QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.0, 0, 0, 0, 0]),
        [wall, Spheres([[0.5, 0.0]], [0.1], 0.06), ControlBounds([-10, -10], [10, 10])],
        x0, 160, Goal([1.0, 0.0], 0.3),
    )  # fmt: skip


def wall_in_space(B: int = 2) -> Problem:
    """A wall of four turned slabs around an opening of 1.6 m that lies off the straight path."""
    x0 = torch.zeros(B, 14, dtype=torch.float64)
    x0[:, 6], x0[:, 13], x0[:, 0] = 1.0, 9.81, -1.0
    x0[:, 1] = torch.linspace(0.8, 1.2, B, dtype=torch.float64)
    middle = np.array([5.0, 3.2, 0.3])
    reach, thick, gap = 3.0, 0.2, 0.8
    turn = np.array([np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4), 0.0])  # about y: exchanges the first and last sides
    offsets = [[0, reach + gap, 0], [0, -reach - gap, 0], [0, 0, reach + gap], [0, 0, -reach - gap]]
    sides = [[2 * reach, reach, thick]] * 2 + [[reach, 2 * gap + reach, thick]] * 2
    slabs = Boxes(middle + np.array(offsets), sides, 0.36, np.tile(turn, (4, 1)))
    weights = [1, 1, 100, 1, 1, 1, 1, 1, 1, 1, 10, 10, 10, 10]
    goal = [11.0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 9.81]
    return Problem(
        QuadrotorPlanning(dt=0.05),
        QuadraticCost(weights, [10, 10, 10, 1], [1, 1, 10, *[1] * 11], x_ref=goal, u_ref=[0, 0, 0, 9.81]),
        [slabs, ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])],
        x0, 100, Goal(goal[:3], 1.5),
    )  # fmt: skip


@pytest.mark.sampled(1)
@pytest.mark.parametrize("wall", [wall_in_the_plane, wall_in_space])
def test_the_goal_behind_a_wall_with_an_opening_is_reached(wall) -> None:
    problem = wall()
    solution = solve(problem)
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all()), verdict
    guess = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    alone = replace(presets.gco(problem).local, guidance=None)
    assert not bool(judge(problem, alone.solve(problem, guess).U).reached.all())


def test_the_scale_of_a_scene_of_boxes_is_their_depth() -> None:
    problem = wall_in_the_plane()
    rest = torch.zeros(2, 160, 2, dtype=torch.float64)
    seen = scene_of(problem, rest)
    assert seen is not None
    R, unit = scales(problem, seen, rest)
    assert R.tolist() == pytest.approx([(0.16 + 0.1 + 0.1) / 3] * 2) and bool((unit > 0).all())
    assert any(isinstance(c, BoundBoxes) for c in problem.constraints) and engine_of(problem) is not None
