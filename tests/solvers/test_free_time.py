"""Least times against closed forms, from any guess; the batch contract; and what is told where no time does."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

import torchgco
from tests.problems import assert_same_bits
from tests.slow import mostly
from torchgco import (
    Airframe,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    HorizonWarning,
    InputError,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    RateBounds,
    Solution,
    Spheres,
    StateBounds,
    Status,
    certify,
    judge,
)
from torchgco.dynamics.rollout import open_loop
from torchgco.problem.in_time import fitting_factors, in_time, states_in_time
from torchgco.solvers.convexity import looks_convex

D = torch.float64
INF = float("inf")


def carts(N: int = 60, B: int = 8, fastest: float = INF, nominal: float = 3.0, **time: Any) -> Problem:
    """Carts that come to rest at the origin in the least time, thrust at most 1, from drawn places and speeds."""
    draws = torch.Generator().manual_seed(7)
    d, v = -3.5 + 7.0 * torch.rand(B, generator=draws, dtype=D), -1.5 + 3.0 * torch.rand(B, generator=draws, dtype=D)
    x0 = torch.stack((d, v.clamp(-fastest, fastest)), dim=-1)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, nominal / N, "rk4")
    rows = [
        ControlBounds(-1.0, 1.0),
        FunctionConstraint(lambda x: x, "equality", knots=[-1], name="at rest"),
        *([StateBounds([-INF, -fastest], [INF, fastest])] if fastest < INF else []),
    ]
    free = FreeTime(**{"least": 0.02, "most": 20.0, **time})
    return Problem(model, FunctionCost(lambda x, u: 0.0 * u[..., 0]), rows, x0, N, time=free)


def least_time(x0: torch.Tensor, fastest: float = INF) -> np.ndarray:
    """Thrust one way and then the other, with the fastest speed between where that is reached."""
    found = []
    for x, v in x0.tolist():
        side = 1.0 if x + 0.5 * v * abs(v) > 0 else -1.0  # thrust away from where it would stop
        x, v = side * x, side * v
        peak = (x + 0.5 * v * v) ** 0.5
        if peak <= fastest:
            found.append(v + 2.0 * peak)
        else:
            found.append(v + 2.0 * fastest + (x + 0.5 * v * v - fastest * fastest) / fastest)
    return np.array(found)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("fastest", [INF, 1.0])
@pytest.mark.parametrize("guess", [None, 0.1, 1.0, 10.0])
def test_least_times_are_those_of_the_closed_form(fastest: float, guess: float | None) -> None:
    best = torch.from_numpy(least_time(carts(fastest=fastest).x0, fastest))
    problem = carts(fastest=fastest, guess=None if guess is None else (guess * best / 3.0).clamp(0.02, 20.0))
    found = torchgco.solve(problem)
    assert bool((found.status == Status.CONVERGED).all())
    assert bool((found.violation <= 1e-6).all())
    excess = found.duration / best - 1.0
    assert bool((excess.abs() < 1e-3).all())  # stages are equally long: the switch falls within one
    assert int(found.iterations.median()) <= 30
    assert found.t.shape == (8, 61)
    torch.testing.assert_close(found.cost, found.duration)


@pytest.mark.slow
def test_segments_switch_exactly() -> None:
    problem = carts(N=20, segments=2)
    found = torchgco.solve(problem)
    excess = found.duration / torch.from_numpy(least_time(problem.x0)) - 1.0
    assert int((excess.abs() < 1e-6).sum()) >= 6 and bool((excess.abs() < 1e-2).all())  # or within a stage of a segment
    lengths = found.t.diff(dim=1)
    torch.testing.assert_close(lengths[:, :10], lengths[:, :1].expand(-1, 10))
    assert bool(((lengths[:, 0] - lengths[:, -1]).abs() > 1e-3).any())
    certificate = certify(problem, found.X, found.U, times=found.t, multipliers=found.multipliers.lam)
    assert bool((certificate.kkt_residual < 1e-6).all())


@pytest.mark.parametrize("seed", range(2))
def test_what_is_left_of_controls_that_cost_nothing_is_measured_by_the_cost(seed: int) -> None:
    """Time alone costs, and one axis waits for the other: its controls are pushed by far rows alone."""
    draws = torch.Generator().manual_seed(seed)
    places = 1.0 + 2.0 * torch.rand(3, 2, generator=draws, dtype=D)
    speeds = -0.2 + 0.5 * torch.rand(3, 2, generator=draws, dtype=D)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), dim=-1), 4, 2, 0.1, "rk4")
    rows = [ControlBounds(-1.0, 1.0), FunctionConstraint(lambda x: x, "equality", knots=[-1])]
    time, nothing = FreeTime(0.2, 6.0, weight=1.0, segments=3), FunctionCost(lambda x, u: 0.0 * u[..., 0])
    problem = Problem(model, nothing, rows, torch.cat((places, speeds), dim=-1), 24, time=time)
    found = torchgco.solve(problem)
    assert found.statuses == [Status.CONVERGED] * 3
    for lams in (None, found.multipliers.lam):
        assert float(certify(problem, found.X, found.U, None, lams, found.t).kkt_residual.max()) < 5e-3


@pytest.mark.slow
def test_judge_certificate_tables_and_files_know_the_times(tmp_path: Path) -> None:
    problem = carts()
    found = torchgco.solve(problem)
    verdict = judge(problem, found.U, times=found.t)
    torch.testing.assert_close(verdict.cost, found.cost, rtol=0, atol=1e-9)
    assert bool(verdict.feasible.all())
    assert bool((judge(problem, found.U, times=1.5 * found.t).violation > 0.1).all())  # these controls, more slowly
    assert bool((judge(problem, found.U, times=100.0 * found.t).violation > 10.0).all())  # longer than `most`
    for lams in (None, found.multipliers.lam):
        assert bool((certify(problem, found.X, found.U, None, lams, found.t).kkt_residual < 1e-5).all())
    slower = torchgco.solve(carts(weight=1.0, least=2.0))  # some end at the least time, some above
    at_least = certify(carts(least=2.0), slower.X, slower.U, times=slower.t, multipliers=slower.multipliers.lam)
    assert bool((at_least.kkt_residual < 1e-3).all())
    with pytest.raises(InputError, match="times: expected the times of the knots"):
        judge(problem, found.U)
    assert found.to_frame()["duration"].tolist() == found.duration.tolist()
    assert "duration" in found.explain(0, problem)
    found.save(tmp_path / "found.npz")
    again = Solution.load(tmp_path / "found.npz")
    assert torch.equal(again.t, found.t) and torch.equal(again.duration, found.duration)
    assert torch.equal(again.take([3, 1]).t, found.t[[3, 1]])
    assert int(torchgco.solve(problem, warm=again).iterations.max()) <= 5


@pytest.mark.slow
def test_a_held_time_that_is_optimal_has_no_slope_in_time() -> None:
    """Slower or faster than the least, the residual says so: the certificate is one with respect to time."""
    fixed = replace(carts(), time=None, cost=QuadraticCost([0.0] * 2, [1.0], [0.0] * 2))
    problem = replace(fixed, time=FreeTime(0.2, 5.0))
    at_nominal = torchgco.solve(fixed.take(slice(0, 1)))
    even = fixed.dynamics.dt * torch.arange(61, dtype=D).unsqueeze(0)
    one = problem.take(slice(0, 1))
    assert float(certify(one, at_nominal.X, at_nominal.U, times=even).kkt_residual) > 0.1
    best = torchgco.solve(one)
    assert float(certify(one, best.X, best.U, times=best.t).kkt_residual) < 1e-5
    assert float(best.cost) < float(judge(one, at_nominal.U, times=even).cost)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("segments", [None, 2])
def test_a_problem_has_the_same_bits_in_any_batch(segments: int | None) -> None:
    problem = carts(N=30, segments=segments)
    whole = torchgco.solve(problem)
    for order in map(torch.tensor, ([5, 2, 7], [1], [4])):
        part = torchgco.solve(problem.take(order), ids=order)
        assert_same_bits(part, whole.take(order))
        assert torch.equal(part.t, whole.t[order])


def test_limits_on_rates_are_per_second() -> None:
    problem = carts()
    rates = RateBounds(-0.1, 0.1, previous=[0.0])
    gentle = replace(problem, constraints=[*problem.constraints, rates])
    found = torchgco.solve(gentle)
    assert bool((found.status == Status.CONVERGED).all())
    change = found.U.diff(dim=1, prepend=torch.zeros(8, 1, 1, dtype=D))[..., 0].abs()
    speed = change / found.t.diff(dim=1)
    torch.testing.assert_close(speed.amax(-1), torch.full((8,), 0.1 / 0.05, dtype=D))
    assert bool((found.duration > torchgco.solve(problem).duration).all())
    assert bool(judge(gentle, found.U, times=found.t).feasible.all())


@pytest.mark.slow
def test_the_least_time_that_would_do_is_told() -> None:
    problem = carts(most=0.8)
    with pytest.warns(HorizonWarning, match=r"time\.most: \d of 8 problems need more time"):
        found = torchgco.solve(problem)
    best = torch.from_numpy(least_time(problem.x0))
    late = best > 2.4
    assert bool(late.any()) and not bool(late.all())
    assert bool((found.status[late] == Status.INFEASIBLE).all())
    assert found.needed is not None
    torch.testing.assert_close(found.needed[late], best[late], rtol=1e-3, atol=0)
    assert bool(found.needed[~late].isnan().all()) and bool((found.status[~late] == Status.CONVERGED).all())
    assert f"{float(found.needed[late][0]):.4g} s would do" in found.explain(int(late.nonzero()[0]))


def test_time_costs_what_it_is_said_to() -> None:
    """From rest to rest over 1 m with cost u^2: 12 / T^3 + w T, which is least at T^4 = 36 / w."""
    weights = torch.tensor([0.5, 4.0, 36.0], dtype=D)
    problem = carts(B=3, weight=weights)
    cost = FunctionCost(lambda x, u: 0.05 * u[..., 0].square())  # of a stage of dt = 0.05
    x0 = torch.tensor([[1.0, 0.0]] * 3, dtype=D)
    found = torchgco.solve(replace(problem, cost=cost, x0=x0, constraints=[problem.constraints[1]]))
    expected = (36.0 / weights) ** 0.25
    torch.testing.assert_close(found.duration, expected, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.cost, 12.0 / expected**3 + weights * expected, rtol=1e-3, atol=0)


def flight(model: Any, rows: list[Any], rest: float) -> Problem:
    """Twelve hundred metres from rest to rest, in the least time."""
    x0 = torch.zeros(1, model.n, dtype=D)
    x0[:, 6], x0[:, 13:] = 1.0, rest
    end = torch.tensor([1200.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=D)
    arrives = FunctionConstraint(lambda x: x[..., :6] - end, "equality", knots=[-1], name="at rest there")
    cost = FunctionCost(lambda x, u: 0.0 * u[..., 0])
    return Problem(model, cost, [*rows, arrives], x0, round(20.0 / model.dt), time=FreeTime(0.5, 3.0))


def planning(integrator: str) -> Problem:
    model = QuadrotorPlanning(0.2, integrator, rate_time_constant=0.3, thrust_time_constant=0.3)  # type: ignore[arg-type]
    low, high = Airframe().accelerations
    return flight(model, [ControlBounds([-2.0, -2.0, -2.0, low], [2.0, 2.0, 2.0, high])], 9.81)


def plant() -> Problem:
    low, high = Airframe().rotor_speeds
    turns = StateBounds([-INF] * 10 + [-3.0] * 3 + [-INF] * 4, [INF] * 10 + [3.0] * 3 + [INF] * 4)
    return flight(QuadrotorPlant(0.1), [ControlBounds(low, high), turns], Airframe().hover_thrust)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly(["euler", "midpoint", "rk4", "plant"], "midpoint", "rk4", "plant"))
def test_quaternions_keep_their_norm_at_the_least_time(name: str) -> None:
    """Twenty seconds at the least time: the thrust isn't what the norm of a quaternion makes of it."""
    problem = plant() if name == "plant" else planning(name)
    found = torchgco.solve(problem, solver="interior_point")
    assert float(found.violation) <= 1e-6 and float(found.duration) >= 20.0
    torch.testing.assert_close(found.X[..., 6:10].norm(dim=-1), torch.ones_like(found.t), rtol=0, atol=1e-12)
    v, t = found.X[0, :, 3:6], found.t[0]
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=D)
    push = (v.diff(dim=0) / t.diff().unsqueeze(-1) - gravity).norm(dim=-1)  # mean thrust acceleration of each stage
    assert float(push.max()) <= Airframe().accelerations[1] * (1.0 + 1e-6)


