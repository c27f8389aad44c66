"""Where the graph of points finds no path, blocks of a lattice among spheres and boxes do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchgco import compose
from torchgco.roadmap.geometry import Inflated, points_along, scene_of
from torchgco.roadmap.lattice import sampled
from torchgco.roadmap.roadmap import Roadmap


@pytest.mark.slow
def test_a_way_through_the_doors_of_a_building_is_found() -> None:
    setup = compose(["scenario=rooms"])
    problem = setup.task(setup.scenario.draw([0, 1, 2, 3], 1)).problem
    scene = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(4, problem.N, problem.m)))
    assert scene is not None
    corners, found = Roadmap().paths(scene, 2)
    assert bool(found.all()), "1 of 4 by the graph alone"
    for k in range(2):
        path = corners[:, k]
        share = torch.linspace(0.0, 1.0, 600, dtype=path.dtype) * path.diff(dim=1).norm(dim=-1).sum(-1, keepdim=True)
        points = points_along(path, share)
        # Nodes are 0.19 m apart; within a wall and its margin a path would be up to 0.45 m deep.
        assert not bool(scene.obstacles.deeper(points, torch.full((4,), 0.2, dtype=path.dtype)).any())
        assert torch.equal(path[:, 0], scene.start) and torch.allclose(path[:, -1], scene.goal)
    alone = Roadmap().paths(scene.take(torch.tensor([2])), 2)[0]
    assert torch.equal(alone[0], corners[2]), "the same bits alone and in a batch"


def test_clearances_at_the_nodes_are_those_of_all_obstacles() -> None:
    setup = compose(["scenario=rooms", "scenario.rooms=[2,2,1]", "scenario.region=[[-2,4],[-2,4],[-1.5,1.5]]",
                     "scenario.goal=[2.5,2.5,0]"])  # fmt: skip
    problem = setup.task(setup.scenario.draw([0], 0)).problem
    scene = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m)))
    assert scene is not None and isinstance(scene.obstacles, Inflated)
    lattice = sampled(scene.obstacles.kinds, torch.stack((scene.start[0], scene.goal[0])).numpy())
    every = np.moveaxis(np.indices(lattice.shape), 0, -1).reshape(-1, 3)
    some = np.random.default_rng(0).choice(len(every), 4000, replace=False)
    points = torch.from_numpy(lattice.position(every[some]))
    due = np.full(len(some), np.inf)
    for part in scene.obstacles.kinds:
        away = part.signed_distance(points[None]).masked_fill(part.absent[:, None], torch.inf)
        due = np.minimum(due, away.amin(-1)[0].numpy())
    got = lattice.map.at(every[some])
    assert np.allclose(got, np.minimum(due, got.max()), atol=1e-5) and got.max() >= 4.0 * lattice.spacing


def test_a_scene_without_an_end_has_no_path() -> None:
    setup = compose(["scenario=rooms"])
    problem = setup.task(setup.scenario.draw([1], 1)).problem
    scene = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m)))
    assert scene is not None
    for far in (torch.inf, torch.nan):
        start = scene.start.clone()
        start[0, 0] = far
        assert not bool(Roadmap().paths(replace(scene, start=start), 2)[1].any())
