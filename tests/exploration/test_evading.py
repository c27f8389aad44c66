"""Ways around moving bodies, distances from boxes that swing, and half-spaces that stay clear after a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchgco.exploration.evading import evaded
from torchgco.exploration.movers import Known, Moving
from torchgco.exploration.reference import Pace
from torchgco.exploration.sensing import World
from torchgco.exploration.sensing.sensors import Motion

DT, KEEP, HOLD, PACE = 0.05, 0.3, 1.0, Pace(4.7, 5.0, 3.5)
LINE = np.column_stack([4.0 * DT * np.arange(61), np.zeros(61), np.full(61, 2.0)])  # 4 m/s for 3 s


def swinging(seed: int, count: int = 9) -> tuple[Moving, np.ndarray, Motion]:
    """Boxes along the axes that swing, some of them with a velocity: as known, where they are placed, and how."""
    rng = np.random.default_rng(seed)
    boxes = np.zeros((count, 16))
    boxes[:, :3], boxes[:, 3:12] = rng.uniform([2, -2, 1], [12, 2, 3], (count, 3)), np.eye(3).ravel()
    boxes[:, 12:15], boxes[:, 15] = rng.uniform(0.2, 0.6, (count, 3)), rng.uniform(0, 0.2, count)
    sines = rng.uniform(-1, 1, (count, 2, 3)), rng.uniform(0.2, 1, (count, 2, 3)), rng.uniform(0, 6, (count, 2, 3))
    motion = Motion(rng.uniform(-0.5, 0.5, (count, 3)), *sines)
    return Known(World(boxes, motion)).now(0.0), boxes, motion


def around(moving: Moving, static: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The way along the line at 4 m/s."""
    return evaded(LINE, np.array([4.0, 0.0, 0.0]), [4.0, 4.0, 8.0], moving, static, KEEP, DT, HOLD, PACE)


def far(points: np.ndarray) -> np.ndarray:
    """Nothing at rest is near."""
    return np.full(len(points), 9.0)


def distance(boxes: np.ndarray, motion: Motion, p: np.ndarray, t: float) -> np.ndarray:
    """Of one point (3,) at time t from each box, (M,), box by box."""
    found = []
    for m, box in enumerate(boxes):
        place = box[:3] + t * motion.velocities[m]
        for s in range(motion.amplitudes.shape[1]):
            place = place + motion.amplitudes[m, s] * np.sin(motion.rates[m, s] * t + motion.phases[m, s])
        over = np.abs(p - place) - box[12:15]
        found.append(np.linalg.norm(np.maximum(over, 0)) + min(over.max(), 0.0) - box[15])
    return np.array(found)


def test_known_boxes_are_boxes_where_they_will_be() -> None:
    moving, boxes, motion = swinging(0)
    later = Known(World(boxes, motion)).now(0.7)
    rng = np.random.default_rng(1)
    points, t = rng.uniform([2, -2, 1], [12, 2, 3], (60, 3)), rng.uniform(0, 3, 60)
    for own, at in ((moving, 0.0), (later, 0.7)):
        expected = np.array([distance(boxes, motion, p, s + at).min() for p, s in zip(points, t, strict=True)])
        assert np.allclose(own.gaps(points, t), expected)
        planes = own.planes(points, t, 3)
        gaps = np.einsum("kri,ki->kr", planes[..., :3], points) - planes[..., 3]
        assert np.allclose(gaps[:, 0], expected) and np.allclose(np.linalg.norm(planes[..., :3], axis=-1), 1.0)


def test_bodies_that_come_into_a_box_are_found() -> None:
    moving, *_ = swinging(2, 40)
    low, high = np.array([4.0, -0.5, 1.8]), np.array([5.0, 0.5, 2.2])
    some = moving.within(low, high, 3.0)
    assert 0 < len(some.radii) < 40
    points = np.random.default_rng(0).uniform(low, high, (200, 3))
    t = np.linspace(0, 3, 200)
    near = moving.gaps(points, t)
    assert np.allclose(some.gaps(points, t)[near < 0], near[near < 0]) and (near < 0).any()