@pytest.mark.slow
def test_solvers_that_hold_the_time_are_refused() -> None:
    for solver in ("al_ilqr", "gco_paper", "mppi", "hold", "multistart"):
        with pytest.raises(InputError, match="solver: expected interior_point, gco, gco_exact, ipopt or fatrop"):
            torchgco.solve(carts(B=1), solver=solver)
    with pytest.raises(InputError, match="problem: expected one of fixed times"):
        torchgco.MPPIController(carts(B=1))
    with pytest.raises(InputError, match="solution: expected one of fixed times"):
        torchgco.solve(carts(B=1, N=20)).shifted()


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_peers_find_the_same_times(solver: str) -> None:
    problem = carts(B=2, N=30)
    ours, theirs = (torchgco.solve(problem, solver=name).duration for name in ("gco", solver))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=0)


@pytest.mark.slow
def test_the_time_frees_itself_of_its_guess_among_obstacles() -> None:
    """A ball around two discs: the same time from short and long guesses, clear, and at the goal."""
    x0 = torch.zeros(3, 4, dtype=D)
    there = torch.tensor([4.0, 0.0, 0.0, 0.0], dtype=D)
    cost = QuadraticCost([0.0] * 4, [0.01] * 2, [0.0] * 4, x_ref=there)
    rows = [
        ControlBounds(-2.0, 2.0),
        Spheres([[1.5, 0.1], [2.8, -0.2]], [0.4, 0.5], vehicle_radius=0.1),
        FunctionConstraint(lambda x: x - there, "equality", [-1], name="there"),
    ]
    guess = torch.tensor([0.5, 1.0, 4.0], dtype=D)
    move = lambda x, u: torch.cat((x[..., 2:], u), dim=-1)
    model = FunctionDynamics(move, 4, 2, 0.075, position=slice(0, 2))
    time = FreeTime(0.2, 5.0, weight=1.0, guess=guess)
    problem = Problem(model, cost, rows, x0, 40, Goal([4.0, 0.0], 0.2), time=time)
    found = torchgco.solve(problem)
    assert bool((found.violation <= 1e-6).all())
    assert float(found.cost.max() / found.cost.min()) < 1.01
    verdict = judge(problem, found.U, times=found.t)
    assert bool(verdict.reached.all())
    straight = least_time(torch.tensor([[-4.0, 0.0]], dtype=D))[0] / 2.0**0.5  # thrust 2, without discs
    assert bool((found.duration > straight).all())


