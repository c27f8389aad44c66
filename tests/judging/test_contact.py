"""Where pictures mark contact: there and only there where the judge finds it."""

import numpy as np
import pytest
import torch

from torchgco import Boxes, Field, FunctionDynamics, OccupancyGrid, Problem, QuadraticCost, Spheres, judge
from torchgco.judging.contact import BETWEEN, contacts
from torchgco.obstacles.base import ADMITTED

N, DT, RADIUS = 12, 0.1, 0.2


def task(paths: np.ndarray) -> Problem:
    """Points that move from knot to knot among a map, a sphere, a moving one and a turned box."""
    cells = np.zeros((20, 20), bool)
    cells[4:6, 8:18] = cells[14, 2:9] = True
    parts = [
        Field(OccupancyGrid(cells, [-1.0, -1.0], 0.1), RADIUS),
        Spheres([[0.0, 0.6], [-0.6, -0.5]], [0.15, 0.1], RADIUS, velocities=[[0.0, 0.0], [0.4, 0.2]]),
        Boxes([[0.5, 0.6]], [[0.2, 0.05]], RADIUS, rotations=[0.5], radii=[0.03]),
    ]
    dynamics = FunctionDynamics(lambda x, u: u, 2, 2, DT, "euler", slice(0, 2))
    cost = QuadraticCost([0.0] * 2, [1.0] * 2, [1.0] * 2, [0.0] * 2)
    return Problem(dynamics, cost, parts, torch.from_numpy(paths[:, 0]), paths.shape[1] - 1)


@pytest.mark.slow
def test_contact_is_marked_where_and_only_where_the_judge_finds_it() -> None:
    rng = np.random.default_rng(0)
    paths = np.cumsum(np.concatenate((rng.uniform(-1, 1, (24, 1, 2)), rng.normal(0, 0.12, (24, N, 2))), axis=1), axis=1)
    problem = task(paths)
    verdict = judge(problem, torch.from_numpy(np.diff(paths, axis=1) / DT), torch.zeros(2).double(), 1.0)
    found = [contacts(problem.take(torch.tensor([b])).obstacles, paths[b], DT) for b in range(24)]
    touching = (verdict.clearance < 0).numpy()
    assert 5 < touching.sum() < 22
    np.testing.assert_array_equal([len(places) > 0 for places in found], touching)


def test_a_way_through_walls_has_a_mark_in_the_middle_of_each() -> None:
    half = 0.5 * 0.05 / BETWEEN  # of a piece
    for y, second in ((0.2, False), (-0.2, True)):  # through the first wall, and through its end and the second one
        path = np.stack((np.linspace(-1, 1, 41), np.full(41, y)), axis=-1)
        found = contacts(task(path[None]).obstacles[:1], path, DT)
        np.testing.assert_allclose(found, [[-0.5, y], [0.45, y]][: 1 + second], atol=half + 1e-9)


def test_contact_begins_where_the_judge_has_it() -> None:
    for more, count in ((-1e-4, 1), (1e-4, 0)):
        y = -0.2 - RADIUS + ADMITTED - more  # below the first wall alone
        path = np.stack((np.linspace(-0.9, 0.1, 21), np.full(21, y)), axis=-1)
        assert len(contacts([task(path[None]).obstacles[0]], path, DT)) == count
    alone = np.array([[-0.5, 0.0]])
    assert len(contacts(task(alone[None].repeat(2, 1)).obstacles, alone, DT)) == 1, "a single knot counts"
