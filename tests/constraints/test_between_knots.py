"""Rows within a stage: dense violations, in C and PyTorch, in free time; wrong use."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from benchmarks.families.between import KINDS
from torchgco import (
    BetweenKnots,
    Constraint,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionDynamics,
    InteriorPoint,
    NormBounds,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    kernels,
)
from torchgco.base.errors import InputError
from torchgco.constraints.between_knots import _answered
from torchgco.native.compiler import find_compiler
from torchgco.problem.times import between

compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
POINT = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.35, "rk4", position=slice(0, 2))
RING = (
    FunctionConstraint(lambda x: x[..., :2].square().sum(-1, keepdim=True) - 1.1**2, name="outer"),
    FunctionConstraint(lambda x: 0.9**2 - x[..., :2].square().sum(-1, keepdim=True), name="inner"),
)


def half_a_turn(*rows: Constraint, N: int = 5) -> tuple[Problem, Tensor]:
    """A point that goes around in a ring of 0.9 to 1.1 m by few stages, and states to begin with."""
    angles = torch.linspace(0.0, torch.pi, N + 1, dtype=torch.float64)
    guess = torch.stack((angles.cos(), angles.sin(), 0 * angles, 0 * angles), -1)[None]
    cost = QuadraticCost(Q=[0.0] * 4, R=[0.01] * 2, Qf=[100, 100, 10, 10], x_ref=[-1.0, 0, 0, 0])
    x0 = torch.tensor([[1.0, 0.0, 0.0, 0.3]]).double()
    return Problem(POINT, cost, [ControlBounds(-9.0, 9.0), *RING, *rows], x0, N), guess


def densest(problem: Problem, solution: torchgco.Solution) -> float:
    """By how much the ring is left, m, at 200 instants of each stage."""
    k = torch.arange(problem.N).repeat_interleave(200)
    h = (torch.arange(200) / 200 * problem.dynamics.dt).double().repeat(problem.N)
    x = between(problem.dynamics, solution.X, solution.U, k, h, torch.full_like(h, problem.dynamics.dt))
    distance = x[..., :2].norm(dim=-1)
    return float(torch.maximum(distance - 1.1, 0.9 - distance).max())


@pytest.mark.slow
@compiled
def test_few_points_keep_nearly_all_of_the_way() -> None:
    left, costs = [], []
    for points in (0, 1, 3, 7):
        problem, X0 = half_a_turn(*(BetweenKnots(row, points) for row in RING if points))
        solution = torchgco.solve(problem, solver="interior_point", X0=X0, verbose=False)
        assert solution.statuses[0].name == "CONVERGED"
        left.append(densest(problem, solution))
        costs.append(float(solution.cost))
    assert left[0] > 1e-2 and left[1] < 0.25 * left[0] and left[2] < 1e-3 and left[3] < 3e-4
    assert costs == sorted(costs)


@pytest.mark.slow
@compiled
def test_bounds_hold_where_states_overshoot() -> None:
    """A fast swing: the speed has its peak within a stage."""
    swing = FunctionDynamics(
        lambda x, u: torch.stack((x[..., 1], u[..., 0] - 9.0 * x[..., 0]), -1), 2, 1, 0.4, "radau5"
    )
    cost = QuadraticCost(Q=[1.0, 0.0], R=[0.01], Qf=[10.0, 10.0])
    x0, limits = torch.tensor([[1.0, 0.0], [0.8, 0.3]]).double(), ControlBounds(-6.0, 6.0)
    for bound in (StateBounds([-9.0, -1.5], [9.0, 1.5]), NormBounds(("x", [1]), upper=1.5)):
        fastest = []
        for rows in ([bound], [bound, BetweenKnots(bound, 4)]):
            problem = Problem(swing, cost, [limits, *rows], x0, 12)
            solution = torchgco.solve(problem, verbose=False)
            assert [status.name for status in solution.statuses] == ["CONVERGED"] * 2
            k, h = torch.arange(12).repeat_interleave(50), (torch.arange(50) / 50 * 0.4).double().repeat(12)
            x = between(swing, solution.X, solution.U, k, h, torch.full_like(h, 0.4))
            fastest.append(float(x[..., 1].abs().max()))
        assert fastest[0] > 1.52 and fastest[1] < 1.505
        one = torchgco.solve(problem.take(torch.tensor([1])), verbose=False)
        assert torch.equal(one.U[0], solution.U[1])


@pytest.mark.slow
@compiled
def test_c_pytorch_and_free_time() -> None:
    problem, X0 = half_a_turn(*(BetweenKnots(row) for row in RING))
    in_c = torchgco.solve(problem, solver="interior_point", X0=X0, verbose=False)
    assert float(torchgco.judge(problem, in_c.U).violation) < 1e-3
    rows = problem.constraints[-1].value(in_c.X, in_c.U)
    assert rows.shape == (1, 5, 3) and float(rows.max()) < 1e-3
    free = replace(problem, time=FreeTime(0.5, 3.0, weight=0.1))
    freely = torchgco.solve(free, solver="interior_point", X0=X0, verbose=False)
    assert freely.statuses[0].name == "CONVERGED"
    assert float(torchgco.judge(free, freely.U, times=freely.t).violation) < 1e-3
    kernels.use_native(False)
    try:
        slow = torchgco.solve(problem, solver="al_ilqr", U0=in_c.U, verbose=False)
        assert float(slow.cost) == pytest.approx(float(in_c.cost), rel=1e-3)
    finally:
        kernels.use_native(True)


def test_stages_are_those_that_end_at_the_knots() -> None:
    row = FunctionConstraint(lambda x: x[..., :1], knots=[0, 2, 5])
    problem, _ = half_a_turn(BetweenKnots(row, 2))
    assert problem.constraints[-1].knots.tolist() == [1, 4]
    assert problem.constraints[-1].value(*problem.at_rest).shape == (1, 2, 2)


def swing(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 9.0 * x[..., 0]), dim=-1)


def drawn_limits(kind: str) -> tuple[Constraint, list[int]]:
    """Rows with numbers of their own at each knot, and by which of these stage k has to keep them."""
    draws = torch.Generator().manual_seed(3)
    limits = torch.rand(1, 7, 2, generator=draws, dtype=torch.float64)
    if kind == "bounds at 0 to N - 1":
        return StateBounds(limits[:, :6] - 2.0, limits[:, :6], knots=slice(0, 6)), [1, 2, 3, 4, 5]
    if kind == "values of knots":
        return FunctionConstraint(lambda x, c: x - c, knot_values={"c": limits}), [1, 2, 3, 4, 5, 6]
    if kind == "numbers of knots":
        return FunctionConstraint(lambda x, k: x - limits[0, k]), [1, 2, 3, 4, 5, 6]
    return FunctionConstraint(lambda x, u, c: x * u - c, of="xu", knot_values={"c": limits}), [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("kind", ["bounds at 0 to N - 1", "values of knots", "numbers of knots", "states and controls"])
def test_numbers_are_those_of_the_stages_knot(kind: str) -> None:
    """Rows by hand: of the knot at which the stage ends, and where controls count of that at which it begins."""
    row, knots = drawn_limits(kind)
    draws = torch.Generator().manual_seed(4)
    limits = torch.rand(1, 7, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    X, U = (torch.randn(1, size, m, generator=draws, dtype=torch.float64) for size, m in ((7, 2), (6, 1)))
    model = FunctionDynamics(swing, 2, 1, 0.3, "midpoint")
    cost = QuadraticCost(Q=[1.0, 0.0], R=[0.01], Qf=[10.0, 10.0])
    problem = Problem(model, cost, [BetweenKnots(row, 2)], torch.zeros(1, 2, dtype=torch.float64), 6)
    found = problem.constraints[0].value(X, U)
    stages = [k if kind == "states and controls" else k - 1 for k in knots]
    for place, (stage, knot) in enumerate(zip(stages, knots, strict=True)):
        for i in (1, 2):
            x, u, h = X[0, stage], U[0, stage], 0.1 * i
            x = x + h * swing(x + 0.5 * h * swing(x, u), u)
            due = x * u - limits[0, knot] if kind == "states and controls" else x - limits[0, knot]
            torch.testing.assert_close(found[0, place].chunk(2)[i - 1][:2], due)
    assert found.shape[1] == len(stages)


@pytest.mark.parametrize(
    ("within", "word"),
    [
        (BetweenKnots(RING[0], 0), "points"),
        (BetweenKnots(RING[0], 2.5), "points"),  # type: ignore[arg-type]
        (BetweenKnots(ControlBounds(-1.0, 1.0)), "controls"),
        (BetweenKnots(Spheres([[0.0, 0.0]], [0.1])), "constraint"),
        (BetweenKnots(FunctionConstraint(lambda x: x[..., :1], sense="equality")), "constraint"),
        (BetweenKnots(3), "constraint"),
        (BetweenKnots(BetweenKnots(RING[0])), "anyway"),
        (BetweenKnots(FunctionConstraint(lambda x: x[..., :1], knots=[0])), "at which a stage ends, got knot 0 alone"),
    ],
)
def test_wrong_use_is_told(within: BetweenKnots, word: str) -> None:
    with pytest.raises(InputError, match=word):
        half_a_turn(within)


def test_the_model_is_the_problems() -> None:
    problem, _ = half_a_turn(BetweenKnots(RING[0]))
    other = replace(problem, dynamics=replace(POINT, dt=0.2))
    between_knots = other.constraints[-1]
    assert isinstance(between_knots, BetweenKnots) and between_knots.model.dt == 0.2
    with pytest.raises(InputError, match="integrates a field"):
        replace(problem, dynamics=replace(POINT, function=lambda x, u: x, integrator="none"))


@pytest.mark.slow
@compiled
def test_tightened_rows_leave_nothing_between_their_points() -> None:
    problem, X0 = half_a_turn(*(BetweenKnots(row) for row in RING))
    for stated in (problem, replace(problem, time=FreeTime(0.5, 3.0, weight=0.1))):
        closer, solution = stated, torchgco.solve(stated, solver="interior_point", X0=X0, verbose=False)
        within = lambda found, stated=stated: float(
            torchgco.judge(stated, found.U, times=found.t if stated.time else None).violation_between
        )
        cost, left = float(solution.cost), []
        for _ in range(3):
            left.append(within(solution))
            closer = torchgco.tightened(closer, solution)
            solution = torchgco.solve(closer, solver="interior_point", warm=solution, X0=solution.X, verbose=False)
            assert solution.statuses[0].name == "CONVERGED"
        assert left[0] > 1e-3 and left[1] < 0.3 * left[0] and left[2] < 0.1 * left[1] and within(solution) < 1e-7
        assert cost <= float(solution.cost) < 1.01 * cost


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("name", ["a bound of a speed", pytest.param("a ring", marks=pytest.mark.slow),
                                  pytest.param("an oval to go around", marks=pytest.mark.slow)])  # fmt: skip
def test_a_millionth_is_left_after_five_rounds(name: str) -> None:
    kind = KINDS[name]
    problem = kind.problem(8, 31415, *(BetweenKnots(row) for row in kind.rows))
    solution = torchgco.solve(problem, solver="interior_point", verbose=False)
    assert kind.left(solution) > 1e-4
    for _ in range(5):
        problem = torchgco.tightened(problem, solution)
        solution = torchgco.solve(problem, solver="interior_point", warm=solution, X0=solution.X, verbose=False)
    assert kind.left(solution) < 1e-6 and all(status.name == "CONVERGED" for status in solution.statuses)


def test_rows_at_moved_points_are_those_of_the_integrator_there_and_the_same_in_c() -> None:
    problem, _ = half_a_turn(*(BetweenKnots(row) for row in RING))
    U = torch.randn(1, problem.N, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    X = torchgco.dynamics.rollout.open_loop(problem.dynamics, problem.x0, U)
    row = problem.constraints[-1]
    shares = torch.rand(1, problem.N, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    moved = replace(row, shares=shares)
    found = moved.value(X, U)
    for k in range(problem.N):
        for i in range(3):
            h = shares[:, k, i] * problem.dynamics.dt
            x = between(problem.dynamics, X, U, torch.tensor([k]), h, torch.full_like(h, problem.dynamics.dt))
            torch.testing.assert_close(found[:, k, i], RING[1].function(x)[:, 0, 0], rtol=1e-12, atol=1e-12)
    if find_compiler() is not None:
        closer = replace(problem, constraints=[*problem.constraints[:-1], moved])
        with_c = kernels.measured(closer, X, U)
        torch.testing.assert_close(with_c, torch.stack([c.worst(X, U) for c in closer.constraints]).amax(0))


def test_peaks_are_answered_as_a_slow_search_would() -> None:
    draw = torch.Generator().manual_seed(5)
    uniform = lambda *shape: torch.rand(*shape, dtype=torch.float64, generator=draw)
    shares, lam = uniform(6, 4, 3).sort(-1).values, uniform(6, 4, 3, 2) * (uniform(6, 4, 3, 2) > 0.4)
    now, margins = uniform(6, 4, 3, 2) - 0.9, 0.1 * uniform(6, 4, 3, 2)
    heights, places = uniform(6, 4, 2, 5) - 0.8, uniform(6, 4, 2, 5)
    points, kept = _answered(shares, margins, now, lam, heights, places)
    kinds = set[str]()
    for b, k in itertools.product(range(6), range(4)):
        at, keeps, idle = shares[b, k].tolist(), margins[b, k].clone(), lam[b, k].sum(-1).tolist()
        peaks = sorted(itertools.product(range(2), range(5)), key=lambda rq, b=b, k=k: -float(heights[b, k][rq]))[:3]
        for r, q in ((r, q) for r, q in peaks if heights[b, k, r, q] > 0):
            place, push = float(places[b, k, r, q]), lam[b, k, :, r]
            before = [i for i in range(3) if shares[b, k, i] <= place]
            sides = [max(before), max(before) + 1] if before and len(before) < 3 else []
            if sides and all(push[i] > 0.1 * push.max() for i in sides):
                kinds.add("further")
                for i in sides:
                    keeps[i, r] = max(keeps[i, r], 1.05 * heights[b, k, r, q] - now[b, k, i, r])
            else:
                kinds.add("moved")
                i = idle.index(min(idle))
                at[i], keeps[i], idle[i] = place, 0.0, float("inf")
        assert points[b, k].tolist() == at
        torch.testing.assert_close(kept[b, k], keeps, rtol=0.0, atol=0.0)
    assert kinds == {"further", "moved"}


def test_what_cannot_be_tightened_is_told() -> None:
    problem, _ = half_a_turn()
    solution = torchgco.solve(problem, solver="hold", verbose=False)
    with pytest.raises(InputError, match="BetweenKnots"):
        torchgco.tightened(problem, solution)
    other, _ = half_a_turn(BetweenKnots(RING[0]), N=6)
    with pytest.raises(InputError, match=r"solution\.U"):
        torchgco.tightened(other, solution)


@pytest.mark.slow
def test_a_solution_in_free_time_is_none_of_a_fixed_problem() -> None:
    """Its states and controls lead elsewhere by steps of dt: a row was tightened by 380 times its bound."""
    problem, _ = half_a_turn(BetweenKnots(RING[0]))
    free = replace(problem, time=FreeTime(0.5, 3.0))
    solution = torchgco.solve(free, solver=InteriorPoint(max_iterations=3), verbose=False)
    with pytest.raises(InputError, match="times"):
        torchgco.tightened(problem, solution)


@pytest.mark.parametrize("fault", [lambda x: x[..., :1] @ torch.ones(3, 2), lambda x: 1 / 0])
def test_rows_that_fail_are_told_as_others_are(fault: Any) -> None:
    for row in (FunctionConstraint(fault), BetweenKnots(FunctionConstraint(fault))):
        with pytest.raises(InputError, match="constraint"):
            half_a_turn(row)