def around_a_disc(free: bool = False, **time: Any) -> Problem:
    """A ball goes round a disc to a place at rest; with `free`, from any height of at most 0.8 m."""
    there = torch.tensor([4.0, 0.0, 0.0, 0.0], dtype=D)
    x0 = torch.tensor([[0.0, 0.2, 0.0, 0.0], [0.0, -0.1, 0.0, 0.0]], dtype=D)
    cost = QuadraticCost([0.0] * 4, [0.01] * 2, [0.0] * 4, x_ref=there)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, position=slice(0, 2))
    rows: list[Any] = [ControlBounds(-2.0, 2.0), Spheres([[2.0, 0.0]], [0.5], 0.1)]
    rows.append(StateBounds([-INF, -0.8, -INF, -INF], [INF, 0.8, INF, INF], knots=[0]))
    mask = [False, True, False, False] if free else None
    return Problem(model, cost, rows, x0, 30, Goal(state=there, required=True), free_start=mask, time=FreeTime(**time))


@pytest.mark.slow
def test_a_free_start_is_chosen_with_the_time() -> None:
    """The best start is beside the straight line, as the way round the disc is, and no dearer than others."""
    free = torchgco.solve(around_a_disc(True))
    assert bool((free.violation < 1e-6).all())
    for heights, better in (([0.2, -0.1], 1e-3), ([0.5, -0.5], -1e-3)):
        given = around_a_disc()
        x0 = given.x0.clone()
        x0[:, 1] = torch.tensor(heights, dtype=D)
        held = torchgco.solve(replace(given, x0=x0))
        assert bool((held.violation < 1e-6).all() & (free.cost < held.cost - better).all())


