"""Constraints on integrals over time: against states that are written by hand, a closed form, and differences."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    ILQR,
    MPC,
    AugmentedLagrangian,
    ControlBounds,
    Fleet,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InputError,
    Integral,
    Planar,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Status,
    certify,
    judge,
    kernels,
)

D = torch.float64
N, DT = 24, 0.1
MOST = torch.tensor([1.2, 2.5], dtype=D)
STARTS = torch.tensor([[0.0, 0.0], [0.1, -0.3]], dtype=D)


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 0.2 * x[..., 1] * x[..., 1].square()), -1)


def spent(x: Tensor, u: Tensor) -> Tensor:
    return u[..., 0].square() + 0.3 * x[..., 1].square()


def made(*parts: Any, integrator: Any = "rk4", by_hand: bool = False, x0: Tensor = STARTS, **more: Any) -> Problem:
    """Carts that go to 1; `by_hand` with a third state, what is spent, which is at most `MOST` at the end."""
    field, n, weights = cart, 2, [1.0, 0.1]
    if by_hand:
        field = lambda x, u: torch.cat((cart(x[..., :2], u), spent(x[..., :2], u).unsqueeze(-1)), -1)
        limit = lambda x, most: x[..., 2:] - most
        horizon = more.get("horizon")
        knots = [N] if horizon is None else None
        rows = FunctionConstraint(limit, knots=knots, values={"most": MOST[: len(x0), None]})
        parts, n, weights = (rows, *parts), 3, [1.0, 0.1, 0.0]
        x0 = torch.nn.functional.pad(x0, (0, 1))
    model = FunctionDynamics(field, n=n, m=1, dt=DT, integrator=integrator)
    end = [100.0 * weight for weight in weights]
    cost = QuadraticCost(Q=weights, R=[0.001], Qf=end, x_ref=[1.0] + [0.0] * (n - 1))
    return Problem(model, cost, [*parts, ControlBounds(-3, 3)], x0, N, **more)


BUDGET = Integral(spent, most=MOST)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4", "radau5"])
def test_a_budget_is_that_of_a_state_written_by_hand(integrator: str) -> None:
    problem, other = made(BUDGET, integrator=integrator), made(integrator=integrator, by_hand=True)
    solution, expected = (torchgco.solve(p, solver="interior_point") for p in (problem, other))
    assert solution.statuses == [Status.CONVERGED] * 2
    assert solution.X.shape == (2, N + 1, 2) and solution.K.shape == (2, N, 1, 2)
    torch.testing.assert_close(solution.U, expected.U, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(solution.cost, expected.cost, rtol=1e-8, atol=1e-8)
    lams = solution.multipliers.lam[0].flatten(), expected.multipliers.lam[0].flatten()
    torch.testing.assert_close(*lams, rtol=1e-4, atol=1e-6)
    value = expected.X[:, -1, 2] - MOST  # the quadrature of the hand-written state
    torch.testing.assert_close(problem.constraints[0].value(expected.X[..., :2], expected.U).flatten(), value)


@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr"])
def test_solvers_judge_and_certificate_agree(solver: str) -> None:
    problem = made(BUDGET)
    solution = torchgco.solve(problem, solver=solver)
    without = torchgco.solve(made())
    verdict, certificate = judge(problem, solution.U), certify(problem, solution.X, solution.U)
    assert bool(verdict.feasible.all()) and bool((certificate.dynamics_residual < 1e-12).all())
    torch.testing.assert_close(verdict.cost, solution.cost)
    torch.testing.assert_close(verdict.violation, solution.violation, rtol=1e-6, atol=1e-9)
    if solver != "al_ilqr":
        given = certify(problem, solution.X, solution.U, multipliers=solution.multipliers.lam)
        assert bool((certificate.kkt_residual < 1e-5).all()) and bool((given.kkt_residual < 1e-5).all())
    spent_freely = torch.stack([quadrature(b, without.X, without.U) for b in range(2)])
    assert bool((spent_freely > 1.5 * MOST).all())  # the budget binds
    torch.testing.assert_close(judge(problem, without.U).violation, spent_freely - MOST)


@compiled
def test_kernels_in_c_and_in_pytorch_take_the_same_steps() -> None:
    problem, few, found = (
        made(BUDGET, horizon=[15, N]),
        AugmentedLagrangian(ILQR(max_iterations=5), max_outer_iterations=1),
        [],
    )
    for native in (True, False):
        kernels.use_native(native)
        try:
            found.append(torchgco.solve(problem, solver=few))
        finally:
            kernels.use_native(True)
    torch.testing.assert_close(found[0].X, found[1].X, rtol=1e-6, atol=1e-6)
    assert found[0].to_frame()["kernels"].tolist() != found[1].to_frame()["kernels"].tolist()


def quadrature(b: int, X: Tensor, U: Tensor, stages: int = N) -> Tensor:
    """What problem b spends, by Simpson's rule on the states inside each step of rk4, as rk4 weighs them."""
    total = torch.zeros((), dtype=D)
    for k in range(stages):
        x, u = X[b, k], U[b, k]
        k1 = cart(x, u)
        k2 = cart(x + 0.5 * DT * k1, u)
        k3 = cart(x + 0.5 * DT * k2, u)
        inside = x, x + 0.5 * DT * k1, x + 0.5 * DT * k2, x + DT * k3
        total = total + sum(w * spent(z, u) for w, z in zip((1, 2, 2, 1), inside, strict=True)) * DT / 6.0
    return total


