"""Vehicles that drive one way only, with their goal behind them: no first guess that stays in line turns them round."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchgco
from tests.problems import assert_same_bits
from tests.slow import mostly
from torchgco import (
    Body,
    Boxes,
    Constraint,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    HorizonWarning,
    Problem,
    QuadraticCost,
    StateBounds,
    Status,
    judge,
)

D, INF = torch.float64, math.inf


def unicycle(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((u[..., 0] * torch.cos(x[..., 2]), u[..., 0] * torch.sin(x[..., 2]), u[..., 1]), -1)


def car(x: Tensor, u: Tensor) -> Tensor:
    h, v = x[..., 2], x[..., 3]
    return torch.stack((v * torch.cos(h), v * torch.sin(h), v * torch.tan(u[..., 1]) / 0.5, u[..., 0]), -1)


def trailer(x: Tensor, u: Tensor) -> Tensor:
    h, v = x[..., 2], u[..., 0]
    bend = torch.sin(h - x[..., 3])
    return torch.stack((v * torch.cos(h), v * torch.sin(h), v * torch.tan(u[..., 1]) / 0.5, v * bend / 0.5), -1)


def jackknife(x: Tensor) -> Tensor:
    return torch.sin(x[..., 2:3] - x[..., 3:4]) ** 2 - math.sin(1.0) ** 2


def turning(kind: str, headings: Tensor, walls: bool = False, required: bool = False, way: float = 1.0) -> Problem:
    """Vehicles at the origin that drive only forwards, or with `way` -1 backwards; the goal is 3 m the other way."""
    low, high = sorted((0.0, way))
    parts: list[Constraint]
    h, zero = headings, torch.zeros_like(headings)
    if kind == "unicycle":
        model, x0, half = FunctionDynamics(unicycle, 3, 2, 0.1, "rk4", slice(0, 2)), (zero, zero, h), 0.6
        parts = [ControlBounds([0.5 * low, -2.0], [0.5 * high, 2.0])]
    elif kind == "car":
        model, x0, half = FunctionDynamics(car, 4, 2, 0.15, "rk4", slice(0, 2)), (zero, zero, h, zero), 2.5
        speeds = StateBounds([-INF] * 3 + [2.0 * low], [INF] * 3 + [2.0 * high])
        parts = [ControlBounds([-1.0, -0.6], [1.0, 0.6]), speeds]
    else:
        model, x0, half = FunctionDynamics(trailer, 4, 2, 0.15, "rk4", slice(0, 2)), (zero, zero, h, h), 2.5
        parts = [ControlBounds([2.0 * low, -0.6], [2.0 * high, 0.6]), FunctionConstraint(jackknife, name="jackknife")]
    if walls:
        parts.append(Boxes([[0, half + 0.5], [0, -half - 0.5]], [[6.0, 0.5], [6.0, 0.5]], vehicle_radius=0.25))
    more = [0.0] * (len(x0) - 2)
    goal = [-3.0 * way, 0.0]
    cost = QuadraticCost(Q=[0.1, 0.1, *more], R=[0.1, 0.1], Qf=[50, 50, *more], x_ref=[*goal, *more])
    return Problem(model, cost, parts, torch.stack(x0, -1), 80, goal=Goal(goal, 0.2, required=required))


def headings(count: int, seed: int) -> Tensor:
    """Exactly away from the goal, which is a saddle, and others drawn over a full turn."""
    draws = torch.Generator().manual_seed(seed)
    drawn = math.pi * (2.0 * torch.rand(count - 1, generator=draws, dtype=D) - 1.0)
    return torch.cat((torch.zeros(1, dtype=D), drawn))


def check_reached(problem: Problem, solver: str, seed: int) -> None:
    found = torchgco.solve(problem, solver=solver, seed=seed, verbose=False)
    verdict = judge(problem, found.U)
    assert bool(verdict.reached.all()), (~verdict.reached).nonzero().flatten().tolist()
    assert set(found.statuses) <= {Status.CONVERGED, Status.FEASIBLE}
    assert int((found.status == Status.CONVERGED).sum()) >= 0.95 * problem.B
    assert bool((verdict.clearance >= 0.0).all())


CASES = [
    ("unicycle", False, False, 1.0), ("unicycle", True, True, 1.0), ("unicycle", True, True, -1.0),
    ("car", False, False, -1.0), ("car", True, True, 1.0), ("trailer", True, True, 1.0),
]  # fmt: skip


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("kind", "walls", "required", "way"), mostly(CASES, *CASES[:3:2], CASES[3], several=True))
def test_the_goal_behind_is_reached(kind: str, walls: bool, required: bool, way: float) -> None:
    check_reached(turning(kind, headings(9, seed=len(kind)), walls, required, way), "gco", 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("solver", ["gco", "gco_max"])
@pytest.mark.parametrize("kind", ["unicycle", "car", "trailer"])
def test_all_headings_of_half_a_turn(kind: str, solver: str, seed: int) -> None:
    for walls in (False, True):
        for required in (False, True):
            for way in (1.0,) if kind == "trailer" else (1.0, -1.0):  # to back a trailer round is another problem
                check_reached(
                    turning(kind, torch.linspace(0, math.pi, 33, dtype=D), walls, required, way), solver, seed
                )


WALLED = [(kind, walls) for kind in ("car", "trailer") for walls in (False, True)]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "walls"), mostly(WALLED, *WALLED[1:], several=True))
def test_requiring_the_goal_costs_no_more_than_stating_it(kind: str, walls: bool) -> None:
    """What reaches the goal without its being required is a plan where it is: these cost up to 2.4 times as much."""
    stated, required = (turning(kind, headings(17, seed=77), walls, required) for required in (False, True))
    free, held = (torchgco.solve(problem, verbose=False) for problem in (stated, required))
    assert bool(judge(stated, free.U).reached.all()) and bool(judge(required, held.U).reached.all())
    assert held.statuses == [Status.CONVERGED] * 17
    assert bool((held.cost <= 1.001 * free.cost).all()), (held.cost / free.cost).tolist()
    one = torch.tensor([2])
    assert_same_bits(torchgco.solve(required.take(one), ids=one, verbose=False), held.take([2]))


def test_a_goal_that_binds_is_released_where_the_terminal_cost_draws_into_it() -> None:
    """From a heading drawn so, the required goal's border holds the end of a way of 21.4, and 12.1 is a way's cost."""
    one = torch.tensor([56])
    stated, required = (
        turning("unicycle", headings(64, 77), required=required).take(one) for required in (False, True)
    )
    free, held = (torchgco.solve(problem, ids=one, verbose=False) for problem in (stated, required))
    assert bool(judge(required, held.U).reached.all()) and float(held.cost) <= 1.001 * float(free.cost) < 12.2


@pytest.mark.slow
def test_nothing_is_released_that_binds_or_was_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[int] = []
    usual = Problem.releasing_goal
    monkeypatch.setattr(Problem, "releasing_goal", lambda self: released.append(self.B) or usual(self))
    problem = turning("car", headings(5, 7), required=True)
    still = replace(
        problem, cost=QuadraticCost(Q=[0.0] * 4, R=[1.0, 1.0], Qf=[0.0] * 4)
    )  # its cost leads nowhere: the goal binds
    assert bool(judge(still, torchgco.solve(still, verbose=False).U).reached.all()) and not released
    state = replace(problem, goal=Goal(state=[-3.0, 0.0, math.nan, math.nan], required=True))
    torchgco.solve(state, verbose=False)
    torchgco.solve(turning("car", headings(5, 7)), verbose=False)
    assert not released
    torchgco.solve(problem, verbose=False)
    assert sum(released) == 5


@pytest.mark.slow
def test_the_rest_of_a_batch_changes_nothing() -> None:
    problem = turning("car", headings(4, 3), walls=True)
    bad = torch.where(torch.arange(4).unsqueeze(-1) == 2, torch.nan, problem.x0)
    spoiled = Problem(problem.dynamics, problem.cost, problem.constraints, bad, problem.N, goal=Goal([-3.0, 0.0], 0.2))
    whole = torchgco.solve(spoiled, verbose=False)
    assert int(whole.status[2]) == Status.NON_FINITE
    for b in (0, 1, 3):
        alone = torchgco.solve(problem.take(torch.tensor([b])), ids=torch.tensor([b]), verbose=False)
        assert_same_bits(alone, whole.take([b]))


def test_a_goal_beyond_the_horizon_is_not_required() -> None:
    """No search is made for what no trajectory can do: 3 m at 0.5 m/s take 60 stages."""
    problem = replace(turning("unicycle", headings(3, 0)), N=40)
    with pytest.warns(HorizonWarning):
        found = torchgco.solve(problem, verbose=False)
    assert bool((found.violation <= 1e-6).all()) and not bool(judge(problem, found.U).reached.any())


@pytest.mark.slow
def test_a_car_with_a_trailer_backs_into_a_slot() -> None:
    """The trajectory of the problem with the goal required serves the one without, at a tenth of the cost."""

    def rates(x: Tensor, u: Tensor) -> Tensor:
        h, t, v = x[..., 2], x[..., 3], x[..., 4]
        turn = v * torch.tan(u[..., 1]) / 2.7
        return torch.stack((v * torch.cos(h), v * torch.sin(h), turn, v * torch.sin(h - t) / 3.0, u[..., 0]), -1)

    def turned(x: Tensor) -> Tensor:
        c, s = torch.cos(x[..., 3]), torch.sin(x[..., 3])
        return torch.stack((torch.stack((c, -s), -1), torch.stack((s, c), -1)), -2)

    names = ("x", "y", "heading", "trailer", "v")
    model = FunctionDynamics(rates, 5, 2, 0.25, "rk4", position=slice(0, 2), state_names=names)
    front = Body.covering([-0.5, -0.9], [3.4, 0.9], [4, 2])
    rear = replace(Body.covering([-4.2, -0.9], [-0.6, 0.9], [4, 2]), attitude=turned)
    walls = [[-9.0, -3.2], [9.0, -3.2]], [[7.0, 1.6], [7.0, 1.6]]
    parts = [
        *(Boxes(*walls, vehicle_radius=body) for body in (front, rear)),
        ControlBounds([-2, -0.6], [2, 0.6]), StateBounds([-30, -30, -10, -10, -3], [30, 30, 10, 10, 3]),
        FunctionConstraint(jackknife, name="jackknife"),
    ]  # fmt: skip
    rest = [0, -0.5, math.pi / 2, math.pi / 2, 0]
    cost = QuadraticCost(Q=[0.001, 0.001, 0, 0, 0.01], R=[0.05, 0.05], Qf=[10] * 5, x_ref=rest)
    problem = Problem(model, cost, parts, torch.tensor([[8.0, 4, 0, 0, 0]], dtype=D), 120, goal=Goal([0, -0.5], 0.2))
    found = torchgco.solve(problem, verbose=False)
    assert bool(judge(problem, found.U).reached) and float(found.cost) < 14.0