@pytest.mark.slow
def test_a_record_is_kept_and_explained() -> None:
    problem = around_a_disc(weight=0.3)
    plain, kept = torchgco.solve(problem), torchgco.solve(problem, record=True)
    assert torch.equal(plain.U, kept.U) and torch.equal(plain.cost, kept.cost)
    assert kept.trace is not None and kept.search is not None
    for b in (0, 1):
        own = kept.trace[kept.trace["element"] == b]
        assert own.groupby("attempt")["iteration"].apply(lambda i: i.is_monotonic_increasing).all()
        assert own["attempt"].nunique() > 1 and len(own) <= int(kept.iterations[b])
    good = torch.stack([one.violation.le(1e-3) for one in kept.search.standings if one is not None]).any()
    assert bool(good) and kept.search.comparisons[0].tracked.shape[-1] == problem.n
    costs = torch.cat([one.cost[one.violation <= 1e-3] for one in kept.search.standings if one is not None])
    assert float(costs.min()) == pytest.approx(float(kept.cost.min()), rel=1e-4)  # in the user's units
    assert "pass" in kept.explain(0)


def test_state_bounds_are_certified_too() -> None:
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4")
    cost = QuadraticCost([0.0, 0.0], [1e-3], [0.0, 0.0])
    x0 = torch.tensor([[0.0, 0.0], [0.2, 0.1]], dtype=torch.float64)
    for rows in ([StateBounds(-0.6, [2.0, 0.6])], [StateBounds(-0.6, [2.0, 0.6], knots=[5]), ControlBounds(-3.0, 3.0)]):
        goal = Goal(state=[1.0, 0.0], required=True)
        bounds = rows if len(rows) > 1 else [*rows, ControlBounds(-1.0, 1.0)]
        problem = Problem(model, cost, bounds, x0, 20, goal, time=FreeTime())
        found = torchgco.solve(problem, solver="interior_point")
        proof = torchgco.certify(problem, found.X, found.U, times=found.t)
        assert float(proof.bound_violation.max()) < 1e-6


