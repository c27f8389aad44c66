"""Violations within stages: against sampled states, and only where rows hold at knots alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from scipy.integrate import solve_ivp

import torchgco
from torchgco import (
    BetweenKnots,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    Link,
    NormBounds,
    Problem,
    QuadraticCost,
    QuadrotorPlant,
    Spheres,
    StateBounds,
)

SWING = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0] - 9.0 * x[..., 0]), -1), 2, 1, 0.2, "rk4")
N, COST = 10, QuadraticCost([1.0, 0.0], [0.01], [10.0, 10.0])
X0 = torch.tensor([[1.0, 0.0], [0.2, 0.1], [0.0, 3.0]]).double()


def judged(*rows: Any, **more: Any) -> torch.Tensor:
    torch.manual_seed(3)
    problem = Problem(SWING, COST, [*rows], X0, N, **more)
    return torchgco.judge(problem, torch.randn(3, N, 1, dtype=torch.float64)).violation_between


def exact(limit: float) -> torch.Tensor:
    """By how much the speed exceeds a limit at 20 instants of each stage, flown by SciPy."""
    torch.manual_seed(3)
    U, worst = torch.randn(3, N, 1, dtype=torch.float64), []
    for x, controls in zip(X0.numpy(), U[..., 0].numpy(), strict=True):
        excess = 0.0
        for u in controls:
            instants = [0.2 * (i + 1) / 21 for i in range(20)] + [0.2]
            flown = solve_ivp(lambda t, z, u=u: [z[1], u - 9.0 * z[0]], (0, 0.2), x, t_eval=instants, rtol=1e-9)
            excess, x = max(excess, abs(flown.y[1, :-1]).max() - limit), flown.y[:, -1]
        worst.append(excess)
    return torch.tensor(worst).clamp(min=0.0)


def test_rows_of_states_are_those_of_states_within_stages() -> None:
    speed = lambda x: x[..., 1:].square() - 0.7**2
    bound, norm = StateBounds([-9.0, -0.7], [9.0, 0.7]), NormBounds(("x", [1]), upper=0.7)
    for rows in (judged(bound), judged(norm), judged(bound, ControlBounds(-1e-3, 1e-3))):
        assert torch.allclose(rows, exact(0.7), atol=0.01) and bool((rows > 0.1).any())
    function = judged(FunctionConstraint(speed))
    assert torch.equal(function, judged(FunctionConstraint(lambda x, u: speed(x) + 0.0 * u, of="xu")))
    assert torch.allclose(function, exact(0.7) * (exact(0.7) + 1.4), atol=0.1)


def test_knots_say_which_stages_count() -> None:
    row = lambda x: x[..., 1:] - 0.5
    assert float(judged(FunctionConstraint(row, knots=[-1])).max()) == 0.0
    assert float(judged(FunctionConstraint(row, knots=[3, 5, 9])).max()) == 0.0
    assert float(judged(FunctionConstraint(row, knots=[1, 5])).max()) == 0.0
    assert float(judged(FunctionConstraint(lambda x, u: row(x), of="xu", knots=[2, N - 1])).max()) == 0.0
    parts = [judged(FunctionConstraint(row, knots=knots)) for knots in (range(1, 5), range(4, N + 1))]
    assert torch.equal(torch.maximum(*parts), judged(FunctionConstraint(row)))


def test_what_is_kept_on_its_way_does_not_count() -> None:
    row = FunctionConstraint(lambda x: x[..., 1:] - 0.5)
    others = [BetweenKnots(row), Link(lambda a, b: a[..., :1] - b[..., :1]), ControlBounds(-1e-3, 1e-3)]
    assert float(judged(*others).max()) == 0.0
    point = replace(SWING, position=slice(0, 1))
    problem = Problem(point, COST, [Spheres([[5.0]], [0.1])], X0, N, Goal([0.0], 0.1, required=True))
    assert float(torchgco.judge(problem, problem.at_rest[1]).violation_between.max()) == 0.0


def test_the_ball_of_a_goal_is_of_the_end_even_of_a_single_stage() -> None:
    point = replace(SWING, position=slice(0, 1))
    problem = Problem(point, COST, [], X0, 1, Goal([0.9], 0.05, required=True))
    assert float(torchgco.judge(problem, problem.at_rest[1]).violation_between.max()) == 0.0


@pytest.mark.parametrize("time", [None, FreeTime(0.3, 1.0)])
def test_states_within_stages_are_settled_as_those_at_knots(time: FreeTime | None) -> None:
    """Rotors at full thrust, called to turn faster still: their steps end within the limit, and so do shorter ones."""
    model, free = QuadrotorPlant(dt=0.05), [torch.inf] * 13
    full = [model.airframe.thrust_max] * 4
    x0 = torch.tensor([[0.0] * 6 + [1.0] + [0.0] * 6 + full]).double()
    cost, rows = QuadraticCost([1.0] * 17, [1e-9] * 4, [1.0] * 17), [StateBounds([-torch.inf] * 17, free + full)]
    problem = Problem(model, cost, rows, x0, 3, time=time)
    times = None if time is None else 0.05 * torch.arange(4.0, dtype=torch.float64)[None]
    verdict = torchgco.judge(problem, torch.full((1, 3, 4), 6e4, dtype=torch.float64), times=times)
    assert float(verdict.violation) == float(verdict.violation_between) == 0.0


def test_horizons_end_the_stages_and_maps_have_none() -> None:
    row = FunctionConstraint(lambda x, k: x[..., 1:] - 0.5 + 9.0 * (k > 3).to(x.dtype).unsqueeze(-1))
    early = judged(row, horizon=[3, 3, 3])
    assert torch.equal(early, judged(replace(row, knots=range(1, 4))))
    step = FunctionDynamics(lambda x, u: x + 0.1 * torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "none")
    problem = Problem(step, COST, [row], X0, N)
    assert bool(torchgco.judge(problem, problem.at_rest[1]).violation_between.isnan().all())


def test_tables_have_the_column_where_rows_count() -> None:
    problem = Problem(SWING, COST, [StateBounds([-9.0, -0.7], [9.0, 0.7])], X0[:1], N)
    solution = torchgco.solve(problem, solver="hold", verbose=False)
    assert solution.to_frame(problem)["violation_between"][0] > 0.1
    free = replace(problem, constraints=[])
    assert "violation_between" not in solution.to_frame(free)


@pytest.mark.parametrize("b", [0, 2])
def test_a_problem_alone_has_its_own(b: int) -> None:
    row = StateBounds([-9.0, -0.7], [9.0, 0.7])
    torch.manual_seed(3)
    U = torch.randn(3, N, 1, dtype=torch.float64)
    alone = Problem(SWING, COST, [row], X0[b : b + 1], N)
    assert float(torchgco.judge(alone, U[b : b + 1]).violation_between) == float(judged(row)[b])
