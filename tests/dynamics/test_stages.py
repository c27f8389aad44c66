"""Dynamics that depend on the stage: by k, by numbers per stage, and by steps of different length."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled, engine_of, in_c
from tests.native.users import N, with_stages
from torchgco import ILQR, AugmentedLagrangian, FunctionCost, FunctionDynamics, InputError, Problem, Status, kernels
from torchgco.baselines import CasADiSolver
from torchgco.dynamics import rollout
from torchgco.judging.certificate import certify
from torchgco.judging.judge import judge
from torchgco.kernels import EagerWarning, open_loop

D = torch.float64
BRIEF = AugmentedLagrangian(inner=ILQR(max_iterations=2), max_outer_iterations=2)


def by_numpy(problem: Problem, b: int, U: np.ndarray) -> np.ndarray:
    """States (N+1, 4) of the car of `with_stages`, stage by stage."""
    values = problem.dynamics.values
    numbers = dict(zip(values.names + values.knot_names, values.rows + values.knot_rows, strict=True))
    drag, wind, dt = (numbers[name][b].numpy() for name in ("drag", "wind", "dt"))
    X = [problem.x0[b].numpy()]
    for k in range(N):
        (_, _, angle, speed), u = X[-1], U[k]
        fade = (0.5 if k > 5 else 1.0) * 0.95**k
        rates = [speed * np.cos(angle), speed * np.sin(angle), u[1], fade * u[0] - drag * speed]
        X.append(X[-1] + dt[k] * (np.array(rates) + np.array([*wind[k], 0, 0])))
    return np.array(X)


def some_controls(problem: Problem) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(problem.B, problem.N, problem.m, dtype=D, generator=generator)


@compiled
def test_rollouts_and_derivatives_are_those_of_a_loop() -> None:
    problem = with_stages()
    U = some_controls(problem)
    expected = torch.from_numpy(np.stack([by_numpy(problem, b, U[b].numpy()) for b in range(problem.B)]))
    kernels = in_c(problem)
    assert kernels is not None
    for X in (rollout.open_loop(problem.dynamics, problem.x0, U), open_loop(problem, U)):
        torch.testing.assert_close(X, expected, rtol=1e-12, atol=1e-12)
    # A nominal trajectory that ends elsewhere is followed by its gains, stage by stage.
    K = 0.1 * torch.ones(problem.B, N, problem.m, problem.n + 1, dtype=D)
    nominal = expected + 0.01
    nominal[:, 0] = problem.x0
    alpha = torch.zeros(problem.B, dtype=D)
    for mine, theirs in zip(
        kernels.closed_loop(problem, nominal, U, K[..., :-1]),
        rollout.closed_loop(problem.dynamics, nominal, U, K.transpose(0, 1).contiguous(), alpha),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    fx, fu = problem.along.jacobians(expected[:, :-1], U)
    for k in range(N):
        for mine, theirs in zip(problem.dynamics.at(k).jacobians(expected[:, k], U[:, k]), (fx, fu), strict=True):
            torch.testing.assert_close(mine, theirs[:, k], rtol=1e-12, atol=1e-12)
    assert not torch.equal(fx[:, 0], fx[:, 5])


@compiled
def test_a_solve_is_native_and_agrees_with_the_judge_and_with_ipopt() -> None:
    problem = with_stages()
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        solution = torchgco.solve(problem)
    assert set(solution.statuses) == {Status.CONVERGED}
    torch.testing.assert_close(judge(problem, solution.U).cost, solution.cost)
    assert float(certify(problem, solution.X, solution.U).dynamics_residual.max()) < 1e-12
    for plugin in ("ipopt", "fatrop"):
        there = CasADiSolver(plugin).solve(problem, solution.U)
        assert there.statuses == [Status.CONVERGED] * problem.B
        torch.testing.assert_close(there.cost, solution.cost, rtol=1e-3, atol=0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", [True, False])
def test_the_rest_of_the_batch_changes_nothing(native: bool) -> None:
    kernels.use_native(native)
    try:
        whole = torchgco.solve(with_stages(), solver=BRIEF)
        for one in (with_stages(rows=slice(3, 4)), with_stages().take(torch.tensor([3]))):
            assert torch.equal(torchgco.solve(one, solver=BRIEF).U[0], whole.U[3])
    finally:
        kernels.use_native(True)


@compiled
def test_new_numbers_of_stages_need_no_new_kernel() -> None:
    first = with_stages()
    values = first.dynamics.values
    model = FunctionDynamics(
        first.dynamics.function, 4, 2, 0.1, "none", slice(0, 2), dict(zip(values.names, values.rows, strict=True)),
        {name: row + 0.01 for name, row in zip(values.knot_names, values.knot_rows, strict=True)},
    )  # fmt: skip
    moved = first.started_at(first.x0, first.constraints, dynamics=model)
    engines = [engine_of(each) for each in (first, moved)]
    assert engines[0] is not None and engines[1] is not None and engines[0].library is engines[1].library
    assert not torch.equal(open_loop(first, some_controls(first)), open_loop(moved, some_controls(first)))


def integrated(**more: Any) -> Problem:
    """A point whose drag differs from stage to stage, by an integrator of the package."""

    def field(x: Tensor, u: Tensor, k: int | Tensor, gust: Tensor) -> Tensor:
        drag = 0.1 + 0.05 * torch.as_tensor(k, dtype=x.dtype).unsqueeze(-1)
        return torch.cat((x[..., 2:], u - drag * x[..., 2:].sin() + gust), dim=-1)

    gusts = {"gust": torch.ones(1, 20, 2).double()}
    model = FunctionDynamics(field, 4, 2, 0.1, "rk4", slice(0, 2), knot_values=more.pop("knot_values", gusts))
    cost = FunctionCost(lambda x, u: 0.1 * u.square().sum(-1), lambda x: 50.0 * (x[..., :2] - 1.0).square().sum(-1))
    return Problem(model, cost, [], torch.zeros(2, 4, dtype=D), 20)


def test_a_field_that_depends_on_the_stage_is_integrated() -> None:
    problem = integrated()
    X, U = open_loop(problem, some_controls(problem)), some_controls(problem)
    slow, fast = (problem.dynamics.at(k).step(X[:, 5], U[:, 5]) for k in (0, 19))
    torch.testing.assert_close(X, rollout.open_loop(problem.dynamics, problem.x0, U), rtol=1e-12, atol=1e-12)
    assert not torch.allclose(slow, fast)
    assert torchgco.solve(problem).statuses == [Status.CONVERGED] * 2


@pytest.mark.parametrize("rows", [(1, 21, 2), (3, 20, 2), (20, 2)])
def test_numbers_of_another_shape_are_refused(rows: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"dynamics.knot_values\['gust'\]: expected shape \(2, 20, ...\)"):
        integrated(knot_values={"gust": torch.ones(*rows).double()})


def test_a_step_without_its_stage_is_refused() -> None:
    problem = integrated()
    for call in (problem.dynamics.step, problem.dynamics.field, problem.dynamics.jacobians):
        with pytest.raises(InputError, match=r"dynamics: expected a stage, as in `dynamics.at\(k\).step\(x, u\)`"):
            call(problem.x0, problem.x0[:, :2])


@compiled
def test_operations_may_differ_between_stages() -> None:
    def step(x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        if isinstance(k, int):
            return x.sin() + 0.1 * u if k < 5 else x.cos() + 0.1 * u
        rows = (x[..., i, :].sin() if j < 5 else x[..., i, :].cos() for i, j in enumerate(k.tolist()))
        return torch.stack(list(rows), -2) + 0.1 * u

    model = FunctionDynamics(step, 2, 2, 0.1, "none")
    cost = FunctionCost(lambda x, u: u.square().sum(-1) + x.square().sum(-1))
    problem = Problem(model, cost, [], torch.ones(1, 2, dtype=D), 10)
    assert engine_of(problem) is not None
    found = [torchgco.solve(problem, solver=solver) for solver in ("interior_point", "al_ilqr")]
    assert [one.statuses for one in found] == [[Status.CONVERGED]] * 2
    torch.testing.assert_close(found[0].cost, found[1].cost, rtol=1e-6, atol=0.0)


@pytest.mark.slow
@compiled
def test_networks_and_captured_numbers_of_some_stages() -> None:
    """Numbers that all problems share lie behind those of the forms, and may change."""
    net = (
        torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2))
        .double()
        .requires_grad_(False)
    )
    with torch.no_grad():
        for p, weights in enumerate(net.parameters()):
            weights.copy_(torch.randn(weights.shape, generator=torch.Generator().manual_seed(p), dtype=D))
    gain = torch.tensor([0.3, -0.2], dtype=D)

    def step(x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        learned = net(torch.cat((x, u), -1))
        kinds = x + 0.1 * learned, (x + gain * u).sin(), x.cos() + 0.1 * learned * gain
        if isinstance(k, int):
            return kinds[k % 3]
        return torch.stack([kinds[j % 3][..., i, :] for i, j in enumerate(k.tolist())], -2)

    cost = FunctionCost(lambda x, u: u.square().sum(-1) + x.square().sum(-1))
    problem = Problem(
        FunctionDynamics(step, 2, 2, 0.1, "none"), cost, [], torch.tensor([[1.0, 0.5], [0.2, -1.0]]).double(), 7
    )
    U = torch.randn(2, 7, 2, generator=torch.Generator().manual_seed(9), dtype=D)
    for _ in range(2):
        now = kernels.current(problem)
        assert engine_of(now) is not None
        torch.testing.assert_close(
            open_loop(now, U), rollout.open_loop(now.dynamics, now.x0, U), rtol=1e-13, atol=1e-13
        )
        found = [torchgco.solve(problem, solver=solver) for solver in ("interior_point", "al_ilqr")]
        torch.testing.assert_close(found[0].cost, found[1].cost, rtol=1e-6, atol=0.0)
        gain += 0.4
