"""Values per problem and per knot for the functions of a problem."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled, engine_of
from tests.slow import mostly
from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, InputError, Problem, QuadraticCost, kernels
from torchgco.base.values import NO_VALUES
from torchgco.kernels import EagerWarning, measured

D = torch.float64
B, N = 3, 20
GOALS = torch.tensor([[1.0, 0.0], [2.0, 1.0], [0.0, 2.0]], dtype=D)
DRAGS = torch.tensor([0.2, 0.5, 1.0], dtype=D)
LIMITS = torch.linspace(2.5, 1.5, N + 1, dtype=D).unsqueeze(-1)
THRUSTS = 4.0 + torch.arange(B * (N + 1), dtype=D).reshape(B, N + 1, 1).sin()


def field(x: Tensor, u: Tensor, drag: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u - drag.unsqueeze(-1) * x[..., 2:]), dim=-1)


def stage(x: Tensor, u: Tensor, goal: Tensor, k: int | Tensor) -> Tensor:
    return 0.1 * (x[..., :2] - goal).square().sum(-1) + 0.1 * u.square().sum(-1) * (1.0 + 0.125 * k)


def problem(rows: slice = slice(None), **more: Any) -> Problem:
    cost = FunctionCost(stage, lambda x, goal: 500.0 * (x[..., :2] - goal).square().sum(-1), {"goal": GOALS[rows]})
    slow = FunctionConstraint(lambda x, k: x[..., 2:3] - LIMITS[k])
    weak = FunctionConstraint(lambda u, most: u[..., :1] - most, of="u", knot_values={"most": THRUSTS[rows]})
    dynamics = FunctionDynamics(field, 4, 2, 0.1, position=slice(0, 2), values={"drag": DRAGS[rows]})
    return Problem(dynamics, cost, [slow, weak], torch.zeros(len(GOALS[rows]), 4, dtype=D), N, **more)


@pytest.mark.slow
@pytest.mark.parametrize("native", mostly([True, False], False))
def test_every_problem_has_its_own_values(native: bool) -> None:
    kernels.use_native(native)
    try:
        with warnings.catch_warnings():
            if native:
                warnings.simplefilter("error", EagerWarning)
            whole = torchgco.solve(problem())
            for b in range(B):
                alone, part = problem(slice(b, b + 1)), problem().take(torch.tensor([b]))
                for one in (alone, part):
                    assert torch.equal(torchgco.solve(one).X[0], whole.X[b])
    finally:
        kernels.use_native(True)
    assert bool((whole.X[:, 1:, 2] <= LIMITS[1:, 0] + 1e-3).all())
    assert bool((whole.U[..., 0] <= THRUSTS[:, :N, 0] + 1e-3).all())
    assert float((whole.X[:, -1, :2] - GOALS).norm(dim=-1).max()) < 0.2


def test_sums_are_those_of_a_loop() -> None:
    made, generator = problem(), torch.Generator().manual_seed(3)
    X, U = (torch.randn(B, K, size, dtype=D, generator=generator) for K, size in ((N + 1, 4), (N, 2)))
    total = made.cost.total(X, U)
    for b in range(B):
        expected = sum(float(stage(X[b, k], U[b, k], GOALS[b], k)) for k in range(N))
        expected += 500.0 * float((X[b, -1, :2] - GOALS[b]).square().sum())
        assert abs(expected - float(total[b])) < 1e-9
        for k in range(N):
            samples = U[:, :5]  # (B, S, m)
            rows = made.constraints[1].values.call(made.constraints[1].function, samples, k=k)
            torch.testing.assert_close(rows[b], samples[b, :, :1] - THRUSTS[b, k], rtol=0, atol=0)


def test_functions_of_the_knot_leave_pytorchs_precision_as_it_was() -> None:
    """With threads, too, one of which ends while the other's function runs."""
    running, ended = threading.Event(), threading.Event()

    def waits(x: Tensor, k: int) -> Tensor:
        running.set()
        ended.wait(timeout=0.2)
        return x * k

    x = torch.zeros(1, 1, dtype=D)
    slow = threading.Thread(target=lambda: NO_VALUES.call(waits, x, k=1))
    fast = threading.Thread(target=lambda: (running.wait(), NO_VALUES.call(lambda x, k: x * k, x, k=1), ended.set()))
    slow.start()
    fast.start()
    slow.join()
    fast.join()
    assert torch.get_default_dtype() is torch.float32


