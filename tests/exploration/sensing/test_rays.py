"""Rays against a slow march through the same world, and worlds against the problems that they come from."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.reference.sensing import in_cells, inside, march
from torchgco import Boxes, Capsules, ControlBounds, Problem, QuadraticCost, QuadrotorPlanning, Spheres
from torchgco.base.errors import InputError
from torchgco.constraints import FunctionConstraint
from torchgco.exploration.sensing import World
from torchgco.exploration.sensing.sensors import Motion
from torchgco.maps import DistanceField, Field, OccupancyGrid, PointCloud
from torchgco.obstacles.base import Obstacles

STEP = 2e-3  # m, of the march


def turn(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return (q * np.sign(np.diag(r))).ravel()


def bodies(rng: np.random.Generator) -> np.ndarray:
    """Spheres, capsules, sharp and rounded boxes, straight and turned."""
    rows = []
    for kind in range(12):
        half = rng.uniform(0.1, 0.8, 3) * ([0, 0, 0], [0, 0, 1], [1, 1, 1], [1, 1, 1], [1, 1, 0])[kind % 5]
        radius = 0.0 if kind % 5 == 2 else rng.uniform(0.1, 0.5)
        axes = np.eye(3).ravel() if kind < 4 else turn(rng)
        rows.append(np.concatenate([rng.uniform(-3, 3, 3), axes, half, [radius]]))
    return np.array(rows)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    d[:3] = np.eye(3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(4))
def test_rays_meet_what_a_march_meets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = World(bodies(rng), Motion.steady(np.zeros((12, 3))))
    origin = rng.uniform(-3, 3, 3)
    rays = directions(rng, 80)
    slow = np.array([march(origin, d, 6.0, lambda p: inside(p, world.boxes), STEP) for d in rays])
    fast = world.cast(origin, rays, 6.0)
    both = np.isfinite(slow)
    assert (both.any() and not both.all()) or slow.max() == 0
    assert np.allclose(fast[both], np.maximum(slow[both] - STEP / 2, 0), atol=STEP)
    # A march may step over a body that a ray grazes, and never meets one that the ray misses.
    for d, t in zip(rays[~both], fast[~both], strict=True):
        if np.isfinite(t):
            assert not inside((origin + (t + STEP) * d)[None], world.boxes) or t > 6.0 - STEP


def test_rays_meet_occupied_cells() -> None:
    rng = np.random.default_rng(7)
    occupied = (rng.uniform(size=(14, 11, 9)) < 0.06).astype(np.uint8)
    corner, size = np.array([-2.0, -1.0, -0.7]), 0.31
    world = World(np.zeros((0, 16)), Motion.steady(np.zeros((0, 3))), occupied, tuple(corner), size)
    hits = 0
    for origin in (np.array([0.1, 0.2, 0.3]), np.array([-4.0, -3.0, 2.5]), np.array([0.3, 1.0, 5.0])):
        rays = directions(rng, 80)
        slow = [march(origin, d, 8.0, lambda p: in_cells(p, occupied, corner, size), STEP) for d in rays]
        fast = world.cast(origin, rays, 8.0)
        for d, a, b in zip(rays, slow, fast, strict=True):
            if not np.isfinite(a):  # at most the corner of a cell, which the march stepped over
                assert not np.isfinite(b) or not in_cells((origin + (b + STEP) * d)[None], occupied, corner, size)[0]
            elif abs(a - b) > STEP:  # it may have stepped over a corner before
                assert b < a and not in_cells((origin + (b + STEP) * d)[None], occupied, corner, size)[0]
            hits += int(np.isfinite(a))
    assert hits > 30


def test_inside_of_a_body_all_distances_are_0_and_beyond_the_range_infinite() -> None:
    sphere = np.concatenate([[1.0, 0, 0], np.eye(3).ravel(), np.zeros(3), [0.5]])
    world, rays = World(sphere[None], Motion.steady(np.zeros((1, 3)))), np.array([[1.0, 0, 0], [0, 1.0, 0]])
    assert np.array_equal(world.cast([1.2, 0, 0], rays, 5.0), [0.0, 0.0])
    assert np.allclose(world.cast([-1.0, 0, 0], rays, 5.0), [1.5, np.inf])
    assert np.array_equal(world.cast([-1.0, 0, 0], rays, 1.4), [np.inf, np.inf])


def test_moving_bodies_are_where_they_are_at_the_time() -> None:
    sphere = np.concatenate([[1.0, 0, 0], np.eye(3).ravel(), np.zeros(3), [0.5]])
    world = World(sphere[None], Motion.steady(np.array([[1.0, 0, 0]])))
    ahead = np.array([[1.0, 0, 0]])
    assert np.allclose(world.at(2.0).cast([0, 0, 0], ahead, 9.0), [2.5])
    assert np.allclose(world.at(0.0).cast([0, 0, 0], ahead, 9.0), [0.5])


def problem(constraints: list) -> Problem:
    cost = QuadraticCost(Q=[1.0] * 14, R=[1.0] * 4, Qf=[1.0] * 14, x_ref=[5.0] + [0.0] * 13)
    x0 = torch.zeros(2, 14, dtype=torch.float64)
    x0[:, 6], x0[:, 13] = 1.0, 9.81
    return Problem(QuadrotorPlanning(dt=0.05), cost, [*constraints, ControlBounds(-20.0, 20.0)], x0, N=5)


def test_a_world_is_that_of_its_problem_without_the_vehicle() -> None:
    nan = float("nan")
    spheres = Spheres([[3.0, 0, 0], [nan] * 3], [0.5, nan], 0.3, velocities=[[0, 1.0, 0], [nan] * 3])
    capsules = Capsules([[0, 3.0, -1]], [[0, 3.0, 1]], [0.4], 0.3)
    boxes = Boxes([[-3.0, 0, 0]], [[0.5, 0.6, 0.7]], 0.3)
    world = World.of(problem([spheres, capsules, boxes]), 1)
    rays = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
    assert np.allclose(world.cast([0, 0, 0], rays, 9.0), [2.5, 2.6, 2.5, np.inf])
    assert world.moving and np.allclose(world.at(0.6).cast([0, 0.6, 0], rays[:1], 9.0), [2.5])


def test_obstacles_without_rays_are_refused() -> None:
    class Fog(Obstacles):
        absent, vehicle_radius = torch.zeros(1, 1, dtype=torch.bool), torch.zeros(1)

    foggy: Any = SimpleNamespace(obstacles=[Fog()], take=lambda rows: foggy)
    with pytest.raises(InputError, match="spheres, boxes, capsules or a map"):
        World.of(foggy, 0)


def test_occupied_cells_of_a_map_are_seen() -> None:
    occupied = np.zeros((10, 8, 6), bool)
    occupied[7, 4, 3] = True
    world = World.of(problem([Field(OccupancyGrid(occupied, [-1.0, -1.0, -1.0], 0.25), 0.2)]), 1)
    ray = np.array([[1.0, 0, 0]])
    assert np.allclose(world.cast([-3.0, 0.1, -0.1], ray, 9.0), [3.75])  # the cell begins at 0.75
    assert np.isinf(world.cast([-3.0, -0.1, -0.1], ray, 9.0)).all()


def test_unknown_cells_of_a_map_are_what_the_field_says() -> None:
    cells = np.zeros((4, 4, 4))
    cells[2] = np.nan
    cases: list[tuple[Any, float]] = [("occupied", 0.5), ("free", np.inf)]
    for unknown, seen in cases:
        field = DistanceField.of(OccupancyGrid(cells, [0.0, 0.0, 0.0], 0.25), unknown=unknown)
        world = World.of(problem([Field(field, 0.0)]), 0)
        assert np.allclose(world.cast([0.0, 0.4, 0.4], np.array([[1.0, 0, 0]]), 9.0), [seen])


@pytest.mark.parametrize("many", [False, True])
def test_a_cloud_is_seen_as_cells(many: bool) -> None:
    """At most a cell's diagonal before its ball, and never behind it; a problem sees its own cloud."""
    points = np.array([[3.0, 0.0, 0.0], [3.1, 0.2, -0.1]])
    cloud = PointCloud(np.stack((points + 1.0, points)) if many else points, 0.2)
    world = World.of(problem([Field(cloud, 0.1)]), 1)
    seen = world.cast([0.0, 0.01, -0.02], np.array([[1.0, 0, 0], [0, 1.0, 0]]), 9.0)
    assert 2.8 - 0.2 * 3**0.5 < seen[0] <= 2.8 and seen[1] == np.inf


def test_a_second_map_is_refused() -> None:
    grid = OccupancyGrid(np.ones((1, 1, 1), bool), [5.0, 5.0, 5.0], 0.5)
    with pytest.raises(InputError, match="one map at most"):
        World.of(problem([Field(grid, 0.1)] * 2), 0)


def test_constraints_that_are_no_obstacles_are_not_seen() -> None:
    world = World.of(problem([FunctionConstraint(lambda x: x[..., :1] - 9.0)]), 0)
    assert len(world.boxes) == 0 and not world.moving
