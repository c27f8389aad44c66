"""iLQR and the augmented Lagrangian: exact answers, statuses, warm starts, and that every option is read."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
import torch
from scipy import optimize

from tests.problems import PRINTED, planar_batch, quadrotor_batch
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    Cost,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    LineSearch,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    Status,
    presets,
    solve,
)
from torchgco.baselines import Hold, IteratedMPPI
from torchgco.constraints import GuideRegion
from torchgco.rollout import open_loop
from torchgco.solvers.riccati import backward
from torchgco.solvers.state import Advice


def linear_problem(B: int = 2, N: int = 8, constraints=()) -> Problem:
    """A double integrator: x = [position, velocity]."""
    dynamics = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, 0.2)
    x0 = torch.tensor([[1.0, 0.0], [-2.0, 0.5]], dtype=torch.float64)[:B]
    return Problem(dynamics, QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[5, 1]), list(constraints), x0, N)


def zeros(problem: Problem) -> torch.Tensor:
    return torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)


def test_lqr_is_solved_in_one_step() -> None:
    """Linear dynamics and quadratic cost: the answer of one dense least-squares solve."""
    problem = linear_problem()
    solution = ILQR(tolerance=1e-12).solve(problem, zeros(problem))
    A, b = np.array([[1, 0.2], [0, 1]]), np.array([[0], [0.2]])
    Q, R, Qf = np.diag([1, 0.1]), 0.1 * np.eye(1), np.diag([5.0, 1])
    powers = [np.linalg.matrix_power(A, k) for k in range(9)]
    free = np.concatenate(powers)  # X = free x0 + forced U
    forced = np.zeros((18, 8))
    for k in range(1, 9):
        for j in range(k):
            forced[2 * k : 2 * k + 2, j : j + 1] = powers[k - 1 - j] @ b
    W = np.kron(np.eye(9), Q)
    W[-2:, -2:] = Qf
    for i in range(2):
        U = -np.linalg.solve(forced.T @ W @ forced + np.kron(np.eye(8), R), forced.T @ W @ free @ problem.x0[i].numpy())
        np.testing.assert_allclose(solution.U[i, :, 0], U, rtol=1e-10, atol=1e-12)
    assert solution.statuses == [Status.CONVERGED] * 2
    assert solution.iterations.tolist() == [2, 2]  # one step, and one that finds nothing to gain
    # The gains returned are those of the optimum: no feed-forward is left.
    torch.testing.assert_close(solution.d, torch.zeros_like(solution.d), rtol=0, atol=1e-10)


def test_backward_pass_satisfies_the_general_recursion() -> None:
    """With mu_r > 0, V of the homogeneous form is Vxx = Qxx + K'Qux + Qxu K + K'Quu K, and so on (Equations 43, 44)."""
    torch.manual_seed(0)
    n, m, N, B = 3, 2, 1, 2
    F = torch.zeros(N, B, n + 1, n + 1 + m, dtype=torch.float64)
    F[..., :n, :] = torch.randn(N, B, n, n + 1 + m, dtype=torch.float64)
    F[..., n, n] = 1.0
    A = torch.randn(N + 1, B, n + 1 + m, n + 1 + m, dtype=torch.float64)
    H = A @ A.mT
    mu = torch.tensor([0.0, 0.7], dtype=torch.float64)
    step = backward(F, H, mu)
    Q = H[0] + F[0].mT @ H[1, :, : n + 1, : n + 1] @ F[0]
    u, z = slice(n + 1, None), slice(0, n + 1)
    regular = Q[:, u, u] + mu.view(-1, 1, 1) * torch.eye(m)
    G = -torch.linalg.solve(regular, Q[:, u, z])
    torch.testing.assert_close(step.gains[0], G)
    d = G[..., n : n + 1]
    torch.testing.assert_close(step.linear, (Q[:, u, n : n + 1] * d).sum((1, 2)))
    torch.testing.assert_close(step.quadratic, (d * (Q[:, u, u] @ d)).sum((1, 2)))


def test_optimum_agrees_with_slsqp() -> None:
    """Cost and path of a planar problem with one disc, solved by SciPy over the controls."""
    problem, U0 = planar_batch(B=1, N=15, obstacles=1, seed=6)
    inner = ILQR(tolerance=1e-10, max_iterations=100)
    solver = AugmentedLagrangian(inner=inner, max_outer_iterations=25, clip=True, violation_tolerance=1e-7)
    solution = solver.solve(problem, U0)
    assert solution.statuses == [Status.CONVERGED] and float(solution.multipliers.lam[0].max()) > 0

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


@pytest.mark.parametrize("clip", [False, True])
def test_equality_at_the_end_is_met(clip: bool) -> None:
    target = FunctionConstraint(lambda x: x - 0.3, sense="equality", knots=[-1])
    problem = linear_problem(constraints=[target])
    solver = AugmentedLagrangian(inner=ILQR(tolerance=1e-10), max_outer_iterations=15, clip=clip)
    solution = solver.solve(problem, zeros(problem))
    torch.testing.assert_close(solution.X[:, -1], torch.full((2, 2), 0.3, dtype=torch.float64), rtol=0, atol=1e-3)
    assert solution.statuses == [Status.CONVERGED] * 2


@dataclass(frozen=True)
class Saddle(Cost):
    """Concave in u to the degree given: the backward pass needs regularisation, or fails."""

    concavity: float

    def stage(self, x, u, k):
        return x.square().sum(-1) - 0.5 * self.concavity * (1 - torch.exp(-u.square().sum(-1)))

    def terminal(self, x):
        return x.square().sum(-1)


def saddle(concavity: float) -> Problem:
    flat = linear_problem()
    return Problem(flat.dynamics, Saddle(concavity), [], flat.x0, flat.N)


def test_regularisation_rises_until_the_pass_succeeds() -> None:
    problem = saddle(1.0)
    solver = AugmentedLagrangian(inner=ILQR(max_iterations=3), max_outer_iterations=1, record=True)
    solution = solver.solve(problem, zeros(problem))
    assert solution.trace is not None and float(solution.trace.regularisation.max()) > 0.1
    assert bool(torch.isfinite(solution.cost).all())


def test_statuses() -> None:
    hopeless = ILQR(regularisation_max=1e-4).solve(saddle(1.0), zeros(saddle(1.0)))
    assert hopeless.statuses == [Status.NOT_POSITIVE_DEFINITE] * 2
    problem, U0 = planar_batch(B=2, N=20)
    free, U0 = replace(problem, constraints=[]), U0
    assert ILQR(max_iterations=1).solve(free, U0).statuses == [Status.MAX_ITERATIONS] * 2
    stubborn = ILQR(line_search=LineSearch(ratio_min=5.0, accept_last=False)).solve(free, U0)
    assert stubborn.statuses == [Status.LINE_SEARCH_FAILED] * 2
    assert torch.equal(stubborn.U, U0)
    impossible = FunctionConstraint(lambda x: x[..., :1].square() + 1.0, sense="equality", knots=[-1])
    walled = linear_problem(constraints=[impossible])
    assert AugmentedLagrangian(max_outer_iterations=2).solve(walled, zeros(walled)).statuses == [Status.INFEASIBLE] * 2
    assert all(status.sentence for status in Status)


def test_the_initial_guess_is_no_answer_and_the_best_feasible_iterate_is() -> None:
    """Feasible from the start, the solution still moves; and what ends an outer iteration best is what comes back."""
    problem, U0 = planar_batch(B=4, N=30, obstacles=5, seed=3)
    ended: dict[int, list[tuple[float, float]]] = {b: [] for b in range(4)}
    solver = AugmentedLagrangian(max_outer_iterations=8, record=True, violation_tolerance=1e-2)
    solution = solver.solve(problem, U0)
    trace = solution.trace
    for b in range(4):
        ends = trace[trace.element == b].groupby("outer").last()
        ended[b] = list(zip(ends.cost, ends.violation, strict=True))
        feasible = [cost for cost, violation in ended[b] if violation <= 1e-2]
        if feasible:
            assert float(solution.cost[b]) == pytest.approx(min(feasible), rel=1e-12)
        else:
            assert float(solution.violation[b]) == pytest.approx(min(v for _, v in ended[b]), rel=1e-9)
    assert not torch.equal(solution.U, U0)


def test_warm_start_is_at_once_where_the_cold_one_ended() -> None:
    problem, U0 = quadrotor_batch(B=2, N=20, obstacles=4, seed=2)
    solver = AugmentedLagrangian(
        inner=ILQR(tolerance=1e-3), max_outer_iterations=15, cost_tolerance=1e-5, clip=True, violation_tolerance=1e-4
    )
    cold = solver.solve(problem, U0)
    assert float(cold.multipliers.lam[0].max()) > 0 and cold.statuses == [Status.CONVERGED] * 2
    warm = solve(problem, solver=solver, warm=cold)
    assert int(warm.iterations.sum()) < 0.5 * int(cold.iterations.sum())
    torch.testing.assert_close(warm.cost, cold.cost, rtol=1e-4, atol=0)
    with pytest.raises(InputError, match="warm"):
        other, U1 = planar_batch(B=2, N=20)
        solver.solve(other, U1, warm=cold.multipliers)


def test_save_and_load(tmp_path) -> None:
    problem, U0 = planar_batch(B=2, N=10)
    solution = AugmentedLagrangian(max_outer_iterations=2).solve(problem, U0)
    solution.save(tmp_path / "deep" / "solution.npz")
    loaded = Solution.load(tmp_path / "deep" / "solution.npz")
    for f in fields(Solution):
        if f.name not in ("multipliers", "trace"):
            assert torch.equal(getattr(loaded, f.name), getattr(solution, f.name)), f.name
    assert torch.equal(loaded.multipliers.mu, solution.multipliers.mu)
    assert all(torch.equal(a, b) for a, b in zip(loaded.multipliers.lam, solution.multipliers.lam, strict=True))
    frame = loaded.to_frame()
    assert list(frame.status) == [s.name for s in solution.statuses] and frame.cost.tolist() == solution.cost.tolist()
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "absent.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "other.npz")


BASE = AugmentedLagrangian(
    inner=ILQR(max_iterations=10, absolute_tolerance=1e-2, **PRINTED),
    guidance=GCO(sampler=MPPI(samples=12, covariance=None, spread=0.05, rounds=2, knots=5)),
    max_outer_iterations=7,
    violation_tolerance=0.05,
    record=True,
)
# One other value for every option, and with it what else the option needs to show.
CHANGES = {
    AugmentedLagrangian: dict(
        inner=ILQR(max_iterations=2), guidance=None, initial_penalty=50.0, penalty_growth=5.0, penalty_max=60.0,
        max_outer_iterations=3, violation_tolerance=0.2, clip=True, record=False,
    ),
    ILQR: dict(
        tolerance=0.5, absolute_tolerance=1e3, normalise=True, max_iterations=3, line_search=LineSearch(shrink=0.3)
    ),
    LineSearch: dict(shrink=0.25, ratio_min=0.9, ratio_max=0.9),
    GCO: dict(
        sampler=MPPI(samples=5), initial_penalty=2.0, penalty_growth=1.0, radius=0.5, patience=1, afresh=True,
    ),
    MPPI: dict(
        samples=7, covariance=4.0, spread=0.2, temperature=100.0, collision_penalty=0.1, saturation=None, rounds=1,
        knots=3, decay=0.3, elite=4, linger=10.0, dtype="float32",
    ),
}  # fmt: skip
# What shows only in other tests, here, in test_polish or in tests/guidance.
ELSEWHERE = {
    (ILQR, "regularisation_first"), (ILQR, "regularisation_growth"), (ILQR, "regularisation_max"), (ILQR, "penalty"),
    (ILQR, "damping"), (LineSearch, "parallel"), (LineSearch, "smallest"), (LineSearch, "accept_last"),
    (LineSearch, "back"),
    (AugmentedLagrangian, "hold_factor"), (AugmentedLagrangian, "cost_tolerance"),
    (AugmentedLagrangian, "grow_when_feasible"), (GCO, "grow_when_idle"), (GCO, "adopt"),
    (GCO, "detour"), (GCO, "detour_at"), (GCO, "detours"), (AugmentedLagrangian, "arrival"),
    (AugmentedLagrangian, "thorough"), (AugmentedLagrangian, "attempts"), (AugmentedLagrangian, "slots"),
    (AugmentedLagrangian, "polish"),
}  # fmt: skip
PLACES = {
    AugmentedLagrangian: lambda s, c: replace(s, **c),
    ILQR: lambda s, c: replace(s, inner=replace(s.inner, **c)),
    LineSearch: lambda s, c: replace(s, inner=replace(s.inner, line_search=replace(s.inner.line_search, **c))),
    GCO: lambda s, c: replace(s, guidance=replace(s.guidance, **c)),
    MPPI: lambda s, c: replace(s, guidance=replace(s.guidance, sampler=replace(s.guidance.sampler, **c))),
}


def _run(solver) -> tuple:
    problem, U0 = planar_batch(B=5, N=25, obstacles=12, seed=5)
    solution = solver.solve(problem, U0 + 3.0, seed=1)
    trace = None if solution.trace is None else solution.trace.to_numpy(dtype=float).tobytes()
    return solution.U.numpy().tobytes(), solution.status.tolist(), trace


@pytest.fixture(scope="module")
def base_run() -> tuple:
    return _run(BASE)


@pytest.mark.parametrize(
    ("cls", "change"), [(cls, {name: value}) for cls, changes in CHANGES.items() for name, value in changes.items()]
)
def test_every_option_changes_something(cls, change: dict, base_run: tuple) -> None:
    assert _run(PLACES[cls](BASE, change)) != base_run


def test_no_option_is_forgotten_above() -> None:
    for cls, changes in CHANGES.items():
        covered = {*changes, *(name for c, name in ELSEWHERE if c is cls)}
        assert {f.name for f in fields(cls)} == covered, cls


def test_the_early_end_and_the_resting_penalty_are_read() -> None:
    problem, U0 = quadrotor_batch(B=2, N=15, obstacles=3, seed=2)
    full = AugmentedLagrangian(max_outer_iterations=6, clip=True, violation_tolerance=0.05)
    early = replace(full, cost_tolerance=0.9).solve(problem, U0)
    assert bool((early.outer_iterations < 6).all()) and early.statuses == [Status.CONVERGED] * 2
    grown, rested = full.solve(problem, U0), replace(full, grow_when_feasible=False).solve(problem, U0)
    assert bool((rested.multipliers.mu < grown.multipliers.mu).all())


def test_regularisation_and_penalty_are_read() -> None:
    problem = saddle(1.0)

    def peak(**options) -> float:
        solver = AugmentedLagrangian(inner=ILQR(max_iterations=2, **options), max_outer_iterations=1, record=True)
        return float(solver.solve(problem, zeros(problem)).trace.regularisation.max())

    assert peak(regularisation_first=0.3) != peak() != peak(regularisation_growth=3.0)
    disc = Problem(
        FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2)),
        QuadraticCost([1, 1], [0.1, 0.1], [10, 10], x_ref=[1.0, 0.1]),
        [Spheres([[0.5, 0.0]], [0.2])], torch.zeros(1, 2, dtype=torch.float64), 20,
    )  # fmt: skip
    free, held = ILQR().solve(disc, zeros(disc)), ILQR(penalty=1e4).solve(disc, zeros(disc))
    assert float(held.violation) < 0.5 * float(free.violation)


def steep() -> Problem:
    """A step that overshoots: full Gauss-Newton steps on a strongly curved constraint are refused."""
    curved = FunctionConstraint(lambda x: (8 * x[..., :1]).sin() - 0.5 * x[..., 1:].square(), sense="equality")
    return linear_problem(constraints=[curved])


def steep_run(**options) -> Solution:
    line_search = LineSearch(**{"ratio_min": 0.95, "accept_last": False, **options.pop("line_search", {})})
    inner = ILQR(max_iterations=25, tolerance=1e-6, line_search=line_search, **options)
    return AugmentedLagrangian(inner=inner, max_outer_iterations=3, record=True).solve(steep(), zeros(steep()))


def test_the_end_of_the_ladder_is_read() -> None:
    short = steep_run(line_search={"smallest": 0.4})
    assert set(short.trace.alpha) <= {1.0, 0.5, 0.0} and (short.trace.alpha == 0).any()
    assert ((steep_run().trace.alpha > 0) & (steep_run().trace.alpha < 0.5)).any()
    taken = steep_run(line_search={"smallest": 0.4, "accept_last": True})
    assert not torch.equal(taken.U, short.U) and float(taken.trace.alpha.min()) == 0.25


def test_damping_goes_on_where_the_search_fails() -> None:
    plain, damped = steep_run(line_search={"smallest": 0.4}), steep_run(line_search={"smallest": 0.4}, damping=1.0)
    assert float(damped.trace.regularisation.max()) >= 1.0 and float(plain.trace.regularisation.max()) == 0.0
    after = [run.trace[run.trace.outer == 0].groupby("element").merit.last() for run in (plain, damped)]
    assert bool((after[1] <= after[0]).all()) and bool((after[1] < after[0]).any())


def test_a_search_begins_a_little_above_where_the_last_one_ended() -> None:
    plain, kept = steep_run(), steep_run(line_search={"back": 1})
    grown = {}
    for name, run in (("plain", plain), ("kept", kept)):
        alpha = run.trace[run.trace.alpha > 0].groupby(["element", "outer"]).alpha
        grown[name] = (alpha.shift(-1) / run.trace.alpha).max()
    assert grown["plain"] > 2.0 and grown["kept"] <= 2.0
    assert bool((kept.violation <= 2.0 * plain.violation + 1e-6).all())


def test_rungs_side_by_side_are_the_same_rungs() -> None:
    one, many = (steep_run(line_search={"parallel": p}) for p in (1, 6))
    torch.testing.assert_close(one.U, many.U, rtol=1e-9, atol=1e-9)
    assert one.iterations.tolist() == many.iterations.tolist()


class OnePlan:
    """Guidance that hands over one given plan, once."""

    def __init__(self, plan: torch.Tensor) -> None:
        self.plan = plan

    def suited(self, problem):
        return self

    def start(self, problem, X):
        return GuideRegion.inactive(X, torch.ones_like(X[:, 0, 0]), slice(0, 2))

    def update(self, problem, X, U, guide, key):
        return Advice(guide, self.plan.expand_as(U), key.outer == 1)


class Choices(OnePlan):
    """Hands over one plan at the first question and another whenever the caught path comes back."""

    def __init__(self, plans: list[torch.Tensor]) -> None:
        self.plans, self.asked_at = plans, []

    def update(self, problem, X, U, guide, key):
        caught = U[..., 0].mean(-1) < 5.0 if not self.asked_at else (U - self.asked_at[0]).abs().amax((1, 2)) < 1e-12
        if bool(caught.any()):
            self.asked_at.append(U.clone())
        plan = self.plans[min(len(self.asked_at), len(self.plans)) - 1]
        return Advice(guide, plan.expand_as(U), caught)


def test_attempts_start_from_the_caught_path_and_the_best_is_kept() -> None:
    problem, U0 = planar_batch(B=1, N=25, obstacles=3, seed=3)
    good, bad = (torch.full_like(U0, level) for level in (3.0, -3.0))
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=2), max_outer_iterations=3, clip=True, violation_tolerance=10.0, penalty_growth=1.0
    )
    costs = {}
    for name, plans in {"bad": [bad], "good": [good], "bad, then good": [bad, good]}.items():
        guidance = Choices(plans)
        solution = replace(solver, guidance=guidance, attempts=len(plans)).solve(problem, U0)
        assert len(guidance.asked_at) == len(plans)
        assert int(solution.outer_iterations) == 3 + 3 * (len(plans) - 1)
        costs[name] = float(solution.cost)
    assert costs["bad, then good"] <= min(costs["bad"], costs["good"]) + 1e-9


def test_one_that_arrives_is_kept_and_ends_the_attempts() -> None:
    """A plan to the goal is worth more than a cheap one that stays, and nothing is tried after it."""
    problem, U0 = planar_batch(B=1, N=25, obstacles=3, seed=3)
    cost = QuadraticCost(Q=[1e-3] * 6, R=[5.0, 5.0], Qf=[1, 1, 0, 0, 0, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    dear = replace(problem, cost=cost)
    there, here = torch.full_like(U0, 4.0), torch.full_like(U0, 1e-3)
    nothing_moves = LineSearch(ratio_min=1e9, ratio_max=2e9, accept_last=False)
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=1, tolerance=1e-9, line_search=nothing_moves),
        max_outer_iterations=3, clip=True, violation_tolerance=10.0, penalty_growth=1.0,
    )  # fmt: skip
    came = {}
    for arrival in (None, 0.5):
        guidance = Choices([there, here])
        solution = replace(solver, guidance=guidance, attempts=2, arrival=arrival).solve(dear, U0)
        came[arrival] = len(guidance.asked_at), bool(solution.U.mean() > 3.0)
    assert came == {None: (2, False), 0.5: (1, True)}
    guidance = Choices([here, there])
    solution = replace(solver, guidance=guidance, attempts=2, arrival=0.5, thorough=True).solve(dear, U0)
    assert len(guidance.asked_at) == 2 and bool(solution.U.mean() > 3.0)
    guidance = Choices([there, there])
    replace(solver, guidance=guidance, attempts=2, arrival=0.5, thorough=True).solve(dear, U0)
    assert len(guidance.asked_at) == 2


@pytest.mark.parametrize(("weight", "drawn"), [(1.0, False), (6.0, True), (100.0, False)])
def test_a_caught_path_that_ends_close_to_the_goal_is_drawn_there_at_last(weight: float, drawn: bool) -> None:
    """Where the optimum stays short of the goal: far (left as it is), a little (drawn), hardly; the second is free."""
    dynamics = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "euler", slice(0, 2))
    cost = QuadraticCost(Q=[0.01, 0.01, 0.1, 0.1], R=[1.0, 1.0], Qf=[weight, weight, 0.0, 0.0], x_ref=[10.0, 0, 0, 0])
    discs = Spheres([[[5.0, 0.3], [5.0, -0.3]], [[5.0, 9.0], [5.0, 9.6]]], torch.full((2, 2), 0.5).double(), 0.1)
    problem = Problem(dynamics, cost, [discs, ControlBounds([-5.0] * 2, [5.0] * 2)], torch.zeros(2, 4).double(), 40)
    U0, solver = torch.zeros(2, 40, 2, dtype=torch.float64), presets.gco(problem)
    solution, plain = (s.solve(problem, U0) for s in (solver, replace(solver, arrival=None, attempts=1)))
    away, optimal = ((s.X[:, -1, :2] - torch.tensor([10.0, 0.0])).norm(dim=-1) for s in (solution, plain))
    assert solution.guided.tolist()[1] == 0 and int(solution.guided[0]) > 0
    assert bool(away[0] < 0.9 < optimal[0]) == drawn and torch.equal(solution.U[1], plain.U[1])
    assert torch.equal(solution.U[0], solver.solve(problem.take(torch.tensor([0])), U0[:1]).U[0])
    if drawn:
        assert away[0] > 0.8 and solution.cost[0] < 1.05 * plain.cost[0]
        assert solution.statuses == [Status.FEASIBLE, Status.CONVERGED]  # the optimum lies elsewhere


@pytest.mark.parametrize("hold_factor", [1.0, 100.0])
def test_an_adopted_plan_is_held(hold_factor: float) -> None:
    """The path that is left costs hold_factor times what the new one costs more, and the multipliers start again."""
    problem, U0 = planar_batch(B=2, N=25, obstacles=8, seed=4)
    plan = torch.full_like(U0[:1], 1.0)
    seen = []

    def look(progress) -> None:
        state = progress.state
        if not seen and bool((state.outer == 1).all()):
            seen.append((state.U.clone(), state.duals.mu.clone(), [lam.abs().max() for lam in state.duals.lam]))

    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=1, **PRINTED),
        guidance=OnePlan(plan),
        max_outer_iterations=3,
        hold_factor=hold_factor,
        clip=True,
    )  # fmt: skip
    solver.solve(problem, U0, callback=look)
    U, mu, lam = seen[0]
    assert torch.equal(U, plan.expand_as(U)) and all(float(m) == 0 for m in lam)
    left = ILQR(max_iterations=1, penalty=20.0, **PRINTED).solve(problem, U0)
    new_X = open_loop(problem.dynamics, problem.x0, U)
    squares = sum(c.value(left.X, left.U).clamp(min=0).square().sum((1, 2)) for c in problem.constraints)
    gain = (problem.cost.total(new_X, U) - left.cost).clamp(min=0) / (0.5 * squares)
    torch.testing.assert_close(mu, (hold_factor * gain).clamp(min=44.0), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ILQR(tolerance=-1.0), "ilqr.tolerance"),
        (lambda: ILQR(max_iterations=0), "ilqr.max_iterations"),
        (lambda: ILQR(penalty=-1.0), "ilqr.penalty"),
        (lambda: ILQR(damping=-1.0), "ilqr.damping"),
        (lambda: AugmentedLagrangian(hold_factor=0.5), "solver.hold_factor"),
        (lambda: AugmentedLagrangian(attempts=0), "solver.attempts"),
        (lambda: AugmentedLagrangian(arrival=1.0), "solver.arrival"),
        (lambda: GCO(detour_at=0), "gco.detour_at"),
        (lambda: GCO(detours=0), "gco.detours"),
        (lambda: ILQR(regularisation_first=0.0), "ilqr.regularisation_first"),
        (lambda: ILQR(regularisation_growth=1.0), "ilqr.regularisation_growth"),
        (lambda: LineSearch(shrink=1.0), "line_search.shrink"),
        (lambda: LineSearch(ratio_min=0.0), "line_search.ratio_min"),
        (lambda: LineSearch(smallest=2.0), "line_search.smallest"),
        (lambda: LineSearch(parallel=0), "line_search.parallel"),
        (lambda: LineSearch(back=-1), "line_search.back"),
        (lambda: AugmentedLagrangian(initial_penalty=0.0), "solver.initial_penalty"),
        (lambda: AugmentedLagrangian(penalty_growth=0.9), "solver.penalty_growth"),
        (lambda: AugmentedLagrangian(penalty_max=1.0), "solver.penalty_max"),
        (lambda: AugmentedLagrangian(max_outer_iterations=0), "solver.max_outer_iterations"),
        (lambda: AugmentedLagrangian(violation_tolerance=0.0), "solver.violation_tolerance"),
        (lambda: AugmentedLagrangian(cost_tolerance=0.0), "solver.cost_tolerance"),
        (lambda: IteratedMPPI(iterations=0), "solver.iterations"),
        (lambda: IteratedMPPI(violation_tolerance=0.0), "solver.violation_tolerance"),
    ],
)
def test_bad_options_are_named(make, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()


def test_bad_calls_are_named() -> None:
    problem, U0 = planar_batch(B=2, N=10)
    for solver in (AugmentedLagrangian(), ILQR(), Hold(), IteratedMPPI()):
        with pytest.raises(InputError, match="U0"):
            solver.solve(problem, U0[:, :5])
        with pytest.raises(InputError, match="U0"):
            solver.solve(problem, U0.float())
        with pytest.raises(InputError, match="ids"):
            solver.solve(problem, U0, ids=torch.arange(3))


def test_hold_and_iterated_mppi() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    held = Hold().solve(problem, U0)
    torch.testing.assert_close(held.X, problem.x0.unsqueeze(1).expand_as(held.X), rtol=0, atol=1e-12)
    flown = IteratedMPPI(sampler=MPPI(samples=50, covariance=25.0), iterations=5).solve(problem, U0)
    assert bool((flown.cost < held.cost).all()) and flown.iterations.tolist() == [5, 5]
