"""Moving bodies: balls at later times, half-spaces, and what is followed in the returns of a lidar."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchgco import Goal, Problem, Spheres, compose
from torchgco.exploration.movers import Known, Moving, Tracks, clusters
from torchgco.exploration.sensing import Lidar, SeenMap, World
from torchgco.exploration.sensing.grid import FREE, OCCUPIED
from torchgco.exploration.sensing.sensors import Motion


def ball(center: list[float], radius: float) -> np.ndarray:
    return np.concatenate([center, np.eye(3).ravel(), np.zeros(3), [radius]])


def watched(
    velocity: list[float], steps: int, wall: bool = True, before: int = 8
) -> tuple[Tracks, World, SeenMap, float]:
    """What a lidar at rest has followed: a sphere in free space beside a wall, which it sees alone `before`."""
    boxes = [ball([5.0, -2.0, 0.0], 0.5)]
    if wall:
        boxes.append(np.concatenate([[8.0, 0.0, 0.0], np.eye(3).ravel(), [0.2, 6.0, 2.0], [0.0]]))
    world = World(np.array(boxes), Motion.steady(np.array([velocity, [0.0, 0.0, 0.0]])[: len(boxes)]))
    lidar, seen = Lidar(noise=0.01), SeenMap(np.array([-1.0, -6.0, -2.0]), (60, 60, 20), 0.2)
    tracks, without = Tracks(lidar.pitch), World(world.boxes[1:], world.motion.take(np.arange(1, len(boxes))))
    for step in range(-before, steps):
        now = world.at(0.1 * step) if step >= 0 else without
        scan = lidar.scan(now, [0.0, 0.0, 0.0], [1, 0, 0, 0], 0.0, (0, 0, step + 8))
        keep = tracks.observe(scan, seen, 0.1 * step)
        tracks.note(seen, seen.add(scan.take(keep), lidar.range, 0.03))
    return tracks, world, seen, 0.1 * (steps - 1)


def test_a_sphere_that_passes_is_followed() -> None:
    tracks, world, seen, t = watched([0.0, 2.0, 0.3], 12)
    (track,) = tracks.tracks
    place, size = world.at(t).boxes[0, :3], track.half + track.error  # a box around what is seen of the sphere
    assert np.abs(track.center - place).max() < 0.2 and (size > 0.4).all() and (size < 0.65).all()
    assert np.linalg.norm(track.velocity - [0.0, 2.0, 0.3]) < 0.2
    centers = seen.centers(np.flatnonzero(seen.state == OCCUPIED))
    assert len(centers) > 100 and (np.abs(centers[:, 0] - 7.9) < 0.3).all()  # the wall alone
    gone = tracks.now(t + 0.5)
    assert np.linalg.norm(gone.centers[0] - world.at(t + 0.5).boxes[0, :3]) < 0.3


def test_a_sphere_that_moves_from_the_first_scan_on_is_followed_too() -> None:
    """Its first returns lie in cells that never were free: they aren't those of a surface yet."""
    tracks, world, _, t = watched([0.0, 2.0, 0.3], 12, wall=False, before=0)
    now, place = tracks.now(t), world.at(t).boxes[0, :3]
    assert len(now.radii) > 0 and now.gaps(place[None], np.zeros(1))[0] < 0.0
    for track in tracks.tracks:  # one of them, or one of each part that the first scan saw apart
        assert np.linalg.norm(track.center - place) < 0.5
        assert np.linalg.norm(track.velocity - [0.0, 2.0, 0.3]) < 0.2


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
            np.linalg.norm(p - c - s * v) - r - 0.05 * s**2
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
    a, b = np.full((4, 3), 0.5), np.full((3, 3), 3.0)
    found = clusters(np.concatenate([a, [[9.0, 9.0, 0.0]], b]), np.zeros(3), 0.05)
    assert sorted(map(len, found)) == [3, 4]
    assert clusters(np.zeros((0, 3)), np.zeros(3), 0.05) == []


def test_bodies_are_parted_where_they_are_close() -> None:
    """Two bodies 0.4 m from each other: at 4 m rays lie 0.2 m apart and tell them, at 16 m 0.8 m apart, and don't."""
    sides = np.linspace(0.0, 0.6, 4)[:, None] * [0.0, 1.0, 0.0]
    both = np.concatenate([sides, sides + np.array([0.0, 1.0, 0.0])])
    assert [len(clusters(both + np.array([far, 0.0, 0.0]), np.zeros(3), 0.05)) for far in (4.0, 16.0)] == [2, 1]


def test_a_body_is_as_deep_as_it_is_wide() -> None:
    world = World(np.array([ball([4.0, 1.0, 0.5], 0.6)]), Motion.steady(np.zeros((1, 3))))
    lidar = Lidar(rays=(720, 180), noise=0.0)
    scan = lidar.scan(world, [0.0, 0.0, 0.0], [1, 0, 0, 0], 0.0, (0, 0, 0))
    hit = np.isfinite(scan.distances)
    low, high, _ = Tracks(lidar.pitch)._seen_box(scan.distances[hit, None] * scan.directions[hit], np.zeros(3))
    assert np.allclose(low, [3.4, 0.4, -0.1], atol=0.1) and np.allclose(high, [4.6, 1.6, 1.1], atol=0.1)


@pytest.mark.parametrize("half", [[0.2, 2.0, 0.2], [0.2, 0.2, 2.0], [2.0, 0.2, 0.2]])
def test_a_bar_at_rest_that_comes_into_sight_bit_by_bit_does_not_move(half: list[float]) -> None:
    """The nearer a vehicle comes, the more rays end on a bar: what they show of it grows, and it isn't farther away."""
    bar = np.concatenate([[16.0, 0.5, 0.0], np.eye(3).ravel(), half, [0.0]])
    world, lidar = World(bar[None], Motion.steady(np.zeros((1, 3)))), Lidar()
    seen = SeenMap(np.array([-1.0, -6.0, -3.0]), (120, 60, 30), 0.2)
    for cells in (seen.odds, seen.state):
        cells[:] = -1.0 if cells is seen.odds else FREE
    tracks = Tracks(lidar.pitch)
    tracks.note(seen, np.zeros(0, np.int32))
    fastest = []
    for step in range(26):
        scan = lidar.scan(world, [0.47 * step, 0.0, 0.0], [1, 0, 0, 0], 0.0, (0, 0, step))
        keep = tracks.observe(scan, seen, 0.1 * step)
        tracks.note(seen, seen.add(scan.take(keep), lidar.range, 0.06))
        fastest.append(max((float(np.linalg.norm(track.velocity)) for track in tracks.tracks), default=0.0))
    assert max(fastest) < 0.75
