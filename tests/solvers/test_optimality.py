"""CONVERGED means stationary and feasible, on any scale of the cost."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.problems import planar_batch, quadrotor_batch, quick_gco
from torchgco import (
    ILQR,
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    PathProposals,
    Planar,
    Problem,
    QuadraticCost,
    Restarts,
    Spheres,
    Status,
    certify,
    compose,
    judge,
    presets,
    solve,
)
from torchgco.baselines import Hold, IteratedMPPI
from torchgco.costs.base import Cost
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.search.restarts import suited_paths
from torchgco.solvers.ending import STATIONARY, final_status, optimality, start_status

CAREFUL = ILQR(max_iterations=300)


def pendulum(scale: float = 1.0, constraints: tuple = ()) -> Problem:
    """Swing up from hanging; only the cost limits u."""

    def field(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.stack((x[..., 1], 9.81 * torch.sin(x[..., 0]) - 0.1 * x[..., 1] + u[..., 0]), dim=-1)

    cost = QuadraticCost(
        Q=[scale * 0.1, scale * 0.01], R=[scale * 0.01], Qf=[scale * 100.0, scale * 10.0], x_ref=[0.0, 0.0]
    )
    start = torch.tensor([[torch.pi, 0.0], [2.5, 0.0]], dtype=torch.float64)
    return Problem(FunctionDynamics(field, 2, 1, dt=0.05, integrator="rk4"), cost, constraints, start, 60)


def rest(problem: Problem) -> torch.Tensor:
    return problem.x0.new_zeros(problem.B, problem.N, problem.m)


def scaled(problem: Problem, factor: float) -> Problem:
    """The same problem with all weights times a factor."""
    return problem._with({"cost": problem.cost.scaled(torch.full_like(problem.x0[:, 0], factor))})


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_scale_of_the_cost_changes_no_iterate(factor: float) -> None:
    one, other = (CAREFUL.solve(p, rest(p)) for p in (pendulum(), pendulum(factor)))
    assert torch.equal(one.iterations, other.iterations) and one.statuses == other.statuses
    torch.testing.assert_close(one.U, other.U, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(factor * one.cost, other.cost, rtol=1e-9, atol=0)


@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
@pytest.mark.parametrize(("batch", "seed"), [(planar_batch, 4), (quadrotor_batch, 2)])
def test_the_scale_of_the_cost_changes_no_iterate_with_guidance(batch, seed: int, factor: float) -> None:
    problem = batch(B=2, N=25, obstacles=6, seed=seed)[0]
    one, other = (solve(p, solver=quick_gco(p)) for p in (problem, scaled(problem, factor)))
    assert torch.equal(one.iterations, other.iterations) and one.statuses == other.statuses
    assert torch.equal(one.guided, other.guided) and int(one.guided.sum()) > 0
    torch.testing.assert_close(one.U, other.U, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(factor * one.cost, other.cost, rtol=1e-9, atol=0)
    for a, b in zip(one.multipliers.lam, other.multipliers.lam, strict=True):
        torch.testing.assert_close(factor * a, b, rtol=1e-5, atol=1e-6 * factor)


def test_a_user_cost_scales_as_a_quadratic_one_does() -> None:
    class Bowl(Cost):
        def stage(self, x, u, k):
            return (x.square().sum(-1) + 1.0).sqrt() + 0.1 * u.square().sum(-1)

        def terminal(self, x):
            return 5.0 * x.square().sum(-1)

    base = pendulum()
    problem = Problem(base.dynamics, Bowl(), [], base.x0, base.N)
    one, other = (CAREFUL.solve(p, rest(p)) for p in (problem, scaled(problem, 1e-4)))
    torch.testing.assert_close(one.U, other.U, rtol=1e-6, atol=1e-6)
    H, h = (problem.x0.new_zeros(2, 61, 4, 4) for _ in range(2))
    problem.cost.expand(one.X, one.U, H)
    scaled(problem, 3.0).cost.expand(one.X, one.U, h)
    torch.testing.assert_close(3.0 * H, h)
    x = torch.randn(2, 5, 2, dtype=torch.float64)
    u = torch.randn(2, 5, 1, dtype=torch.float64)
    triple = scaled(problem, 3.0).cost
    torch.testing.assert_close(triple.stage(x, u, 0), 3.0 * problem.cost.stage(x, u, 0))
    torch.testing.assert_close(triple.terminal(x), 3.0 * problem.cost.terminal(x))


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_a_swing_up_that_converged_is_at_its_optimum(scale: float) -> None:
    problem = pendulum(scale)
    solution = CAREFUL.solve(problem, rest(problem))
    tight = replace(CAREFUL, tolerance=1e-13, max_iterations=2000).solve(problem, solution.U)
    assert solution.statuses == [Status.CONVERGED] * 2
    assert bool((solution.cost <= 1.001 * tight.cost).all())
    assert float(certify(problem, solution.X, solution.U).kkt_residual.max()) < 0.05
    early = replace(CAREFUL, max_iterations=3).solve(problem, rest(problem))
    assert early.statuses == [Status.MAX_ITERATIONS] * 2


def test_the_status_is_one_of_four_by_stationarity_and_violation() -> None:
    """Unrefined controls are FEASIBLE at best; a solver that ignores constraints still reports their violation."""
    tight = (ControlBounds([-3.0], [3.0]),)
    problem = pendulum(constraints=tight)
    assert Hold().solve(problem, rest(problem)).statuses == [Status.FEASIBLE] * 2
    assert Hold().solve(problem, rest(problem) + 4.0).statuses == [Status.INFEASIBLE] * 2
    assert IteratedMPPI(iterations=2).solve(problem, rest(problem)).statuses == [Status.FEASIBLE] * 2
    free = CAREFUL.solve(problem, rest(problem))
    assert free.statuses == [Status.INFEASIBLE] * 2 and float(free.violation.min()) > 1.0
    hasty = AugmentedLagrangian(inner=replace(CAREFUL, max_iterations=1), max_outer_iterations=2)
    assert hasty.solve(problem, rest(problem)).statuses != [Status.CONVERGED] * 2
    soft = replace(hasty, initial_penalty=1e-9, penalty_growth=1.0).solve(problem, rest(problem))
    assert soft.statuses == [Status.MAX_ITERATIONS] * 2 and float(soft.violation.min()) > 1e-3
    thorough = replace(hasty, inner=CAREFUL, max_outer_iterations=30)
    done = thorough.solve(problem, rest(problem))
    assert done.statuses == [Status.CONVERGED] * 2
    lagrangian = Lagrangian(problem, done.multipliers, None, True)
    assert bool((optimality(lagrangian, done.X, done.U).left <= STATIONARY).all())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
@pytest.mark.filterwarnings("ignore::torchgco.StepWarning")  # Euler steps of half a second are what is unstable
def test_unstable_dynamics_are_solved_from_rest() -> None:
    """Euler steps of 0.5 s make the drag unstable: every rollout diverges until the gains stabilise all states."""
    problem = Problem(
        dynamics=Planar(dt=0.5),
        cost=QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.4, 0, 0, 0, 0]),
        constraints=[Spheres([[0.3, 0.1]], [0.1], vehicle_radius=0.06), ControlBounds([-10, -10], [10, 10])],
        x0=torch.tensor([[-1.0, 0, 0, 0, 0, 0], [-1.0, 0.3, 0, 0, 0, 0]], dtype=torch.float64),
        N=60,
    )
    solution = solve(problem)
    assert float(solution.cost.max()) < 67.0
    verdict = judge(problem, solution.U, torch.tensor([1.0, 0.4], dtype=torch.float64), 0.3)
    assert bool(verdict.reached.all()), "between knots of 0.5 s, too: rest comes before what touches there"
    torch.testing.assert_close(solution.cost, verdict.cost)


def test_gains_are_finite_where_the_plain_backward_pass_fails() -> None:
    base = pendulum()
    free = Problem(base.dynamics, QuadraticCost(Q=[1.0, 1.0], R=[0.0], Qf=[0.0, 0.0]), [], base.x0, base.N)
    solution = ILQR(max_iterations=30).solve(free, rest(free))
    assert bool(torch.isfinite(solution.K).all()) and bool(torch.isfinite(solution.d).all())


def test_the_kkt_residual_is_independent_of_the_scale_of_the_cost() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=3)
    X = Hold().solve(problem, U0).X
    residuals = [certify(scaled(problem, factor), X, U0).kkt_residual for factor in (1e-8, 1.0, 1e8)]
    torch.testing.assert_close(residuals[0], residuals[1])
    torch.testing.assert_close(residuals[2], residuals[1])
    assert float(residuals[1].min()) > 0.5


@pytest.mark.parametrize(("scenario", "model"), [("forest", "quadrotor"), ("planar_trap", "planar")])
def test_solve_is_the_configuration_gco(scenario: str, model: str) -> None:
    setup = compose([f"scenario={scenario}", f"model={model}"])
    task = setup.task(setup.layouts(1))
    assert presets.gco(task.problem) == setup.solver


def test_solve_hands_the_problem_to_that_solver(monkeypatch) -> None:
    calls = []
    whole = Restarts.solve

    def note_call(self, problem, U0, *options):
        calls.append((self, U0, options))
        return whole(replace(self, passes=self.passes[:1]), problem, U0, *options)

    monkeypatch.setattr(Restarts, "solve", note_call)
    problem, U0 = planar_batch(B=2, N=25)
    solve(problem, seed=3)
    ((solver, guess, options),) = calls
    assert solver == compose(["scenario=planar_trap", "model=planar"]).solver
    assert torch.equal(guess, U0) and options == (3, None, None, None, None, None)


def test_offsets_are_for_two_controls() -> None:
    three = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u[..., :2]), -1), 4, 3, dt=0.1, position=slice(0, 2))
    problem = Problem(
        three, QuadraticCost(Q=[1.0] * 4, R=[1.0] * 3, Qf=[1.0] * 4), [Spheres([[1.0, 1.0]], [0.1])],
        torch.zeros(1, 4, dtype=torch.float64), 10,
    )  # fmt: skip
    solver = presets.gco(problem)
    suited, lost = suited_paths(solver.passes, problem)
    given, kept = (
        [step.follow for row in rows if row for step in row.steps if isinstance(step, PathProposals)]
        for rows in (solver.passes, suited)
    )
    assert all(way.initial_offsets != () for ways in given for way in ways) and len(given) == len(kept) > 0
    assert all(way.initial_offsets == () for ways in kept for way in ways) and lost is None
    assert solve(problem).statuses == [Status.CONVERGED]


@pytest.mark.slow
def test_bounded_swing_ups_and_parkings_to_an_equality_are_solved_without_options() -> None:
    for limit in (3.0, 5.0, 8.0):
        base = pendulum()
        problem = Problem(base.dynamics, base.cost, [ControlBounds([-limit], [limit])], base.x0, 100)
        assert solve(problem).statuses == [Status.CONVERGED] * 2

    def car(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.stack((x[..., 3] * x[..., 2].cos(), x[..., 3] * x[..., 2].sin(), u[..., 1], u[..., 0]), dim=-1)

    start = torch.zeros(40, 4, dtype=torch.float64)
    start[:, :3] = torch.tensor([4.0, 4.0, 6.28]) * (
        torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    )
    parking = Problem(
        FunctionDynamics(car, 4, 2, dt=0.1, integrator="rk4", position=slice(0, 2)),
        QuadraticCost(Q=[0.1, 0.1, 0.01, 0.01], R=[0.1, 0.1], Qf=[10, 10, 5, 5]),
        [
            ControlBounds([-2.0, -2.0], [2.0, 2.0]),
            FunctionConstraint(lambda x: x, sense="equality", knots=[-1], name="goal"),
        ],
        start, 50,
    )  # fmt: skip
    parked = solve(parking)
    assert parked.statuses == [Status.CONVERGED] * 40
    assert float(certify(parking, parked.X, parked.U).kkt_residual.max()) < 0.01


def test_a_status_counts_what_lies_at_its_limit() -> None:
    ended = torch.full((4,), Status.MAX_ITERATIONS)
    left = torch.tensor([STATIONARY, 1.01 * STATIONARY, STATIONARY, torch.inf], dtype=torch.float64)
    violation = torch.tensor([1e-3, 1e-3, 1.01e-3, 0.0], dtype=torch.float64)
    status = final_status(ended, left, violation, 1e-3, constrained=True)
    want = [Status.CONVERGED, Status.FEASIBLE, Status.MAX_ITERATIONS, Status.NOT_POSITIVE_DEFINITE]
    assert [Status(int(s)) for s in status] == want
    late = final_status(torch.full_like(ended, Status.TIME_LIMIT), left, violation, 1e-3, constrained=True)
    want[2:] = [Status.TIME_LIMIT] * 2  # with more time there might be gains
    assert [Status(int(s)) for s in late] == want


@pytest.mark.parametrize("solver", ["interior_point", "al_ilqr"])
def test_a_solver_with_a_smaller_tolerance_calls_feasible_what_the_judge_does(solver: str) -> None:
    """Two rows, between which a gap is left that no state closes: 0.5 mm is feasible, 2 mm isn't."""
    gap = torch.tensor([[5e-4], [2e-3]], dtype=torch.float64)
    rows = [
        FunctionConstraint(lambda x, gap, side=side: side * (x[..., :1] - 0.5) + gap, knots=[8], values={"gap": gap})
        for side in (1.0, -1.0)
    ]
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, dt=0.2, integrator="rk4")
    cost = QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[1, 1], x_ref=[0.5, 0.0])
    problem = Problem(model, cost, [ControlBounds(-3.0, 3.0), *rows], torch.zeros(2, 2, dtype=torch.float64), 8)
    found = solve(problem, solver=solver)
    feasible = [status in (Status.CONVERGED, Status.FEASIBLE) for status in found.statuses]
    assert feasible == judge(problem, found.U).feasible.tolist() == [True, False]


def test_what_is_not_finite_does_not_start() -> None:
    problem, _ = planar_batch(B=6, N=2, obstacles=1)
    X, merit = torch.zeros(6, 3, problem.n, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    for row, value in ((1, torch.nan), (2, torch.inf), (3, -torch.inf)):
        X[row, 1, 0] = value
    merit[4] = torch.nan
    clear = torch.tensor([True, False, True, True, True, False])
    want = [Status.RUNNING, *[Status.NON_FINITE] * 4, Status.INVALID_START]
    assert start_status(X, merit, clear).tolist() == want
