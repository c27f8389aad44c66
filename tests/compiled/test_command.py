"""MPPI in a loop: a command is a round of `MPPI.improve` around the plan before, moved on by the period."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from torchgco import MPPI, ControlBounds, FunctionDynamics, InputError, MPPIController, Problem, QuadraticCost, Spheres
from torchgco.base.draws import DrawKey

DT, N = 0.05, 30
SAMPLER = MPPI(samples=300, covariance=4.0, temperature=0.5)


def pendulum(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return torch.stack((x[..., 1], 9.81 * x[..., 0].sin() - 0.1 * x[..., 1] + u[..., 0]), -1)


MODEL = FunctionDynamics(pendulum, 2, 1, DT, "rk4")


def held_up(x0: Any, **more: Any) -> Problem:
    return Problem(MODEL, QuadraticCost([10, 1], [0.1], [50, 5]), [ControlBounds([-15.0], [15.0])], x0, N)


def test_a_command_is_a_round_around_the_plan_before() -> None:
    x = torch.tensor([[0.4, 0.0], [-0.3, 0.1]]).double()
    controller, ids = MPPIController(held_up(x), SAMPLER, seed=3), torch.arange(2)
    U = torch.zeros(2, N, 1).double()
    for k in range(3):
        if k:
            U = torch.cat((U[:, 1:], U[:, -1:]), dim=1)
        _, U = SAMPLER.improve(held_up(x), U, DrawKey(3, ids, torch.full_like(ids, k)))
        u = controller.command(x.numpy())
        assert torch.equal(controller.U, U) and torch.equal(u, U[:, 0])
        x = MODEL.step(x, u)
    _, again = SAMPLER.improve(held_up(x), U, DrawKey(3, ids, torch.full_like(ids, 3)))
    controller.command(x, shift=False)
    assert torch.equal(controller.U, again)


def test_it_balances_and_repeats_itself() -> None:
    controller, x = MPPIController(held_up([[0.0, 0.0]]), SAMPLER), np.array([0.6, 0.0])
    first, start = controller.command(x), x
    for _ in range(80):
        u = controller.command(x)
        assert u.shape == (1,)
        x = MODEL.step(torch.tensor(x), u).numpy()
    assert np.abs(x).max() < 0.2
    controller.reset()
    assert torch.equal(controller.command(start), first)
    controller.reset(U=np.ones((N, 1)))
    assert torch.equal(controller.U, torch.ones(1, N, 1).double())


def test_new_numbers_count_at_once() -> None:
    """Obstacles, references and bounds that a command names are those of a problem made with them."""
    point = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))

    def made(goal: list[float], center: list[float], upper: float) -> Problem:
        parts = [ControlBounds([-2.0, -2.0], [upper, 2.0]), Spheres([center], [0.5], 0.1)]
        return Problem(point, QuadraticCost([1, 1], [0.01, 0.01], [10, 10], x_ref=goal), parts, [[0.0, 0.0]], 20)

    controller = MPPIController(made([3.0, 0.0], [9.0, 0.0], 2.0), SAMPLER)
    goal = np.tile([2.0, 1.0], (21, 1))
    u = controller.command([0.1, 0.0], x_ref=goal, centers=[[1.0, 0.4]], upper=[1.0, 2.0])
    want = MPPIController(made([2.0, 1.0], [1.0, 0.4], 1.0), SAMPLER)
    assert torch.equal(u, want.command([0.1, 0.0]))
    assert controller.numbers["centers"].tolist() == [[[1.0, 0.4]]]


def test_a_vehicle_flies_as_alone() -> None:
    x = np.array([[0.4, 0.0], [-0.3, 0.1], [0.2, 0.2]])
    fleet, alone = MPPIController(held_up(x), SAMPLER), MPPIController(held_up(x[:1]), SAMPLER)
    for _ in range(3):
        assert torch.equal(fleet.command(x)[0], alone.command(x[0]))


def test_half_a_stage() -> None:
    controller = MPPIController(held_up([[0.2, 0.0]]), SAMPLER, period=DT / 2)
    controller.command([0.2, 0.0])
    U = controller.U
    want = 0.5 * (U + torch.cat((U[:, 1:], U[:, -1:]), dim=1))
    controller.sampler = MPPI(samples=2, covariance=1e-20)
    controller.command([0.2, 0.0])
    torch.testing.assert_close(controller.U, want, rtol=0, atol=1e-8)


def test_a_period_of_several_stages() -> None:
    """The vehicle gets the mean of what the plan flies until the next command."""
    controller = MPPIController(held_up([[0.4, 0.0]]), SAMPLER, period=2.5 * DT)
    u, U = controller.command([0.4, 0.0]), controller.U[0]
    torch.testing.assert_close(u, (U[0] + U[1] + 0.5 * U[2]) / 2.5, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda c: c.command([0.0]), r"x: expected shape \(1, 2\), or \(2,\) for all vehicles, got \(1,\)"),
        (lambda c: c.command([math.nan, 0.0]), "x: expected finite states, got NaN or infinity"),
        (lambda c: c.command([0.0, 0.0], speed=1.0), "numbers: expected one of x0, x_ref"),
        (lambda c: c.reset(U=np.zeros((N + 1, 1))), r"U: expected shape \(30, 1\)"),
        (lambda c: MPPIController(held_up([[0.0, 0.0]]), "mppi"), "sampler: expected"),
        (lambda c: MPPIController(held_up([[0.0, 0.0]]), MPPI(covariance=[1.0, 2.0])), "mppi.covariance: expected"),
    ],
)
def test_a_mistake_gets_one_line(act: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        act(MPPIController(held_up([[0.0, 0.0]]), SAMPLER))
