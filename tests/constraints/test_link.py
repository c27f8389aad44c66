"""Rows that join the states of two knots."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    MPC,
    AugmentedLagrangian,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Link,
    Problem,
    QuadraticCost,
    RateBounds,
    StateBounds,
    Status,
    certify,
    judge,
    kernels,
)
from torchgco.baselines import CasADiSolver
from torchgco.kernels import EagerWarning
from torchgco.problem.carried import with_carried

D = torch.float64
N = 30
GAPS = torch.tensor([[0.3], [0.6]], dtype=D)
MIRRORED = Link(lambda a, b: a + b, (8, 22), name="mirrored")
RISEN = Link(lambda a, b, gap: a + gap - b, (5, 20), "inequality", [0], {"gap": GAPS}, "risen")


def van_der_pol(x: Tensor, u: Tensor) -> Tensor:
    p, v = x.unbind(-1)
    return torch.stack((v, (1 - p * p) * v - p + u[..., 0]), dim=-1)


def drawn(x: Tensor, u: Tensor) -> Tensor:
    p, v = x.unbind(-1)
    return torch.stack((v, u[..., 0] - p), dim=-1)


def made(*parts: Any, free: bool = True, field: Any = van_der_pol, push: float = 3.0, **more: Any) -> Problem:
    """Two oscillators that follow a cosine."""
    names = {"state_names": ("position", "speed"), "state_units": ("m", "m/s")}
    model = FunctionDynamics(field, n=2, m=1, dt=0.2, integrator="rk4", **names)
    wave = torch.cos(torch.linspace(0, 2 * math.pi, N + 1, dtype=D))
    follow = torch.stack((torch.stack((wave, 1.3 * wave)), torch.zeros(2, N + 1, dtype=D)), dim=-1)
    cost = QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[0, 0], x_ref=follow)
    x0 = torch.tensor([[1.0, 0.0], [0.5, 0.5]], dtype=D)
    chosen = [True, True] if free else None
    return Problem(model, cost, [*parts, ControlBounds(-push, push)], x0, N, free_start=chosen, **more)


def dense(problem: Problem, rows: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, controls and multipliers of linear equalities rows(X) (p,) alone: one linear system for each problem."""
    found = []
    for b in range(problem.B):
        one = problem.take([b])

        def states(v: Tensor, one: Problem = one) -> Tensor:
            X = [v[None, :2]]
            for k in range(N):
                X.append(one.dynamics.step(X[-1], v[None, 2 + k : 3 + k]))
            return torch.stack(X, dim=1)

        zero = torch.zeros(2 + N, dtype=D)
        cost = lambda v, one=one: one.cost.total(states(v), v[2:].view(1, N, 1)).sum()
        bound = lambda v: rows(states(v)[0])
        functional = torch.autograd.functional
        H, J = functional.hessian(cost, zero), functional.jacobian(bound, zero)
        p, slope = len(J), functional.jacobian(cost, zero)
        K = torch.cat((torch.cat((H, J.T), 1), torch.cat((J, J.new_zeros(p, p)), 1)))
        found.append(torch.linalg.solve(K, torch.cat((-slope, -bound(zero)))))
    v = torch.stack(found)
    return v[:, :2], v[:, 2 : 2 + N], v[:, 2 + N :]


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    ("parts", "rows"),
    [
        ([Link()], lambda X: X[0] - X[-1]),
        ([MIRRORED, Link(components=[1])], lambda X: torch.cat((X[8] + X[22], X[0, 1:] - X[-1, 1:]))),
    ],
    ids=["periodic", "two links"],
)
def test_linear_problems_have_the_solution_of_a_dense_system(parts: list[Link], rows: Any) -> None:
    problem = made(*parts, field=drawn, push=1e3)
    x0, u, lam = dense(problem, rows)
    for solver in ("interior_point", "gco"):
        solution = torchgco.solve(problem, solver=solver)
        assert solution.statuses == [Status.CONVERGED] * 2
        torch.testing.assert_close(solution.X[:, 0], x0, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(solution.U[..., 0], u, rtol=1e-6, atol=1e-6)
        own = torch.cat([part.flatten(1) for part in solution.multipliers.lam[:-1]], dim=1)
        torch.testing.assert_close(own, lam, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_half_an_orbit_and_its_mirror_image_have_the_period_that_is_known() -> None:
    """Without a push, van der Pol's oscillator has one orbit, 6.663287 s long, and rests nowhere else."""
    model = FunctionDynamics(van_der_pol, n=2, m=1, dt=3.0 / 60, integrator="rk4")
    outside = StateBounds([1.0, -9.0], [9.0, 9.0], knots=[0])
    cost, start = FunctionCost(lambda x, u: 1e4 * u[..., 0] ** 2), [[1.7, 0.0]]
    turned, time = Link(lambda a, b: a + b), FreeTime(0.7, 1.5)
    problem = Problem(model, cost, [turned, outside], start, 60, free_start=[True, False], time=time)
    for native in (True, False):
        kernels.use_native(native)
        try:
            solution = torchgco.solve(problem)
        finally:
            kernels.use_native(True)
        assert solution.statuses == [Status.CONVERGED] and float(solution.U.abs().max()) < 1e-4
        assert abs(2 * float(solution.duration) - 6.6632868593) < 1e-4
        assert abs(float(solution.X[0, 0, 0]) - 2.00862) < 1e-4  # the orbit's amplitude
        exact = certify(problem, solution.X, solution.U, multipliers=solution.multipliers.lam, times=solution.t)
        assert float(exact.dynamics_residual) < 1e-12 and float(solution.violation) < 1e-8


@pytest.mark.slow
def test_a_lap_of_a_race_is_as_fast_as_ipopt_drives_it() -> None:
    """States by the distance along a closed road: the end is the start of the next lap."""
    stages, length = 60, 240.0
    at = torch.arange(stages + 1, dtype=D) / stages
    bend = (2 * math.pi / length * (1 - 1.5 * torch.cos(4 * math.pi * at))).view(1, -1, 1)

    def along(x: Tensor, u: Tensor, bend: Tensor) -> Tensor:
        (offset, heading, speed), (push, curve) = x.unbind(-1), u.unbind(-1)
        way = (1 - offset * bend[..., 0]) / heading.cos()
        return torch.stack((way * heading.sin(), curve * way - bend[..., 0], push * way / speed), dim=-1)

    def seconds(x: Tensor, u: Tensor, bend: Tensor) -> Tensor:
        time = length / stages * (1 - x[..., 0] * bend[..., 0]) / (x[..., 1].cos() * x[..., 2])
        return time + 1e-3 * u[..., 0] ** 2 + u[..., 1] ** 2

    def grip(x: Tensor, u: Tensor) -> Tensor:
        return (u[..., :1] ** 2 + (x[..., 2:] ** 2 * u[..., 1:]) ** 2) / 64 - 1

    values = {"bend": bend[:, :stages]}
    car = FunctionDynamics(along, n=3, m=2, dt=length / stages, integrator="rk4", knot_values=values)
    road = StateBounds([-3, -1, 3], [3, 1, 40], knots=slice(0, stages + 1))
    parts = [Link(), FunctionConstraint(grip, of="xu"), road, ControlBounds([-8, -0.3], [4, 0.3])]
    cost = FunctionCost(seconds, knot_values={"bend": bend})
    lap = Problem(car, cost, parts, [[0.0, 0.0, 10.0]], stages, free_start=[True] * 3)
    solution = torchgco.solve(lap)
    there = CasADiSolver("ipopt").prepare(lap).solve(lap, torch.zeros_like(solution.U))
    assert solution.statuses == there.statuses == [Status.CONVERGED]
    torch.testing.assert_close(solution.cost, there.cost, rtol=1e-6, atol=0)
    assert float((solution.X[:, 0] - solution.X[:, -1]).abs().max()) < 1e-6


@pytest.mark.sampled(1)
@compiled
@pytest.mark.parametrize("free", [True, False])
def test_links_beside_bounds_on_rates_are_as_in_ipopt(free: bool) -> None:
    """IPOPT gets the rows of two knots as they are; it, FATROP and ours the further states, too."""
    problem = made(RISEN, RateBounds(-0.9, 0.9), MIRRORED, free=free)
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED] * 2 and float(solution.violation.max()) < 1e-6
    X, moved = solution.X, solution.U.diff(dim=1).abs()
    assert float((X[:, 8] + X[:, 22]).abs().max()) < 1e-6 and float(moved.max()) < 0.9 + 1e-6
    rise = X[:, 20, 0] - X[:, 5, 0] - GAPS[:, 0]
    assert float(rise.min()) > -1e-6
    for solver in (CasADiSolver("ipopt").prepare(problem), CasADiSolver("ipopt"), CasADiSolver("fatrop")):
        there = solver.solve(problem, torch.zeros_like(solution.U))
        assert there.statuses == [Status.CONVERGED] * 2 and there.X.shape == X.shape
        torch.testing.assert_close(there.cost, solution.cost, rtol=1e-5, atol=0)
    if not free:
        first = AugmentedLagrangian().solve(problem, torch.zeros_like(solution.U))
        assert first.statuses == [Status.CONVERGED] * 2 and first.X.shape == X.shape
        torch.testing.assert_close(first.cost, solution.cost, rtol=2e-3, atol=0)


@pytest.mark.slow
@compiled
def test_compiled_and_pytorchs_kernels_and_both_precisions_agree() -> None:
    problem = made(RISEN, MIRRORED)
    solution = torchgco.solve(problem)
    kernels.use_native(False)
    try:
        slowly = torchgco.solve(problem)
    finally:
        kernels.use_native(True)
    torch.testing.assert_close(slowly.U, solution.U, rtol=1e-7, atol=1e-7)
    single = torchgco.solve(problem.cast(torch.float32))
    assert single.statuses == [Status.CONVERGED] * 2
    torch.testing.assert_close(single.cost, solution.cost.float(), rtol=1e-4, atol=0)


def test_further_states_carry_the_earlier_knot_and_have_its_derivatives() -> None:
    problem = made(RISEN, RateBounds(-0.9, 0.9), MIRRORED)
    whole, U = with_carried(problem), torch.randn(2, N, 1, dtype=D)
    X = [whole.x0]
    for k in range(N):
        X.append(whole.dynamics.at(k).step(X[-1], U[:, k]))
    X = torch.stack(X, dim=1)
    assert whole.n == 6 and torch.equal(X[:, 1:, 3:4], U)
    assert torch.equal(X[:, 6:, 2], X[:, 5:6, 0].expand(2, N - 5))
    assert torch.equal(X[:, 9:, 4:], X[:, 8:9, :2].expand(2, N - 8, 2))
    for own, there in zip(problem.constraints, whole.constraints, strict=True):
        assert torch.equal(own.value(X[..., :2], U), there.value(X, U))
    along = whole.along
    for mine, theirs in zip(
        along.jacobians(X[:, :-1], U), torchgco.Dynamics.jacobians(along, X[:, :-1], U), strict=True
    ):
        torch.testing.assert_close(mine, theirs)


@pytest.mark.slow
def test_judge_and_certificate_read_both_knots() -> None:
    problem = made(MIRRORED, RISEN)
    solution = torchgco.solve(problem)
    lam = solution.multipliers.lam
    assert [tuple(part.shape) for part in lam[:2]] == [(2, 1, 2), (2, 1, 1)]
    exact = certify(problem, solution.X, solution.U, multipliers=lam)
    assert float(exact.kkt_residual.max()) < 1e-6 and float(exact.dynamics_residual.max()) < 1e-12
    wrong = certify(problem, solution.X, solution.U, multipliers=[lam[0] + 1.0, *lam[1:]])
    assert float(wrong.kkt_residual.min()) > 1e-2
    assert float(certify(problem, solution.X, solution.U).kkt_residual.max()) < 1e-6
    U, x, X = solution.U + 0.1, solution.X[:, 0].numpy(), []
    for k in range(N + 1):
        X.append(x)
        x = problem.dynamics.step(torch.from_numpy(x), U[:, min(k, N - 1)]).numpy()
    apart = np.abs(X[8] + X[22]).max(-1)
    risen = np.maximum(X[5][:, 0] + GAPS[:, 0].numpy() - X[20][:, 0], 0)
    verdict = judge(problem, U, start=solution.X[:, 0])
    np.testing.assert_allclose(verdict.violation.numpy(), np.maximum(apart, risen), rtol=1e-9)
    assert not bool(verdict.feasible.any())


def test_explain_names_both_knots() -> None:
    for link, told in (
        (Link(components=[1]), "(link), state 1 (speed [m/s]) at knot 0 less that at knot 30, knot 30"),
        (MIRRORED, "(mirrored), row 0 of the states at knots 8 and 22, knot 22"),
    ):
        solution = torchgco.solve(made(link, free=False), solver="hold")
        assert told in " ".join(solution.explain(0).split())


def test_a_problem_has_the_same_bits_in_every_batch() -> None:
    problem = made(RISEN, MIRRORED)
    whole = torchgco.solve(problem)
    for b in range(2):
        row = torch.tensor([b])
        alone = torchgco.solve(problem.take(row), ids=row)
        assert torch.equal(alone.U[0], whole.U[b]) and torch.equal(alone.X[0], whole.X[b])
    again = torchgco.solve(problem, warm=whole, U0=whole.U, X0=whole.X, solver="interior_point")
    assert bool((again.iterations < whole.iterations).all())


def test_numbers_of_a_compiled_problem_and_gradients_reach_the_rows() -> None:
    def gap(value: Tensor) -> Problem:
        return made(replace(RISEN, values={"gap": value}), free=False)

    fast, other = torchgco.compile(gap(GAPS)), torch.tensor([[0.5], [0.2]], dtype=D)
    fast()
    answer, solution = fast(numbers={"constraints[0].gap": other}), torchgco.solve(gap(other))
    torch.testing.assert_close(answer.U, solution.U, rtol=1e-6, atol=1e-6)
    given = other.clone().requires_grad_()
    (slope,) = torch.autograd.grad(torchgco.solve(gap(given)).cost.sum(), given)
    cost = lambda value: torchgco.solve(gap(value)).cost
    torch.testing.assert_close(slope[:, 0], (cost(other + 1e-5) - cost(other - 1e-5)) / 2e-5, rtol=1e-4, atol=0)


def test_a_loop_links_the_knots_of_each_plan() -> None:
    mpc, x = MPC(made(Link(components=[0]), free=False)), torch.tensor([[1.0, 0.0], [0.5, 0.5]], dtype=D)
    for _ in range(3):
        u = mpc.step(x)
        assert mpc.answer is not None and mpc.answer.statuses == [Status.CONVERGED] * 2
        torch.testing.assert_close(mpc.answer.X[:, -1, 0], x[:, 0], rtol=1e-6, atol=1e-6)
        x = mpc.compiled.now.dynamics.step(x, u)
    with pytest.raises(InputError, match=r"problem.free_start: expected None in a loop"):
        MPC(made(Link()))


def test_the_last_knot_of_a_horizon_is_the_problems_own() -> None:
    solution = torchgco.solve(made(Link(knots=(3, -1)), horizon=[20, N]))
    assert solution.statuses == [Status.CONVERGED] * 2
    for b, last in enumerate((20, N)):
        torch.testing.assert_close(solution.X[b, last], solution.X[b, 3], rtol=1e-6, atol=1e-6)
    for pair, line in (((25, -1), "expected more than 25 stages"), ((3, 25), r"a knot of constraints\[0\] within")):
        with pytest.raises(InputError, match=rf"horizon: .*{line}"):
            torchgco.solve(made(Link(knots=pair), horizon=[20, N]))


@pytest.mark.parametrize(
    ("link", "line"),
    [
        (Link(knots=(3, 3)), r"link.knots: expected two of 0..30, the earlier one first, got \(3, 3\)"),
        (Link(knots=(-1, 0)), r"link.knots: expected two of 0..30"),
        (Link(knots=5), r"link.knots: expected two of 0..30, .*got 5"),
        (Link(components=[2]), r"link.components: expected some of the states 0..1, none twice, or None, got \[2\]"),
        (Link(components=[0, 0]), r"link.components: expected some of the states"),
        (Link(sense="alike"), "link.sense: expected inequality or equality"),
        (Link(lambda a: a), "link.function: expected rows"),
        (Link(lambda a, b: (a - b).sum(-1)), r"link.function: expected rows \(2, 1, p\)"),
        (Link(lambda a, b: a - b.flip(0)), "link.function: expected values of a problem that depend on its own row"),
        (Link(values={"gap": GAPS}), r"link.values\['gap'\]: expected the name of an argument"),
    ],
)
def test_links_that_do_not_fit_are_named(link: Any, line: str) -> None:
    with pytest.raises(InputError, match=line):
        made(link)