def test_another_threads_numbers_keep_their_precision_while_a_function_of_the_knot_runs() -> None:
    inside, asked, seen = threading.Event(), threading.Event(), []

    def function(x: Tensor, k: Tensor) -> Tensor:
        inside.set()
        asked.wait(timeout=5.0)
        return x * (0.3 * k).unsqueeze(-1)

    def other() -> None:
        inside.wait(timeout=5.0)
        seen.append(torch.tensor(1.0).dtype)
        asked.set()

    thread = threading.Thread(target=other)
    thread.start()
    rows = NO_VALUES.call(function, torch.ones(1, 4, 1, dtype=D), k=torch.arange(4))
    thread.join()
    assert seen == [torch.float32] and rows.flatten().tolist() == [0.3 * k for k in range(4)]


OF_KNOTS: dict[str, Callable[[Tensor], Tensor]] = {
    "product": lambda k: 0.3 * k,
    "quotient": lambda k: k / 7,
    "root": lambda k: k.sqrt() + (0.1 * k).sin(),
    "choice": lambda k: torch.where(k > 2, 0.1, 0.2),
    "by name": lambda k: torch.where(input=torch.tensor(0.1), condition=k > 2, other=0.3),
    "truth": lambda k: (k > 2) * 0.3,
    "table": lambda k: torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5])[k] + torch.eye(5)[k, 0],
    "made": lambda k: torch.full((5,), 0.1) * k + torch.linspace(0, 1, 5) - torch.zeros(5),
    "single": lambda k: 0.1 * k.float() + torch.tensor(0.3, dtype=torch.float32),
    "remainder": lambda k: k % 0.7 + k.clamp(max=2.5),
    "stack": lambda k: torch.stack([0.1 * k, k / 7]).sum(0) + torch.atan2(k, k + 1),
}


@pytest.mark.parametrize("usual", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", OF_KNOTS)
def test_functions_of_the_knot_are_as_precise_as_with_another_default(name: str, usual: torch.dtype) -> None:
    k, function = torch.arange(5), OF_KNOTS[name]
    for dtype in (torch.float64, torch.float32):
        torch.set_default_dtype(dtype)
        due = function(k)
        torch.set_default_dtype(usual)
        try:
            found = NO_VALUES.call(lambda x, k: function(k), torch.ones(1, 5, 1, dtype=dtype), k=k)
        finally:
            torch.set_default_dtype(torch.float32)
        assert found.dtype is due.dtype and torch.equal(found, due)


@pytest.mark.slow
@compiled
def test_new_values_need_no_new_kernel() -> None:
    first = problem()
    torchgco.solve(first)
    cost = FunctionCost(stage, lambda x, goal: 500.0 * (x[..., :2] - goal).square().sum(-1), {"goal": GOALS + 0.25})
    moved = first.started_at(first.x0 + 0.1, first.constraints, cost=cost)
    engines = [engine_of(each.renewed()) for each in (first, moved)]
    assert engines[0] is not None and engines[1] is not None and engines[0].library is engines[1].library
    assert float((torchgco.solve(moved).X[:, -1, :2] - GOALS - 0.25).norm(dim=-1).max()) < 0.4


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: FunctionCost(5), "cost.stage_function: expected a function"),
        (lambda: FunctionCost(stage, 5), "cost.terminal_function: expected a function"),
        (lambda: FunctionCost(stage, None, [1.0]), "cost.values: expected a dict of tensors by name"),
        (lambda: FunctionCost(stage, None, {"goal": GOALS[:2]}), r"cost.values\['goal'\]: expected shape \(3, ...\)"),
        (lambda: FunctionCost(stage, None, {"goals": GOALS}), r"cost.values\['goals'\]: .*doesn't take"),
        (lambda: FunctionCost(stage, None, None, {"goal": GOALS}), r"cost.knot_values\['goal'\]: expected shape"),
        (lambda: FunctionCost(stage), "cost.stage: expected a number"),
    ],
)
def test_values_that_do_not_fit_are_named(make: Any, line: str) -> None:
    good = problem()
    with pytest.raises(InputError, match=line):
        Problem(good.dynamics, make(), [], good.x0, N)


