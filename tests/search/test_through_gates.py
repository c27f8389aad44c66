"""Gates in a free time among obstacles: legs on their better sides, clear between knots, and no time that is held."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Gates,
    Goal,
    InteriorPoint,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    judge,
)
from torchgco.constraints.gates import gates_of
from torchgco.search import Restarts

D = torch.float64
STAGES, LEGS = 20, 3
PLACES = [[4.0, 0.0], [8.0, 0.0]]
# On each leg a disc, whose shorter side is above, below, and above the straight line.
DISCS = Spheres([[2.0, -0.25], [6.0, 0.3], [10.0, -0.2]], [0.7] * 3, vehicle_radius=0.1)


def course(*parts: Any, stages: int = STAGES, B: int = 1, rest: bool = True) -> Problem:
    """A ball in the plane that passes two gates in the least time, and rests at the goal behind them."""
    move = lambda x, u: torch.cat((x[..., 2:], u), dim=-1)
    model = FunctionDynamics(move, 4, 2, 0.1, "rk4", position=slice(0, 2))
    cost, N = QuadraticCost([0.0] * 4, [1e-3] * 2, [0.0] * 4), stages * LEGS
    knots = [stages, 2 * stages]
    gates, x0 = Gates(PLACES, 0.2, knots=knots), torch.zeros(B, 4, dtype=D)
    x0[:, 1] = torch.linspace(0.0, 0.1, B, dtype=D)
    goal = Goal(state=[12.0, 0.0, 0.0, 0.0], required=True) if rest else Goal([12.0, 0.0], 0.2, required=True)
    rows = [ControlBounds(-3.0, 3.0), gates, *parts]
    return Problem(model, cost, rows, x0, N, goal, time=FreeTime(0.2, 6.0, segments=knots))


@pytest.fixture(autouse=True)
def never_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """No search at a time that is held."""

    def run(solver: Restarts, call: Any) -> Solution:
        raise AssertionError("the time is held")

    monkeypatch.setattr(Restarts, "run", run)


def bent(problem: Problem, sides: tuple[float, ...]) -> Tensor:
    """States that pass each disc on a side."""
    X = torch.zeros(1, problem.N + 1, 4, dtype=D)
    share = torch.linspace(0.0, LEGS, problem.N + 1, dtype=D)
    side = torch.tensor([*sides, sides[-1]], dtype=D)[share.floor().long()]
    X[0, :, 0], X[0, :, 1] = 4.0 * share, side * (torch.pi * share).sin().abs()
    return X


@pytest.mark.slow
def test_each_leg_passes_on_its_better_side() -> None:
    problem = course(DISCS)
    found = torchgco.solve(problem)
    U0 = problem.x0.new_zeros(1, problem.N, 2)
    every = [InteriorPoint().solve(problem, U0, X0=bent(problem, sides)) for sides in product((-1.0, 1.0), repeat=LEGS)]
    good = [one for one in every if bool(judge(problem, one.U, times=one.t).reached)]
    costs = torch.cat([one.cost for one in good])
    assert len(good) >= 4 and float(costs.max()) > 1.1 * float(costs.min())
    assert float(found.cost) <= float(costs.min()) * (1.0 + 1e-6)
    verdict = judge(problem, found.U, times=found.t)
    assert bool(verdict.reached) and int(verdict.gates_passed) == len(PLACES)


@pytest.mark.slow
def test_chords_are_clear_where_stages_are_long() -> None:
    """With eight stages a leg the optimum at the knots alone cuts the discs."""
    problem = course(DISCS, stages=8)
    alone = InteriorPoint().solve(problem, problem.x0.new_zeros(1, problem.N, 2), X0=bent(problem, (1.0, -1.0, 1.0)))
    assert not bool(judge(problem, alone.U, times=alone.t).reached)
    found = torchgco.solve(problem)
    assert bool(judge(problem, found.U, times=found.t).reached) and float(found.violation) <= 1e-6


@pytest.mark.slow
def test_a_course_has_the_same_bits_in_any_batch() -> None:
    problem = course(DISCS, B=3)
    found = torchgco.solve(problem, record=True)
    alone = torchgco.solve(problem.take(torch.tensor([1])), ids=torch.tensor([1]))
    assert torch.equal(found.U[1], alone.U[0]) and torch.equal(found.t[1], alone.t[0])
    # Nothing but iterations can be recorded here: nobody is sent to ask for it once more.
    assert "record=True" not in found.explain(1)


def test_states_of_the_user_are_begun_from_too(monkeypatch: pytest.MonkeyPatch) -> None:
    from torchgco.search import through_gates

    begun: list[Tensor] = []
    solve = through_gates.ThroughGates._solve

    def noted(search: Any, solver: Any, rows: Tensor, X: Tensor, *others: Any) -> None:
        begun.append(X)
        solve(search, solver, rows, X, *others)

    monkeypatch.setattr(through_gates.ThroughGates, "_solve", noted)
    problem = course(DISCS)
    X0 = bent(problem, (1.0, 1.0, 1.0))
    torchgco.solve(problem, X0=X0)
    assert torch.equal(begun[0][0, 1:, :2], X0[0, 1:, :2])


def test_far_obstacles_are_left_out() -> None:
    far = Spheres([[6.0, 60.0]], [1.0])
    problem = course(DISCS, far)
    without, among = (
        torchgco.solve(course(DISCS, Spheres([[float("nan")] * 2], [float("nan")]))),
        torchgco.solve(problem),
    )
    torch.testing.assert_close(among.cost, without.cost, rtol=1e-9, atol=0)


def test_a_problem_that_is_repeated_has_as_many_gates() -> None:
    gates = gates_of(course(DISCS).take(torch.tensor([0, 0])))
    assert gates is not None and gates.centers.shape == (2, 2, 2) and gates.sizes.shape == (2, 2)
