"""Polish: its effect on violation, cost and stationarity, and its parts."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.problems import planar_batch, quadrotor_batch
from tests.reference.active_set import quadratic_program
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    Polish,
    Problem,
    QuadraticCost,
    Solution,
    certify,
)
from torchgco.baselines import Hold
from torchgco.dynamics.rollout import open_loop
from torchgco.judging.judge import judge
from torchgco.solvers.polish import polish
from torchgco.solvers.polish.active_set import multipliers, projected
from torchgco.solvers.polish.condensed import Condensed

SOLVER = AugmentedLagrangian(
    inner=ILQR(tolerance=3e-5, max_iterations=10),
    guidance=GCO(sampler=MPPI(samples=40, rounds=3, noise_knots=5), start_from_sample=True),
    initial_penalty=1.0,
    max_outer_iterations=12,
)
BATCHES = {
    "planar": lambda: planar_batch(B=4, N=30, obstacles=5, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=3, N=30, obstacles=6, seed=0),
}
OTHERS = ("multipliers", "trace", "search", "horizon", "reason", "account")
FIELDS = tuple(f.name for f in fields(Solution) if f.name not in OTHERS)


@cache
def solved(batch: str) -> tuple[Problem, Solution]:
    problem, U0 = BATCHES[batch]()
    return problem, SOLVER.solve(problem, U0, seed=1)


@cache
def solved_nearly(batch: str) -> tuple[Problem, Solution, torch.Tensor]:
    """The problems whose violation is within reach, their solutions and their rows in the batch: at least three."""
    problem, solution = solved(batch)
    rows = (solution.violation <= 1e-2).nonzero().flatten()
    assert rows.numel() >= 3
    return problem.take(rows), solution.take(rows), rows


@cache
def polished(batch: str) -> Solution:
    return Polish().refine(*solved(batch))


def assert_same_bits(a: Solution, b: Solution) -> None:
    for name in FIELDS:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is other) if one is None else torch.equal(one, other), name
    for lam_a, lam_b in zip(a.multipliers.lam, b.multipliers.lam, strict=True):
        assert torch.equal(lam_a, lam_b)


@pytest.mark.parametrize("batch", BATCHES)
def test_violation_and_residual_fall_and_the_cost_stays(batch: str) -> None:
    problem, before, rows = solved_nearly(batch)
    after = polished(batch).take(rows)
    assert bool((before.violation > 1e-6).any())  # else there is nothing to reduce
    goal = problem.cost.goal(problem.x0)[:, problem.dynamics.position]
    assert bool((judge(problem, after.U, goal, 1.0).violation < 1e-8).all())
    assert bool((after.cost <= 1.001 * before.cost).all())
    old, new = (certify(problem, s.X, s.U) for s in (before, after))
    assert bool((new.kkt_residual < old.kkt_residual).all()) and bool((new.kkt_residual < 1e-7).all())
    assert torch.equal(after.X, open_loop(problem.dynamics, problem.x0, after.U))
    torch.testing.assert_close(after.cost, problem.cost.total(after.X, after.U))


@pytest.mark.parametrize("batch", BATCHES)
def test_the_multipliers_and_gains_are_those_of_the_new_trajectory(batch: str) -> None:
    problem, _, rows = solved_nearly(batch)
    after = polished(batch).take(rows)
    U = after.U.clone().requires_grad_()
    X = open_loop(problem.dynamics, problem.x0, U)
    lagrangian = problem.cost.total(X, U).sum()
    for constraint, lam in zip(problem.constraints, after.multipliers.lam, strict=True):
        c = constraint.value(X, U)
        assert float(lam.min()) >= 0 and float((lam * c).detach().abs().max()) < 1e-5
        lagrangian = lagrangian + (lam * c).sum()
    (gradient,) = torch.autograd.grad(lagrangian, U)
    assert float(gradient.abs().max()) < 1e-5
    assert float(after.d.abs().max()) < 1e-4  # no feed-forward is left at an optimum


@pytest.mark.parametrize("batch", BATCHES)
def test_alone_in_any_batch_and_in_any_order(batch: str) -> None:
    problem, before = solved(batch)
    for rows in ([1], [2, 0], list(range(problem.B))[::-1]):
        index = torch.tensor(rows)
        part = Polish().refine(problem.take(index), before.take(index))
        assert_same_bits(part, polished(batch).take(index))


def test_a_solution_out_of_reach_is_left_alone() -> None:
    problem, before = solved("planar")
    assert float(before.violation[2]) > 1e-2
    broken = replace(before, U=before.U.clone(), X=before.X.clone(), cost=before.cost.clone())
    broken.U[1], broken.X[1], broken.cost[1] = torch.nan, torch.nan, torch.nan
    after = Polish().refine(problem, broken)
    assert_same_bits(after.take(torch.tensor([2])), before.take(torch.tensor([2])))
    assert bool(torch.isnan(after.U[1]).all())
    rest = torch.tensor([0, 3])
    assert_same_bits(after.take(rest), polished("planar").take(rest))
    assert torch.equal(broken.U[0], before.U[0])  # the given solution is not written into


def test_a_shortcut_through_an_obstacle_between_two_knots_is_refused(monkeypatch) -> None:
    """The optimum with constraints at knots alone crosses the edge of a disc between two knots."""
    problem, U0 = planar_batch(B=4, N=30, obstacles=5, seed=10)
    before = SOLVER.solve(problem, U0, seed=1)
    after = Polish().refine(problem, before)
    assert torch.equal(after.X[3], before.X[3]) and bool((after.violation[:3] < 1e-8).all())
    monkeypatch.setattr(polish, "chord_clearance", lambda problem, X: torch.full_like(X[:, 0, 0], torch.inf))
    assert float(Polish().refine(problem, before).violation[3]) < 1e-8


def test_every_option_is_read() -> None:
    problem, before = solved("planar")
    short = Polish(iterations=1).refine(problem, before)
    assert not torch.equal(short.U, polished("planar").U)
    assert_same_bits(Polish(reach=1e-12).refine(problem, before), before)
    first = torch.tensor([0])
    one, start = problem.take(first), before.take(first)
    assert_same_bits(Polish(tolerance=1e-3, stationarity=1e6).refine(one, start), start)  # already met
    assert not torch.equal(Polish(stationarity=1e6).refine(one, start).U, start.U)
    assert not torch.equal(Polish(tolerance=1e-3).refine(one, start).U, start.U)
    flat = Polish(iterations=2, curvature=False).refine(problem, before)
    assert not torch.equal(flat.U, Polish(iterations=2).refine(problem, before).U)
    risen = before.cost < polished("planar").cost  # removing the violation made some trajectory more expensive
    assert bool(risen.any())
    strict = Polish(cost_rise=0.0).refine(problem, before)
    assert bool((strict.cost <= before.cost).all())
    assert {f.name for f in fields(Polish)} == {
        "iterations", "tolerance", "stationarity", "reach", "cost_rise", "curvature",
    }  # fmt: skip


def test_bad_options_and_calls_are_named() -> None:
    for name, value in dict(iterations=0, tolerance=0.0, stationarity=-1.0, reach=0.0, cost_rise=-0.1).items():
        with pytest.raises(InputError, match=f"polish.{name}"):
            Polish(**{name: value})
    problem, before = solved("planar")
    with pytest.raises(InputError, match="float64"):
        Polish().refine(problem.cast(torch.float32), before)
    with pytest.raises(InputError, match=r"solution\.U"):
        Polish().refine(problem.take(torch.tensor([0])), before)


def test_equalities_and_functions_are_polished() -> None:
    """A curved equality at the last knot and a wall given as a function are met to rounding."""
    problem, U0 = planar_batch(B=2, N=25, obstacles=1, seed=1)
    ring = FunctionConstraint(lambda x: (x[..., :2] ** 2).sum(-1, keepdim=True) - 0.7, sense="equality", knots=[-1])
    wall = FunctionConstraint(lambda x: x[..., 1:2] - 0.25 - 0.1 * x[..., :1].square(), knots=slice(1, None))
    problem = Problem(problem.dynamics, problem.cost, [*problem.constraints, ring, wall], problem.x0, problem.N)
    solver = AugmentedLagrangian(inner=ILQR(), max_outer_iterations=12)
    before = solver.solve(problem, U0)
    after = Polish().refine(problem, before)
    assert float(before.violation.max()) > 1e-7 and float(after.violation.max()) < 1e-8
    assert float(certify(problem, after.X, after.U).kkt_residual.max()) < 1e-7


def test_a_linear_program_ends_at_its_corner() -> None:
    """Without curvature there is no strictly convex model, and the given solution is returned."""
    dynamics = FunctionDynamics(lambda x, u: u, 1, 1, 1.0)
    x0 = torch.zeros(1, 1, dtype=torch.float64)
    cost = QuadraticCost([0.0], [0.0], [0.0], qf=[1.0])
    problem = Problem(dynamics, cost, [ControlBounds([-1.0], [1.0])], x0, 2)
    held = Hold().solve(problem, torch.full((1, 2, 1), 0.5, dtype=torch.float64))
    assert_same_bits(Polish().refine(problem, held), held)


# The pieces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_programs_agree_with_trying_every_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    v, q = 6, 7
    root = rng.normal(size=(v, v))
    H, g = root @ root.T + np.eye(v), 3 * rng.normal(size=v)
    A, c = rng.normal(size=(q, v)), rng.normal(size=q)
    equality = np.arange(q) < seed % 3
    c -= np.where(equality, 0.0, A @ rng.normal(size=v) * 0.1 + 1.0)
    d, lam = quadratic_program(H, g, A, c, equality)
    S, b = A @ np.linalg.solve(H, A.T), c - A @ np.linalg.solve(H, g)
    for start in (np.zeros(q, dtype=bool), rng.random(q) < 0.5):
        found = multipliers(*(torch.from_numpy(z) for z in (S, b, equality, start)))
        np.testing.assert_allclose(found.numpy(), lam, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(-np.linalg.solve(H, g + A.T @ found.numpy()), d, rtol=1e-8, atol=1e-9)
    V = np.linalg.solve(np.linalg.cholesky(H), A.T)
    found = projected(*(torch.from_numpy(z) for z in (V, b, equality)))
    np.testing.assert_allclose(found.numpy(), lam, rtol=1e-8, atol=1e-9)


def test_rows_that_depend_on_each_other_have_a_program() -> None:
    """Twice the bound x <= -1 on min |x|^2 / 2, and a row in between: the multipliers add up to 1."""
    V = torch.tensor([[1.0, 1.0, 2.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    b = torch.tensor([1.0, 1.0, 2.0], dtype=torch.float64)
    lam = projected(V, b, torch.zeros(3, dtype=torch.bool))
    assert lam is not None and float(lam.min()) >= 0
    torch.testing.assert_close(V @ lam, torch.tensor([1.0, 0.0], dtype=torch.float64))


def test_no_projection_onto_rows_that_contradict_each_other() -> None:
    V = torch.tensor([[1.0, -1.0]], dtype=torch.float64)
    assert projected(V, torch.tensor([1.0, 1.0], dtype=torch.float64), torch.zeros(2, dtype=torch.bool)) is None


def test_rows_that_contradict_each_other_end() -> None:
    S = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    none = torch.zeros(2, dtype=torch.bool)
    found = multipliers(S, torch.tensor([1.0, 1.0], dtype=torch.float64), none, none)  # x >= 1 and x <= -1
    assert found is None or float(found.max()) > 1e9


@pytest.mark.parametrize("batch", BATCHES)
def test_condensed_derivatives_are_those_of_the_rollout(batch: str) -> None:
    """Gradient, rows and exact Hessian by autograd through the whole rollout."""
    problem, solution = solved(batch)
    one = torch.tensor([1])
    problem, U = problem.take(one), solution.U[one].clone().requires_grad_()
    shapes = [lam[one].shape for lam in solution.multipliers.lam]
    random = torch.Generator().manual_seed(0)
    lam = torch.rand(sum(s.numel() for s in shapes), generator=random, dtype=torch.float64)
    X = open_loop(problem.dynamics, problem.x0, U)
    model = Condensed.around(problem, X.detach(), U.detach())
    c = torch.cat([part.value(X, U).flatten() for part in problem.constraints])
    lagrangian = problem.cost.total(X, U).sum() + lam @ c
    (gradient,) = torch.autograd.grad(lagrangian, U, create_graph=True)
    torch.testing.assert_close(model.lagrangian_gradient(lam), gradient.detach().flatten(), rtol=1e-9, atol=1e-9)
    (plain,) = torch.autograd.grad(problem.cost.total(X, U).sum(), U, retain_graph=True)
    torch.testing.assert_close(model.gradient, plain.flatten(), rtol=1e-9, atol=1e-9)
    H, rows = model.hessian(lam), torch.tensor([0, 40, c.numel() - 3])
    for j in (0, 7, U.numel() - 1):
        (row,) = torch.autograd.grad(gradient.flatten()[j], U, retain_graph=True)
        torch.testing.assert_close(H[j], row.flatten(), rtol=1e-8, atol=1e-8)
    A = model.dense(rows)
    for i, j in enumerate(rows.tolist()):
        (row,) = torch.autograd.grad(c[j], U, retain_graph=True)
        torch.testing.assert_close(A[i], row.flatten(), rtol=1e-9, atol=1e-10)
    step = torch.randn(U.numel(), generator=random, dtype=torch.float64)
    torch.testing.assert_close(model.change(step)[rows], A @ step, rtol=1e-9, atol=1e-9)
    assert float(torch.linalg.eigvalsh(model.hessian(None)).min()) > 0


@pytest.mark.parametrize("batch", BATCHES)
def test_chord_clearance_is_the_judges(batch: str) -> None:
    problem, solution = solved(batch)
    spheres = problem.constraints[0]
    torch.testing.assert_close(spheres.chord_clearance(solution.X), spheres.clearances(solution.X)[1])


def test_a_residual_is_relative_to_the_gradient_of_the_cost() -> None:
    model = SimpleNamespace(
        lagrangian_gradient=lambda lam: torch.tensor([-6.0, 2.0]) * lam, gradient=torch.tensor([-2.0, 1.0])
    )
    assert polish._slope(model, torch.ones(2)) == 6.0 / (1.0 + 2.0)


@pytest.mark.slow
def test_where_the_exact_model_gives_no_step_the_other_one_does(monkeypatch) -> None:
    problem, before = solved("planar")
    plain, want = polish._convex, Polish(curvature=False).refine(problem, before)
    assert not torch.equal(want.U, before.U)
    monkeypatch.setattr(polish, "_convex", lambda point, exact: None if exact else plain(point, exact))
    assert_same_bits(Polish(curvature=True).refine(problem, before), want)