def test_a_last_point_stays_clear() -> None:
    """A ball comes to the last point a second after the plan's end: its half-space is that of then."""
    ball = Moving.balls(np.array([[8.0, 0.0, 2.0]]), np.array([[-1.0, 0.0, 0.0]]), np.array([0.5]))
    points, t = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0]]), np.array([1.0, 2.0])
    assert np.allclose(ball.planes(points, t, 1)[1, 0], [-1, 0, 0, -5.5])
    assert np.allclose(ball.planes(points, t, 1, HOLD)[1, 0], [-1, 0, 0, -4.5])
    assert np.allclose(ball.planes(points, t, 1, HOLD)[0], ball.planes(points, t, 1)[0])


def test_a_clear_way_stays_as_it_is() -> None:
    away = Moving.balls(np.array([[6.0, 9.0, 2.0]]), np.zeros((1, 3)), np.array([0.5]))
    assert around(away, far) is LINE


def test_ways_lead_around_what_would_be_met() -> None:
    t, found = DT * np.arange(61), 0
    for seed in range(12):
        moving, boxes, motion = swinging(seed, 5)
        before = moving.gaps(LINE, t)
        if before[:10].min() < 1.0 or before.min() > KEEP:
            continue
        found += 1
        way = around(moving, far)
        gaps = [distance(boxes, motion, p, s).min() for p, s in zip(way, t, strict=True)]
        assert min(gaps) > KEEP - 0.15 and np.allclose(way[0], LINE[0])  # the lattice keeps it, the spline nearly
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.5
    assert found >= 4


def test_a_way_waits_where_it_can_not_pass() -> None:
    """A ball crosses the way from below; what rests bars all places aside."""
    ball = Moving.balls(np.array([[6.0, 0.0, -1.0]]), np.array([[0.0, 0.0, 2.0]]), np.array([0.4]))
    beside = lambda p: np.where(np.abs(p[:, 1]) + np.abs(p[:, 2] - 2.0) > 0.2, 0.0, 9.0)
    way, t = around(ball, beside), DT * np.arange(61)
    assert ball.gaps(LINE, t).min() < KEEP
    assert ball.gaps(way, t).min() > ball.gaps(LINE, t).min() + 0.4 and way[30, 0] < LINE[30, 0] - 0.5
    assert np.abs(way[:, 1]).max() < 1e-9


def test_a_way_begins_with_the_velocity_and_ends_at_rest() -> None:
    """A ball that rests on the line, and grows as fast as a vehicle that follows the line would come to it."""
    ball = Moving.balls(np.array([[7.0, 0.0, 2.0]]), np.zeros((1, 3)), np.array([0.5]), growth=0.5)
    way, t = around(ball, far), DT * np.arange(61)
    assert ball.gaps(LINE, t).min() < 0.0 and ball.gaps(way, t).min() > KEEP - 0.15
    assert np.allclose(way[1] - way[0], [4.0 * DT, 0.0, 0.0], atol=0.03) and np.allclose(way[-1], way[-2], atol=0.02)


def test_where_bodies_bar_all_ways_by_what_they_may_do_those_they_bar_now_count() -> None:
    """Balls 1.6 m apart on all sides leave ways between them, and none once they have grown."""
    centers = np.stack(np.meshgrid(*[1.6 * np.arange(-4.5, 10.0)] * 3), axis=-1).reshape(-1, 3) + LINE[0]
    balls, t = Moving.balls(centers, np.zeros_like(centers), np.full(len(centers), 0.3), growth=1.0), DT * np.arange(61)
    now = replace(balls, growth=0.0)
    way = around(balls, far)
    assert way is not LINE and balls.gaps(LINE, t).min() < 0.0 and now.gaps(way, t).min() > KEEP - 0.15


def test_a_way_keeps_away_from_bodies_as_wide_as_they_will_be() -> None:
    """The farther ahead, the wider: the lattice has each of them at its time."""
    body = Moving.balls(np.array([[8.0, 0.0, 2.0]]), np.zeros((1, 3)), np.array([0.4]))
    t, grown = DT * np.arange(len(LINE)), replace(body, growth=0.3)
    for bodies in (body, grown):
        way = around(bodies, far)
        assert bodies.gaps(way, t).min() > KEEP - 0.05
    assert grown.gaps(around(body, far), t).min() < KEEP - 0.1