def simple(constraint: FunctionConstraint) -> Problem:
    cost = FunctionCost(lambda x, u: 0.1 * u.square().sum(-1), lambda x: 50.0 * (x[..., :2] - 1.0).square().sum(-1))
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), dim=-1), 4, 2, 0.1, position=slice(0, 2))
    return Problem(model, cost, [constraint], torch.zeros(1, 4, dtype=D), N)


@pytest.mark.slow
def test_an_argument_k_with_a_default_is_a_constant_of_the_users() -> None:
    plain = torchgco.solve(simple(FunctionConstraint(lambda x: 2.0 * x[..., :1] - 1.0)))
    named = torchgco.solve(simple(FunctionConstraint(lambda x, k=2.0: k * x[..., :1] - 1.0)))
    assert torch.equal(plain.X, named.X) and float(plain.X[..., 0].max()) > 0.45
    made = FunctionDynamics(lambda x, u, k=0.5: torch.cat((x[..., 2:], u - k * x[..., 2:]), dim=-1), 4, 2, 0.1)
    base = simple(FunctionConstraint(lambda x: x[..., :1] - 5.0))
    assert Problem(made, base.cost, [], base.x0, N).dynamics.step(torch.ones(1, 4), torch.ones(1, 2)).shape == (1, 4)


def test_the_last_knot_is_N_for_a_terminal_cost() -> None:
    cost = FunctionCost(
        lambda x, u: 1e-4 * u.square().sum(-1), lambda x, k: 50.0 * (x[..., :2] - 0.1 * k).square().sum(-1)
    )
    base = simple(FunctionConstraint(lambda x: x[..., :1] - 5.0))
    solution = torchgco.solve(Problem(base.dynamics, cost, [], base.x0, N))
    assert float((solution.X[0, -1, :2] - 0.1 * N).abs().max()) < 0.05


def test_values_of_another_problem_are_refused() -> None:
    bound = problem()
    with pytest.raises(InputError, match=r"cost\.values\['goal'\]: expected shape \(1, \.\.\.\)"):
        Problem(problem(slice(0, 1)).dynamics, bound.cost, [], bound.x0[:1], N)
    with pytest.raises(InputError, match=r"constraint\.knot_values\['most'\]: expected shape"):
        Problem(bound.dynamics, bound.cost, [bound.constraints[1]], bound.x0, N - 5)


def test_numbers_of_knots_are_as_precise_as_the_states() -> None:
    """0.3 * k, with whole numbers k, is double where the states are, as in native code."""
    constraint = FunctionConstraint(lambda x, k: x[..., :1] - (0.3 * k).unsqueeze(-1), "equality", knots=[7, 9])
    for dtype in (torch.float64, torch.float32):
        X = torch.zeros(1, 11, 1, dtype=dtype)
        problem = Problem(
            FunctionDynamics(lambda x, u: u, 1, 1, 0.1), QuadraticCost([1.0], [1.0], [0.0]), [constraint], X[:, 0], 10
        )
        rows = problem.constraints[0].value(X, X[:, :10])
        assert rows.dtype == dtype
        tolerance = 1e-15 if dtype == torch.float64 else 1e-6
        assert abs(rows.flatten().tolist()[0] + 0.3 * 7) <= tolerance
        assert abs(float(measured(problem, X, X[:, :10])[0]) - 0.3 * 9) <= tolerance
    assert torch.get_default_dtype() == torch.float32