def before_or_behind(**time: Any) -> Problem:
    """A disc crosses the way of a ball, which gets to the other side in the least time before it, or behind it."""
    there = torch.tensor([4.0, 0.0, 0.0, 0.0], dtype=D)
    x0 = torch.zeros(3, 4, dtype=D)
    cost = QuadraticCost([0.0] * 4, [1e-3] * 2, [0.0] * 4, x_ref=there)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
    lane = StateBounds([-INF, -0.2, -INF, -INF], [INF, 0.2, INF, INF])
    heights = torch.tensor([[[2.0, -5.0]], [[2.0, -1.6]], [[2.0, 0.4]]], dtype=D)
    crossing = Spheres(heights, [0.5], 0.1, [[0.0, 1.0]])
    goal = Goal(state=there, required=True)
    return Problem(
        model, cost, [ControlBounds(-2.0, 2.0), lane, crossing], x0, 30, goal, time=FreeTime(0.5, 4.0, **time)
    )


@pytest.mark.slow
def test_a_moving_disc_is_passed_at_the_time_that_is_found() -> None:
    """It comes too late to matter; it is waited for; it was there before. Judge, certificate and files see the same."""
    problem = before_or_behind()
    found = torchgco.solve(problem)
    free = 2.0 * (4.0 / 2.0) ** 0.5
    assert bool((found.violation <= 1e-6).all())
    torch.testing.assert_close(found.duration[[0, 2]], torch.full((2,), free, dtype=D), rtol=1e-2, atol=0)
    assert float(found.duration[1]) > 1.05 * free
    verdict = judge(problem, found.U, times=found.t)
    assert bool(verdict.reached.all()) and float(verdict.clearance[1]) < 0.1
    proof = torchgco.certify(problem, found.X, found.U, times=found.t)
    spheres: Any = problem.obstacles[0]
    for b in range(3):  # by plain differences
        middle = spheres.centers[b, 0] + found.t[b, :, None] * spheres.velocities[b, 0]
        gaps = (found.X[b, :, :2] - middle).norm(dim=-1)
        assert float(verdict.clearance_knots[b]) == pytest.approx(float(gaps.min()) - 0.95 * 0.6, abs=1e-9)
        assert float(proof.clearance[b]) <= float(gaps.min()) - 0.6 + 1e-9
    again = torchgco.solve(problem, warm=found)
    torch.testing.assert_close(again.duration, found.duration, rtol=1e-3, atol=0)
    alone = torchgco.solve(problem.take(torch.tensor([1])), ids=torch.tensor([1]))
    assert torch.equal(alone.X[0], found.X[1]) and torch.equal(alone.duration[0], found.duration[1])


