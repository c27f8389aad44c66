"""Vehicles that drive along their heading: which are recognised, and how they are driven along ways."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch
from tests.search.test_tube import room
from torchgco import (
    ControlBounds,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    StateBounds,
    Unicycle,
    judge,
    solve,
)
from torchgco.baselines.drivers import Track, drive_unicycle
from torchgco.dynamics import Dynamics
from torchgco.dynamics.rollout import open_loop
from torchgco.roadmap.clear import evenly, smoothed
from torchgco.roadmap.lattice import Array
from torchgco.search.steering import WITHIN, Steered, Tracks, driven, speed_limit, steered

D = torch.float64
CORNER = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0]])
AHEAD = 10


def moved(x: Tensor, u: Tensor) -> Tensor:
    """A unicycle with its states and controls in another order, and one state more."""
    heading, speed, _ = x[..., 2:].unbind(-1)
    turn, push = u.unbind(-1)
    return torch.stack((speed * heading.cos(), speed * heading.sin(), turn, 2.0 * push, turn), dim=-1)


def car(x: Tensor, u: Tensor) -> Tensor:
    heading, speed = x[..., 2], x[..., 3]
    turn = speed * u[..., 1].tan() / 0.5
    return torch.stack((speed * heading.cos(), speed * heading.sin(), turn, u[..., 0]), dim=-1)


def model(field, n: int = 4, integrator: str = "rk4") -> Dynamics:
    return FunctionDynamics(field, n, 2, 0.1, integrator, position=slice(0, 2))


def problem(dynamics: Dynamics, N: int = 150, rows: tuple = (), x0: tuple[float, ...] = ()) -> Problem:
    n = dynamics.n
    start = torch.tensor([[*x0, *[0.0] * (n - len(x0))]], dtype=D)
    cost = QuadraticCost([1.0] * n, [1.0, 1.0], [9.0] * n)
    return Problem(dynamics, cost, [ControlBounds([-2.0, -0.7], [2.0, 0.7]), *rows], start, N, Goal([6.0, 5.0], 0.3))


def tracks(vehicle: Steered, way: Array, speed: float, backward: bool = False, limited: bool = True) -> Tracks:
    points = smoothed(evenly(way, 0.05), 10.0)
    step = float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())
    limit = speed_limit(vehicle, points, step, AHEAD) if limited else np.full(len(points), np.inf)
    ends, steps, speeds = np.array([len(points) - 1]), np.array([step]), np.array([speed])
    return Tracks(points[None], ends, steps, AHEAD, speeds, limit[None], np.array([backward]))


def test_vehicles_are_recognised_by_their_equations() -> None:
    unicycle, other, wheels = (steered(problem(one)) for one in (Unicycle(dt=0.1), model(moved, 5), model(car)))
    assert unicycle is not None and other is not None and wheels is not None
    assert (unicycle.heading, unicycle.speed, unicycle.push.control, unicycle.turn.control) == (2, 3, 0, 1)
    assert (other.heading, other.speed, other.push.control, other.turn.control) == (2, 3, 1, 0)
    assert not unicycle.by_curvature and not other.by_curvature and wheels.by_curvature
    assert unicycle.turn.effect[-1] == pytest.approx(0.7 * WITHIN)
    assert other.push.effect[-1] == pytest.approx(1.4 * WITHIN)
    assert wheels.turn.effect[-1] == pytest.approx(np.tan(0.7 * WITHIN) / 0.5)
    assert wheels.turn.inverse(np.array([0.4]))[0] == pytest.approx(np.arctan(0.2), abs=1e-4)
    slow = StateBounds([-torch.inf] * 3 + [-0.5], [torch.inf] * 3 + [1.5])
    assert steered(problem(Unicycle(dt=0.1), rows=(slow,))).fastest == (-0.5, 1.5)  # type: ignore[union-attr]


def test_other_models_are_not() -> None:
    def drifting(x: Tensor, u: Tensor) -> Tensor:
        return car(x, u) + 0.01

    def braked(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((car(x, u)[..., :3], u[..., :1] - 0.3 * x[..., 3:]), dim=-1)

    def thrusters(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 2:], u), dim=-1)

    def both(x: Tensor, u: Tensor) -> Tensor:  # two wheels: each control turns and pushes
        return torch.cat((car(x, u)[..., :2], u[..., :1] - u[..., 1:], u[..., :1] + u[..., 1:]), dim=-1)

    def steers(x: Tensor, u: Tensor) -> Tensor:  # the angle of the wheels is a state
        return torch.cat((car(x, x[..., 4:].expand(*x.shape[:-1], 2))[..., :3], u), dim=-1)

    assert steered(planar_batch(B=1)[0]) is None
    for one in (model(drifting), model(braked), model(thrusters), model(both), model(steers, 5)):
        assert steered(problem(one)) is None
    assert steered(problem(model(Unicycle(dt=0.1).step, integrator="none"))) is None


def test_it_drives_as_a_plain_loop_does() -> None:
    """The driver of `path_pursuit`, written for one unicycle and one way, without limits in bends."""
    own = problem(Unicycle(dt=0.1), x0=(0.1, -0.2, 0.5, 0.0))
    vehicle = steered(own)
    assert vehicle is not None
    some = tracks(vehicle, CORNER, 1.1, limited=False)
    braking = 1.1 / (0.1 * 15.0)
    plain = drive_unicycle(own, Track(some.points[0], float(some.step[0]), AHEAD, 1.1, braking))
    np.testing.assert_allclose(driven(own, vehicle, some)[0], plain, atol=1e-9)


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["unicycle", "car"])
def test_it_keeps_to_the_way_without_cusps(name: str, integrator: str, backward: bool) -> None:
    field = car if name == "car" else Unicycle(dt=0.1).field
    own = problem(model(field, integrator=integrator), x0=(0.0, 0.0, np.pi if backward else 0.0, 0.0))
    vehicle = steered(own)
    assert vehicle is not None
    some = tracks(vehicle, CORNER, 1.0, backward)
    U = driven(own, vehicle, some)
    assert bool((np.abs(U) <= [2.0, 0.7]).all())
    X = open_loop(own.dynamics, own.x0, torch.tensor(U))[0].numpy()
    apart = np.linalg.norm(X[:, None, :2] - some.points[0], axis=-1).min(1)
    assert apart.max() < 0.3 and np.linalg.norm(X[-1, :2] - CORNER[-1]) < 0.3 and abs(X[-1, 3]) < 0.1
    assert bool((X[:, 3] * (-1 if backward else 1) > -0.02).all())


def test_speeds_slow_down_in_time_for_bends() -> None:
    vehicle = steered(problem(Unicycle(dt=0.1)))
    assert vehicle is not None
    angle = np.linspace(0.0, np.pi, 200)
    bend = np.stack((10.0 + 2.0 * np.sin(angle), 2.0 - 2.0 * np.cos(angle)), axis=1)
    points = evenly(np.concatenate((np.array([[0.0, 0.0]]), bend)), 0.05)
    limit = speed_limit(vehicle, points, 0.05, AHEAD)
    inside = points[:, 0] > 10.5
    np.testing.assert_allclose(limit[inside][:-AHEAD], 0.7 * WITHIN * 2.0, rtol=0.02)
    braking, at = 2.0 * WITHIN, int(np.argmin(abs(points[:, 0] - 8.0)))
    before = [min(limit[j] ** 2 + 2.0 * braking * 0.05 * (j - i) for j in range(i, len(points))) for i in (at, at + 9)]
    np.testing.assert_allclose(limit[[at, at + 9]], np.sqrt(before))
    # The bend begins at 10 m, and is seen over 0.25 m to both sides.
    slowest, fastest = (np.sqrt((0.7 * WITHIN * 2.0) ** 2 + 2.0 * braking * way) for way in (1.75, 2.25))
    assert slowest < limit[at] < fastest
    assert bool((speed_limit(steered(problem(model(car))), points, 0.05, AHEAD) == np.inf).all())  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_car_finds_through_the_rooms_of_a_map() -> None:
    own = room(model=model(car), N=150)
    verdict = judge(own, solve(own).U)
    assert bool(verdict.reached.all())