@pytest.mark.slow
def test_the_largest_area_beside_a_shore_is_a_segment_of_a_circle() -> None:
    """Dido's problem: y' = u, the length of the curve over 0..1 is given, the area is the largest."""
    lengths = torch.tensor([1.2, 1.4], dtype=D)
    model = FunctionDynamics(lambda x, u: u, n=1, m=1, dt=1 / 60, integrator="rk4")
    area = FunctionCost(lambda x, u: -x[..., 0] / 60)
    length = Integral(lambda x, u: (1.0 + u[..., 0].square()).sqrt(), equals=lengths, name="length")
    x0, goal = torch.zeros(2, 1, dtype=D), Goal(state=[0.0], required=True)
    problem = Problem(model, area, [length, ControlBounds(-20, 20)], x0, 60, goal=goal)
    solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED] * 2 and float(solution.violation.max()) < 1e-6
    for b, given in enumerate(lengths.tolist()):
        low, high = 0.5 + 1e-9, 10.0  # radius r with an arc of this length over a chord of 1: 2 r asin(1/2r)
        for _ in range(80):
            r = 0.5 * (low + high)
            low, high = (r, high) if 2 * r * math.asin(0.5 / r) > given else (low, r)
        exact = 0.5 * r * r * (given / r - math.sin(given / r))
        assert float(-solution.cost[b]) == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
def test_each_problem_has_its_own_horizon() -> None:
    horizon = [15, N]
    solution = torchgco.solve(made(BUDGET, horizon=horizon))
    assert solution.statuses == [Status.CONVERGED] * 2
    assert bool((judge(made(BUDGET, horizon=horizon), solution.U).violation < 1e-6).all())
    for b, last in enumerate(horizon):
        torch.testing.assert_close(quadrature(b, solution.X, solution.U, last), MOST[b], rtol=1e-5, atol=1e-5)
    alone = Problem(made().dynamics, made().cost, [Integral(spent, MOST[:1]), ControlBounds(-3, 3)], STARTS[:1], 15)
    torch.testing.assert_close(solution.U[0, :15], torchgco.solve(alone).U[0], rtol=1e-5, atol=1e-5)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("segments", [1, 2])
def test_a_budget_in_free_time_is_that_of_a_state_written_by_hand(segments: int) -> None:
    time = FreeTime(0.3, 2.0, weight=1.0, segments=segments)
    problem, other = made(BUDGET, time=time), made(by_hand=True, time=time)
    solution, expected = torchgco.solve(problem), torchgco.solve(other)
    assert solution.statuses == [Status.CONVERGED] * 2
    torch.testing.assert_close(solution.cost, expected.cost, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(solution.duration, expected.duration, rtol=1e-4, atol=1e-4)
    verdict = judge(problem, solution.U, times=solution.t)
    assert bool(verdict.feasible.all()) and bool((verdict.violation < 1e-6).all())
    certificate = certify(problem, solution.X, solution.U, times=solution.t)
    assert bool((certificate.kkt_residual < 1e-4).all())
    hasty = judge(problem, solution.U, times=1.2 * solution.t)  # the same controls for longer cost more
    assert bool((hasty.violation > 0.1 * MOST).all())


@pytest.mark.slow
def test_it_stands_beside_rates_obstacles_and_other_integrals() -> None:
    cost = QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    parts = [
        Spheres([[0.2, 0.1]], [0.1], vehicle_radius=0.06),
        RateBounds(-2.0, 2.0),
        Integral(lambda x, u: u.square().sum(-1), most=20.0, name="effort"),
        ControlBounds([-10, -10], [10, 10]),
        Integral(lambda x, u: x[..., 3], least=1.0, most=2.2, name="way"),
    ]
    problem = Problem(Planar(dt=0.1), cost, parts, [-1.0, 0, 0, 0, 0, 0], 40)
    solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED]
    verdict = judge(problem, solution.U)
    assert bool(verdict.feasible.all()) and float(verdict.violation) < 1e-5
    effort = 0.1 * solution.U.square().sum()
    assert float(effort) == pytest.approx(20.0, abs=1e-4)
    assert [lam.shape[1:] for lam in solution.multipliers.lam][2::2] == [(1, 1), (1, 2)]