@pytest.mark.slow
def test_a_moving_disc_in_other_hands() -> None:
    """IPOPT and the interior point alone find clear ways at their own times; the figure draws the disc where it is."""
    problem = before_or_behind().take(torch.tensor([1]))
    for solver in ("ipopt", "interior_point"):
        found = torchgco.solve(problem, solver=solver)
        assert bool(judge(problem, found.U, times=found.t).reached.all())
    figure = torchgco.plot(problem, found)
    assert figure.axes and torchgco.show(problem, found).save


@pytest.mark.slow
def test_a_moving_target_is_met_at_the_time_that_is_found() -> None:
    """The duration balances effort, time and where the target is then; with the stages held there, the cost is the
    same, and larger in a little less or more time."""
    N, dt, weight = 30, 0.1, 0.4
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, dt, "rk4")
    rows = lambda s: np.stack((1.0 + 0.3 * s + 0.05 * s * s, 0.3 + 0.1 * s), -1)  # m and m/s, at s seconds
    target = CubicSpline(np.arange(N + 1), rows(dt * np.arange(N + 1)), bc_type="natural")

    def chase(tau: float | None = None) -> Problem:
        own = 1.0 if tau is None else tau
        x_ref = target(own * np.arange(N + 1))
        cost = QuadraticCost([0.2 * own, 0.0], [0.1 * own], [50.0, 20.0], torch.from_numpy(x_ref))
        free = FreeTime(0.2, 3.0, weight) if tau is None else None
        return Problem(replace(model, dt=own * dt), cost, [ControlBounds(-3.0, 3.0)], [[0.0, 0.0]], N, time=free)

    found = torchgco.solve(chase())
    assert [status.name for status in found.statuses] == ["CONVERGED"]
    tau = float(found.duration) / (N * dt)
    assert 0.3 < tau < 0.95
    held = torchgco.solve(chase(tau))
    torch.testing.assert_close(held.X, found.X, rtol=0, atol=1e-5)
    least = float(held.cost) + weight * float(found.duration)
    assert float(found.cost) == pytest.approx(least, rel=1e-8)
    for other in (0.98 * tau, 1.02 * tau):
        assert float(torchgco.solve(chase(other)).cost) + weight * other * N * dt > least


def braking(B: int, seed: int, **time: Any) -> Problem:
    """Craft with a thrust of constant size that come to rest at the origin by turning it: many local minima."""
    draws = torch.Generator().manual_seed(seed)
    x0 = torch.cat((2.0 * torch.rand(B, 2, generator=draws, dtype=D) + 1.0, torch.zeros(B, 2, dtype=D)), -1)
    rates = lambda x, u: torch.cat((x[..., 2:], torch.cos(u), torch.sin(u)), -1)
    model = FunctionDynamics(rates, 4, 1, 0.1, "rk4", position=slice(0, 2))
    free = FreeTime(**{"least": 0.2, "most": 4.0, **time})
    rows, goal = [ControlBounds(-7.0, 7.0)], Goal(state=[0.0] * 4, required=True)
    return Problem(model, FunctionCost(lambda x, u: 0.0 * u[..., 0]), rows, x0, 40, goal=goal, time=free)


@pytest.mark.parametrize("segments", [None, 2])
def test_given_states_and_controls_set_the_time(segments: int | None) -> None:
    """What drawn controls do in drawn times: from there the time is free, without a guess of it."""
    draws = torch.Generator().manual_seed(3)
    given = braking(5, 1, segments=segments)
    assert given.time is not None
    taken = given.time.least + 3.0 * torch.rand(5, given.time.count, generator=draws, dtype=D)
    U = torch.rand(5, 1, 1, generator=draws, dtype=D) + torch.linspace(0, 2, 40, dtype=D).view(1, -1, 1)
    whole = in_time(given, taken)
    _, lifted = states_in_time(given, torch.zeros(5, 41, 4, dtype=D), U, taken)
    X = open_loop(whole.dynamics, whole.x0, lifted)[..., :4]
    torch.testing.assert_close(fitting_factors(given, X, U), taken, rtol=2e-3, atol=0)
    bent = X + 0.3 * torch.rand(X.shape, generator=draws, dtype=D)  # which no controls lead to
    assert bool(fitting_factors(given, bent, U).isnan().all())


def test_the_states_and_controls_of_a_solution_are_kept_without_its_time() -> None:
    problem = braking(3, 2)
    first = torchgco.solve(problem, solver="gco_max", verbose=False)
    assert bool((first.violation <= 1e-6).all())
    again = torchgco.solve(problem, U0=first.U, X0=first.X, solver="interior_point", verbose=False)
    assert bool((again.duration <= first.duration * (1.0 + 1e-4)).all())


