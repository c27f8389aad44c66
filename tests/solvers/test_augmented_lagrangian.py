"""The augmented Lagrangian: exact optima, the best iterate, warm starts, stopping, and replaced iterates."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy import optimize

from tests.problems import at_knots, planar_batch, quadrotor_batch
from tests.solvers.problems import linear_problem, zeros
from torchgco import ILQR, AugmentedLagrangian, FunctionConstraint, InputError, Status, solve
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.solvers import augmented_lagrangian
from torchgco.solvers.contracts import Advice


@pytest.mark.slow
def test_optimum_agrees_with_slsqp() -> None:
    """Cost and path of a planar problem with one disc, solved by SciPy over the controls."""
    problem, U0 = planar_batch(B=1, N=15, obstacles=1, seed=6)
    inner = ILQR(tolerance=1e-10, max_iterations=100)
    solver = AugmentedLagrangian(inner=inner, max_outer_iterations=25, violation_tolerance=1e-7)
    solution = solver.solve(problem, U0)
    assert at_knots(problem, solution) == [Status.CONVERGED] and float(solution.multipliers.lam[0].max()) > 0

    def simulate(u):
        U = torch.tensor(u.reshape(1, 15, 2))
        return open_loop(problem.dynamics, problem.x0, U), U

    def cost(u):
        return float(problem.cost.total(*simulate(u)))

    def free(u):
        return -problem.constraints[0].value(*simulate(u)).flatten().numpy()

    result = optimize.minimize(
        cost, solution.U.flatten().numpy() * 0.9, method="SLSQP", bounds=[(-10, 10)] * 30,
        constraints={"type": "ineq", "fun": free}, options={"maxiter": 300, "ftol": 1e-10},
    )  # fmt: skip
    assert result.success
    assert float(solution.cost) == pytest.approx(result.fun, rel=1e-5)


@pytest.mark.parametrize("as_printed", [False, True])
def test_equality_at_the_end_is_met(as_printed: bool) -> None:
    target = FunctionConstraint(lambda x: x - 0.3, sense="equality", knots=[-1])
    problem = linear_problem(constraints=[target])
    solver = AugmentedLagrangian(inner=ILQR(as_printed, tolerance=1e-10), max_outer_iterations=15)
    solution = solver.solve(problem, zeros(problem))
    torch.testing.assert_close(solution.X[:, -1], torch.full((2, 2), 0.3, dtype=torch.float64), rtol=0, atol=1e-3)
    assert solution.statuses == [Status.CONVERGED] * 2


def test_the_best_feasible_iterate_is_returned_not_the_initial_guess() -> None:
    """The best result of an outer iteration is returned, even where the initial guess is feasible."""
    problem, U0 = planar_batch(B=4, N=30, obstacles=5, seed=3)
    inner = ILQR(as_printed=True, tolerance=1e-4)
    solver = AugmentedLagrangian(inner, max_outer_iterations=8, record=True, violation_tolerance=1e-2)
    solution = solver.solve(problem, U0)
    trace = solution.trace
    for b in range(4):
        ends = trace[trace.element == b].groupby("outer").last()
        feasible = ends.cost[ends.violation <= 1e-2]
        if len(feasible):
            assert float(solution.cost[b]) == pytest.approx(feasible.min(), rel=1e-12)
        else:
            assert float(solution.violation[b]) == pytest.approx(ends.violation.min(), rel=1e-9)
    assert not torch.equal(solution.U, U0)


def test_a_warm_start_reaches_the_same_cost_in_fewer_iterations() -> None:
    problem, U0 = quadrotor_batch(B=2, N=20, obstacles=4, seed=2)
    solver = AugmentedLagrangian(inner=ILQR(tolerance=1e-6), max_outer_iterations=15, violation_tolerance=1e-4)
    cold = solver.solve(problem, U0)
    assert float(cold.multipliers.lam[0].max()) > 0 and cold.statuses == [Status.CONVERGED] * 2
    warm = solve(problem, solver=solver, warm=cold)
    assert int(warm.iterations.sum()) < 0.5 * int(cold.iterations.sum())
    torch.testing.assert_close(warm.cost, cold.cost, rtol=1e-4, atol=0)
    with pytest.raises(InputError, match="warm"):
        other, U1 = planar_batch(B=2, N=20)
        solver.solve(other, U1, warm=cold.multipliers)


def test_it_ends_early_with_a_lower_penalty_unless_as_printed() -> None:
    problem, U0 = quadrotor_batch(B=2, N=15, obstacles=3, seed=2)
    early = AugmentedLagrangian(max_outer_iterations=12, violation_tolerance=0.05).solve(problem, U0)
    assert bool((early.outer_iterations < 12).all()) and early.statuses == [Status.CONVERGED] * 2
    assert bool((early.multipliers.mu < 20.0 * 2.2**early.outer_iterations * problem.cost_unit).all())
    printed = AugmentedLagrangian(ILQR(as_printed=True), max_outer_iterations=12).solve(problem, U0)
    assert printed.outer_iterations.tolist() == [12, 12]
    rises = (printed.multipliers.mu / 20.0).log() / torch.tensor(2.2).log()  # of the best iterate's mu
    torch.testing.assert_close(rises, rises.round().clamp(min=1.0), rtol=1e-6, atol=0)


class OnePlan:
    """Guidance that replaces the iterate by given controls, once."""

    def __init__(self, plan: torch.Tensor) -> None:
        self.plan = plan

    def suited(self, problem):
        return self

    def start(self, problem, X):
        return GuideRegion.inactive(X, torch.ones_like(X[:, 0, 0]), slice(0, 2))

    def update(self, problem, X, U, penalty, key):
        return Advice(penalty, self.plan.expand_as(U), key.outer == 1)


@pytest.mark.parametrize("hold", [1.0, 100.0])
def test_the_penalty_keeps_the_solver_from_an_abandoned_trajectory(hold: float, monkeypatch) -> None:
    """Its penalty is `HOLD` times the extra cost of the new one, whose multipliers start at zero."""
    monkeypatch.setattr(augmented_lagrangian, "HOLD", hold)
    problem, U0 = planar_batch(B=2, N=25, obstacles=8, seed=4)
    plan = torch.full_like(U0[:1], 1.0)
    seen = []

    def look(progress) -> None:
        state = progress.state
        if not seen and bool((state.outer == 1).all()):
            seen.append(
                (state.U.clone(), state.multipliers.mu.clone(), [lam.abs().max() for lam in state.multipliers.lam])
            )

    inner = ILQR(as_printed=True, tolerance=0.0, max_iterations=1)
    AugmentedLagrangian(inner, OnePlan(plan), max_outer_iterations=3).solve(problem, U0, callback=look)
    U, mu, lam = seen[0]
    assert torch.equal(U, plan.expand_as(U)) and all(float(m) == 0 for m in lam)
    left = inner.solve(problem, U0, warm=Multipliers.zero(problem, 20.0))
    new_X = open_loop(problem.dynamics, problem.x0, U)
    squares = sum(c.value(left.X, left.U).clamp(min=0).square().sum((1, 2)) for c in problem.constraints)
    gain = (problem.cost.total(new_X, U) - left.cost).clamp(min=0) / (0.5 * squares)
    torch.testing.assert_close(mu, (hold * gain).clamp(min=44.0), rtol=1e-6, atol=0)


def test_a_later_penalty_without_an_initial_one_is_named() -> None:
    class Late(OnePlan):
        def start(self, problem, X):
            return None

        def update(self, problem, X, U, penalty, key):
            return Advice(OnePlan.start(self, problem, X))

    problem, U0 = planar_batch(B=1, N=10)
    with pytest.raises(InputError, match=r"guidance\.start: expected a penalty"):
        AugmentedLagrangian(guidance=Late(U0), max_outer_iterations=2).solve(problem, U0 + 1.0)


def test_guidance_can_stop_a_solve() -> None:
    class Stop(OnePlan):
        def update(self, problem, X, U, penalty, key):
            return Advice(penalty, stop=key.ids == 1)

    problem, U0 = planar_batch(B=3, N=20)
    solver = AugmentedLagrangian(ILQR(max_iterations=3), max_outer_iterations=4)
    stopped = replace(solver, guidance=Stop(U0[:1])).solve(problem, U0)
    plain = solver.solve(problem, U0)
    assert stopped.outer_iterations[1] == 1 and Status.RUNNING not in stopped.statuses
    assert torch.equal(stopped.U[[0, 2]], plain.U[[0, 2]])


def test_a_callback_counts_the_passes_from_one() -> None:
    problem, U0 = planar_batch(B=3, N=10)
    seen: list[tuple[int, int, int]] = []
    solver = AugmentedLagrangian(max_outer_iterations=3).in_slots(2)
    solver.solve(problem, U0, callback=lambda now: seen.append((now.passes, now.finished, now.total)))
    assert [passes for passes, _, _ in seen] == list(range(1, len(seen) + 1)) and len(seen) > 1
    assert seen[-1][1:] == (3, 3)