def test_whole_steps_count_dt_times_the_value_at_each_knot() -> None:
    step = lambda x, u: x + DT * cart(x, u)
    cost, x0 = made().cost, STARTS
    model = FunctionDynamics(step, n=2, m=1, dt=DT, integrator="none")
    problem = Problem(model, cost, [BUDGET, ControlBounds(-3, 3)], x0, N)
    solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED] * 2
    total = DT * spent(solution.X[:, :-1], solution.U).sum(-1)
    torch.testing.assert_close(total, MOST, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_functions_take_values_and_the_stage() -> None:
    weights = torch.tensor([1.0, 2.0], dtype=D)
    rate = lambda x, u, k, w: w * (1.0 + 0.1 * k) * u[..., 0].square()
    problem = made(Integral(rate, MOST, values={"w": weights}))
    solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED] * 2
    stage = 1.0 + 0.1 * torch.arange(N, dtype=D)
    total = weights * (DT * stage * solution.U[..., 0].square()).sum(-1)
    torch.testing.assert_close(total, MOST, rtol=1e-6, atol=1e-6)


def test_a_problem_has_the_same_result_alone() -> None:
    whole = torchgco.solve(made(BUDGET))
    for b in range(2):
        alone = torchgco.solve(made(BUDGET).take([b]), ids=torch.tensor([b]))  # type: ignore[arg-type]
        assert torch.equal(alone.X[0], whole.X[b]) and torch.equal(alone.U[0], whole.U[b])


@pytest.mark.slow
def test_peers_take_it_as_rows_and_fleets_of_each_vehicle() -> None:
    pytest.importorskip("casadi")
    for more in ({}, {"time": FreeTime(0.3, 2.0, weight=1.0)}):
        problem = made(BUDGET, **more)
        ours, peers = torchgco.solve(problem), torchgco.solve(problem, solver="ipopt")
        torch.testing.assert_close(peers.cost, ours.cost, rtol=1e-5, atol=1e-5)
    goals = ([1.0, 0.0], [1.0, 0.5])
    effort = Integral(lambda x, u: u.square().sum(-1), most=6.0)
    vehicles = []
    for x, y in goals:
        cost = QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[x, y, 0, 0, 0, 0])
        vehicles.append(Problem(Planar(dt=0.1), cost, [effort], [0.0, y, 0, 0, 0, 0], 20, goal=Goal([x, y], 1.0)))
    solution = torchgco.solve(Fleet(vehicles, apart=0.1))
    for one in solution:
        assert 0.1 * float(one.U.square().sum()) == pytest.approx(6.0, abs=1e-2)


def test_costs_change_with_the_budget_by_its_multiplier() -> None:
    most = MOST.clone().requires_grad_()
    solution = torchgco.solve(made(Integral(spent, most)))
    (slope,) = torch.autograd.grad(solution.cost.sum(), most)
    above, below = (torchgco.solve(made(Integral(spent, MOST + step))).cost for step in (1e-4, -1e-4))
    torch.testing.assert_close(slope, (above - below) / 2e-4, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(slope, -solution.multipliers.lam[0].detach().flatten(), rtol=1e-4, atol=1e-4)


def test_warm_starts_and_given_states_are_taken() -> None:
    problem = made(BUDGET)
    solution = torchgco.solve(problem)
    warm = torchgco.solve(problem, warm=solution)
    assert bool((warm.iterations <= solution.iterations).all())
    states = torchgco.solve(problem, U0=solution.U, X0=solution.X, solver="interior_point")
    torch.testing.assert_close(states.cost, solution.cost, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    "part, field",
    [
        (lambda: Integral(spent), "integral"),
        (lambda: Integral(spent, most=1.0, equals=1.0), "integral"),
        (lambda: Integral(spent, most=1.0, least=1.0), "integral.least"),
        (lambda: Integral(spent, most=math.inf), "integral.most"),
        (lambda: Integral(spent, most=[1.0, 2.0, 3.0]), "integral.most"),
        (lambda: Integral(3.0, most=1.0), "integral.function"),  # type: ignore[arg-type]
        (lambda: Integral(lambda x, u: u, most=1.0, name="fuel"), "fuel.function"),
        (lambda: Integral(spent, most=1.0, values={"w": MOST}), "integral.values['w']"),
    ],
)
def test_wrong_integrals_are_refused_in_a_line(part: Any, field: str) -> None:
    with pytest.raises(InputError) as error:
        made(part())
    assert str(error.value).startswith(f"{field}:") and "\n" not in str(error.value)


def test_what_cannot_take_it_says_so(tmp_path: Path) -> None:
    problem = made(BUDGET).take([0])  # type: ignore[arg-type]
    calls = [torchgco.compile, MPC, lambda p: torchgco.export_c(p, tmp_path)]
    for call in calls:
        with pytest.raises(InputError, match="Integral"):
            call(problem)
    knots = {"dt": torch.full((1, N), DT, dtype=D)}
    uneven = FunctionDynamics(lambda x, u, dt: x + dt * u, n=1, m=1, dt=DT, integrator="none", knot_values=knots)
    cost = QuadraticCost(Q=[1.0], R=[1.0], Qf=[1.0], x_ref=[1.0])
    with pytest.raises(InputError, match=r"dynamics\.dt"):
        Problem(uneven, cost, [Integral(lambda x, u: u[..., 0], 1.0)], torch.zeros(1, 1, dtype=D), N)