@pytest.mark.slow
def test_drawn_guesses_find_shorter_times() -> None:
    """Of the default roughly, side by side, where a problem isn't convex; in any batch the same."""
    problem = braking(6, 5)
    once, found = (torchgco.solve(problem, solver=name, verbose=False) for name in ("interior_point", "gco"))
    assert bool((found.cost <= once.cost).all()) and int((found.cost < 0.99 * once.cost).sum()) >= 2
    assert bool((found.violation <= 1e-6).all()) and bool((found.iterations > once.iterations).all())
    for solver in ("gco", "gco_max"):
        whole = torchgco.solve(problem, solver=solver, verbose=False)
        alone = torchgco.solve(problem.take(torch.tensor([2])), solver=solver, ids=torch.tensor([2]), verbose=False)
        assert_same_bits(alone, whole.take([2]))


def test_what_looks_convex_at_a_held_time_is_solved_once() -> None:
    """A linear model with convex rows isn't tried from other guesses; a row that curves the other way is seen."""
    problem = carts(B=3)
    once, found = (torchgco.solve(problem, solver=name) for name in ("interior_point", "gco"))
    assert torch.equal(found.iterations, once.iterations) and torch.equal(found.U, once.U)
    X, U = found.X, found.U
    rows = [lambda x: x[..., :1].square() - 50.0, lambda x: 0.01 - x[..., :1].square(), lambda x: x[..., :1].sin()]
    for row, convex in zip(rows, (True, False, False), strict=True):
        one = replace(problem, constraints=[*problem.constraints, FunctionConstraint(row)])
        assert looks_convex(one, X, U).tolist() == [convex] * 3
    assert not bool(looks_convex(braking(3, 1), torch.zeros(3, 41, 4, dtype=D), torch.zeros(3, 40, 1, dtype=D)).any())


@pytest.mark.sampled(4)
@pytest.mark.filterwarnings("ignore::torchgco.HorizonWarning")
@pytest.mark.parametrize("most", [0.05, 0.4, 0.8])
@pytest.mark.parametrize("name", ["gco", "gco_max", "gco_fast", "interior_point"])
def test_a_time_that_is_too_short_for_all_or_some(name: str, most: float) -> None:
    """Where none of a batch converged, the search for other minima ended the solve with an error of PyTorch."""
    problem = carts(N=20, B=6, most=most)
    found = torchgco.solve(problem, solver=name, verbose=False)
    possible = torch.from_numpy(least_time(problem.x0)) <= 3.0 * most
    assert [status.name == "CONVERGED" for status in found.statuses] == possible.tolist()
    assert bool((found.violation[~possible] > 1e-3).all())
    late = (~possible).nonzero().flatten()
    alone = torchgco.solve(problem.take(late), solver=name, ids=late, verbose=False)
    assert_same_bits(alone, found.take(late))


def test_no_time_is_thought_to_be_too_short_where_the_first_guess_is_a_saddle() -> None:
    """x' = y u - 0.75 u^2, y' = u - y: without control no control has a slope, and at most it takes long to get far.

    A particle that an electric field draws (Chang, Petit and Rouchon, 2006).
    """

    def rates(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        u = u[..., 0]
        return torch.stack((x[..., 1] * u - 0.75 * u.square(), u - x[..., 1]), dim=-1)

    ends = torch.tensor([[1.5], [2.0], [2.5], [3.0]], dtype=D)
    model = FunctionDynamics(rates, 2, 1, 1.0 / 60, "rk4")
    rows = [
        ControlBounds(-1, 1),
        FunctionConstraint(lambda x, end: x[..., :1] - end, "equality", knots=[-1], name="end", values={"end": ends}),
    ]
    free = FunctionCost(lambda x, u: 0.0 * u[..., 0])
    x0 = torch.tensor([[1.0, 0.0]], dtype=D).expand(4, 2)
    problem = Problem(model, free, rows, x0, 60, time=FreeTime(0.1, 40.0))
    solution = torchgco.solve(problem, verbose=False)
    assert solution.statuses == [Status.CONVERGED] * 4
    best = torchgco.solve(problem, torch.full((4, 60, 1), 0.5, dtype=D), verbose=False)  # which tells the way
    assert solution.duration.tolist() == pytest.approx(best.duration.tolist(), rel=1e-4)
