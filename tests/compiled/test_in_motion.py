"""Obstacles that move while a loop runs: in every period they are where they have gone since the last one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.fleets.scenes import DT, disc
from torchgco import (
    MPC,
    MPPI,
    Boxes,
    Ellipsoids,
    Fleet,
    FleetMPC,
    InputError,
    Moved,
    MPPIController,
    OscillatingBoxes,
    Spheres,
)

N, ROOM = 20, 0.2  # stages of 0.1 s; the vehicle's radius, m
KINDS = ["spheres", "ellipsoids", "moved"]


def passing(kind: str, seed: int, t: float = 0.0) -> tuple[Any, dict[str, Any]]:
    """Two obstacles that come by, and where they are t seconds later, by the names of their numbers."""
    random = np.random.default_rng(seed)
    centers, velocities = (
        random.uniform(-0.5, 0.5, (2, 2)) + np.array([[0.3, -2.0], [-0.4, 2.5]]),
        random.uniform(-0.2, 0.2, (2, 2)),
    )
    velocities[:, 1] += [1.0, -1.2]
    path = centers + DT * np.arange(N + 1)[:, None, None] * velocities
    times, k = np.arange(N + 1) * DT, np.minimum(np.arange(N + 1) * DT + t, N * DT)
    later = np.stack([[np.interp(k, times, path[:, i, j]) for j in range(2)] for i in range(2)]).transpose(2, 0, 1)
    made = {
        "spheres": lambda: Spheres(centers, 0.2, ROOM, velocities),
        "ellipsoids": lambda: Ellipsoids(centers, [[0.2, 0.3]] * 2, ROOM, velocities=velocities),
        "moved": lambda: Moved(path, 0.2, ROOM),
    }
    return made[kind](), {"places": later} if kind == "moved" else {"centers": centers + t * velocities}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("seed", "period"), [(0, 0.1), (1, 0.04), (2, 0.15)])
def test_a_loop_that_isnt_told_is_the_one_that_is(kind: str, seed: int, period: float) -> None:
    problem = disc([0.0, 0.0], [0.5, 0.0], passing(kind, seed)[0], N=N)
    alone, told = (MPC(problem, period=period, max_seconds=float("inf")) for _ in range(2))
    controller, other = (MPPIController(problem, MPPI(samples=20), period=period) for _ in range(2))
    x = problem.x0
    for k in range(round(2.4 / period)):
        new = passing(kind, seed, k * period)[1]
        u = alone.step(x)
        torch.testing.assert_close(u, told.step(x, **new), rtol=0, atol=1e-5)
        for name, values in new.items():
            np.testing.assert_allclose(alone.numbers[name][0], values, atol=1e-9)
        if k < 4:
            torch.testing.assert_close(controller.command(x), other.command(x, **new), rtol=0, atol=1e-9)
        x = torch.cat((x[:, :2] + period * x[:, 2:] + 0.5 * period**2 * u, x[:, 2:] + period * u), dim=-1)
    with pytest.raises(InputError):
        alone.step(x, u_ref="wrong")
    alone.step(x)  # as if nothing had been said
    later = passing(kind, seed, (k + 1) * period)[1]
    np.testing.assert_allclose(alone.numbers[name][0], later[name], atol=1e-9)
    alone.step(x, **{name: new[name]})
    alone.numbers[name] = values + 0.1  # by hand: as of the next step
    alone.step(x)
    np.testing.assert_array_equal(alone.numbers[name][0], values + 0.1)
    alone.reset()
    np.testing.assert_allclose(alone.numbers[name][0], passing(kind, seed)[1][name], atol=1e-9)


def test_a_fleet_lets_pass_what_moves() -> None:
    """It stood still for every plan but the first, and was flown through, 0.46 m deep."""
    coming = Spheres([[0.05, -3.0]], 0.3, 0.2, velocities=[[0.0, 1.0]])
    fleet = Fleet([disc([0.0, 0.0], [0.0, 0.0], coming), disc([3.0, 1.5], [3.0, 1.5], coming)], apart=0.4)
    mpc, x, least = FleetMPC(fleet), [one.x0 for one in fleet.members], np.inf
    for k in range(40):
        u = mpc.step(x)
        for h in np.linspace(0.0, DT, 11):
            p = (x[0][0, :2] + h * x[0][0, 2:] + 0.5 * h * h * u[0][0]).numpy()
            least = min(least, float(np.hypot(p[0] - 0.05, p[1] + 3.0 - k * DT - h)))
        x = [one.dynamics.step(state, control) for one, state, control in zip(fleet.members, x, u, strict=True)]
    assert least > 0.95 * 0.5


def test_what_a_loop_cant_move_on_is_refused() -> None:
    boxes = Boxes([[0.0, 2.0]], [[0.2, 0.2]], ROOM)
    swinging = OscillatingBoxes(boxes, [[[0.0, 1.0]]], [[[1.0, 1.0]]], [[[0.0, 0.0]]])
    absent = Spheres([[0.0, 2.0], [np.nan, np.nan]], 0.2, ROOM, velocities=[[0.0, -1.0], [0.0, 0.0]])
    for part in (swinging, absent):
        problem = disc([0.0, 0.0], [0.5, 0.0], part, N=N)
        for make in (MPC, MPPIController):
            with pytest.raises(
                InputError, match=r"problem.constraints\[0\]: expected obstacles in a loop that rest, or"
            ):
                make(problem)
    one = disc([0.0, 0.0], [0.5, 0.0], N=N)
    along = torchgco.QuadraticCost([1.0] * 4, [0.1] * 2, [1.0] * 4, np.zeros((N + 1, 4)))
    other = torchgco.Problem(one.dynamics, along, [], [[2.0, 0.0, 0.0, 0.0]], N)
    with pytest.raises(
        InputError, match=r"fleet.vehicles\[1\].cost.x_ref: expected one for all knots: a step takes no"
    ):
        FleetMPC(Fleet([one, other], apart=0.4))
    problem = disc([0.0, 0.0], [0.5, 0.0], passing("spheres", 0)[0], N=N)
    assert "centers" in MPC(problem, changes=["radii"]).numbers.short("constraints[0].centers")
