"""Moving bodies: balls at later times, half-spaces, and what is followed in the returns of a lidar."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchgco import Goal, Problem, Spheres, compose
from torchgco.exploration.movers import Known, Moving, Tracks, clusters, seen_ball
from torchgco.exploration.sensing import Lidar, SeenMap, World
from torchgco.exploration.sensing.grid import OCCUPIED
from torchgco.exploration.sensing.sensors import Motion


def ball(center: list[float], radius: float) -> np.ndarray:
    return np.concatenate([center, np.eye(3).ravel(), np.zeros(3), [radius]])


def watched(velocity: list[float], steps: int, wall: bool = True) -> tuple[Tracks, World, SeenMap, float]:
    """What a lidar at rest has followed: a sphere in free space beside a wall."""
    boxes = [ball([5.0, -2.0, 0.0], 0.5)]
    if wall:
        boxes.append(np.concatenate([[8.0, 0.0, 0.0], np.eye(3).ravel(), [0.2, 6.0, 2.0], [0.0]]))
    world = World(np.array(boxes), Motion.steady(np.array([velocity, [0.0, 0.0, 0.0]])[: len(boxes)]))
    lidar, seen = Lidar(noise=0.01), SeenMap(np.array([-1.0, -6.0, -2.0]), (60, 60, 20), 0.2)
    tracks, without = Tracks(lidar.pitch), World(world.boxes[1:], world.motion.take(np.arange(1, len(boxes))))
    for step in range(-8, steps):  # at first without the sphere
        now = world.at(0.1 * step) if step >= 0 else without
        scan = lidar.scan(now, [0.0, 0.0, 0.0], [1, 0, 0, 0], 0.0, (0, 0, step + 8))
        keep = tracks.observe(scan, seen, 0.1 * step)
        tracks.note(seen, seen.add(scan.take(keep), lidar.range, 0.03))
    return tracks, world, seen, 0.1 * (steps - 1)


def test_a_sphere_that_passes_is_followed() -> None:
    tracks, world, seen, t = watched([0.0, 2.0, 0.3], 12)
    (track,) = tracks.tracks
    assert np.linalg.norm(track.center - world.at(t).boxes[0, :3]) < 0.15
    assert np.linalg.norm(track.velocity - [0.0, 2.0, 0.3]) < 0.4 and 0.45 < track.radius < 0.65
    centers = seen.centers(np.flatnonzero(seen.state == OCCUPIED))
    assert len(centers) > 100 and (np.abs(centers[:, 0] - 7.9) < 0.3).all()  # the wall alone
    gone = tracks.now(t + 0.5)
    assert np.linalg.norm(gone.centers[0] - world.at(t + 0.5).boxes[0, :3]) < 0.3


def test_what_stays_where_it_appears_goes_into_the_map() -> None:
    tracks, _, seen, _ = watched([0.0, 0.0, 0.0], 14)
    assert tracks.tracks == []
    centers = seen.centers(np.flatnonzero(seen.state == OCCUPIED))
    assert (np.abs(np.linalg.norm(centers - [5.0, -2.0, 0.0], axis=1) - 0.5) < 0.3).sum() > 5


def test_a_world_at_rest_has_no_tracks() -> None:
    tracks, *_ = watched([0.0, 0.0, 0.0], 0)
    assert tracks.tracks == []


def test_known_bodies_are_where_they_are() -> None:
    spheres = Spheres(
        [[[2.0, 0.0, 0.0], [0.0, 5.0, 0.0]]], [[0.5, 0.5]], 0.3, velocities=[[[0.0, 1.0, 0.0], [0.0] * 3]]
    )
    setup = compose(["scenario=forest"])
    task = setup.task(setup.layouts(1)).problem
    problem = Problem(task.dynamics, task.cost, [spheres], task.x0, 20, Goal(torch.zeros(1, 3).double(), 0.4))
    moving = Known(World.of(problem, 0)).now(2.0)
    assert np.allclose(moving.centers, [[2.0, 2.0, 0.0]]) and np.allclose(moving.radii, 0.5)
    assert moving.holds(np.array([[2.0, 2.7, 0.0], [2.0, 3.0, 0.0]])).tolist() == [True, False]


def test_half_spaces_and_gaps_agree_with_the_balls() -> None:
    rng = np.random.default_rng(0)
    moving = Moving.balls(rng.uniform(-3, 3, (6, 3)), rng.uniform(-1, 1, (6, 3)), rng.uniform(0.2, 0.6, 6), growth=0.1)
    points, t = rng.uniform(-3, 3, (50, 3)), rng.uniform(0, 2, 50)
    slow = [
        [
            np.linalg.norm(p - c - s * v) - r - 0.1 * s
            for c, v, r in zip(moving.centers, moving.motion.velocities, moving.radii, strict=True)
        ]
        for p, s in zip(points, t, strict=True)
    ]
    assert np.allclose(moving.gaps(points, t), np.min(slow, axis=1))
    planes = moving.planes(points, t, 2)
    own = np.einsum("kri,ki->kr", planes[..., :3], points) - planes[..., 3]
    assert np.allclose(own, np.sort(slow, axis=1)[:, :2])
    assert moving.planes(points, t, 9).shape == (50, 9, 4) and (moving.planes(points, t, 9)[:, 6:] == 0).all()


def test_returns_are_joined_to_clusters_and_single_ones_left_out() -> None:
    a, b = np.full((4, 3), 0.1), np.full((3, 3), 3.0)
    found = clusters(np.concatenate([a, [[9.0, 9.0, 9.0]], b]))
    assert sorted(map(len, found)) == [3, 4]
    assert clusters(np.zeros((0, 3))) == []


def test_a_ball_is_found_from_its_near_side() -> None:
    world = World(np.array([ball([4.0, 1.0, 0.5], 0.6)]), Motion.steady(np.zeros((1, 3))))
    lidar = Lidar(rays=(720, 180), noise=0.0)
    scan = lidar.scan(world, [0.0, 0.0, 0.0], [1, 0, 0, 0], 0.0, (0, 0, 0))
    hit = np.isfinite(scan.distances)
    center, radius = seen_ball(scan.distances[hit, None] * scan.directions[hit], np.zeros(3), lidar.pitch)
    assert np.linalg.norm(center - [4.0, 1.0, 0.5]) < 0.06 and radius == pytest.approx(0.6, abs=0.05)
