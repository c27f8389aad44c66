"""A trace is the user's code: captured tensors, NaN and writes end as in PyTorch."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tests.engines import engine_of
from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, InputError, Problem, QuadraticCost, solve
from torchgco.dynamics import rollout
from torchgco.kernels import EagerWarning, measured, open_loop, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.native.compiler import find_compiler

D = torch.float64
B, N = 4, 6
compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
PLAIN = QuadraticCost([1.0] * 3, [0.1] * 3, [5.0] * 3)


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(11), dtype=D)


def model(step: Callable[..., Tensor], **more) -> FunctionDynamics:
    return FunctionDynamics(step, 3, 3, 0.1, "none", **more)


@compiled
def test_a_tensor_given_as_values_may_be_captured_too() -> None:
    """In subsets of the batch the captured one stays whole."""
    goals = drawn(B, 3)
    given = {"values": {"goal": goals}}
    center = lambda goal: goal - goals.mean(0)
    problem = Problem(
        model(lambda x, u, goal: x + 0.1 * u + 0.3 * center(goal), **given),
        FunctionCost(lambda x, u, goal: (x - center(goal)).square().sum(-1) + u.square().sum(-1), **given),
        [FunctionConstraint(lambda x, goal: x * goals[0] - center(goal) - 0.1, **given)],
        drawn(B, 3), N,
    )  # fmt: skip
    assert engine_of(problem) is not None
    for rows in (torch.tensor([2, 0]), torch.tensor([1]), torch.arange(B)):
        part, U = problem.take(rows), drawn(B, N, 3)[rows]
        X = rollout.open_loop(part.dynamics, part.x0, U)
        torch.testing.assert_close(open_loop(part, U), X, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(measured(part, X, U), violation(part.constraints, X, U), rtol=1e-12, atol=1e-12)
        lagrangian = Lagrangian(part, Multipliers.zero(part, 3.0), None, True)
        for mine, theirs in zip(value(lagrangian, X, U), lagrangian.value(X, U), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


@compiled
def test_minima_and_maxima_hand_nan_on() -> None:
    def step(x: Tensor, u: Tensor) -> Tensor:
        root = (0.5 - x).sqrt()  # no number beyond 0.5
        least = torch.stack((root, x), dim=-1).amin(-1)
        return 0.9 * x + 0.1 * u + torch.maximum(root, -x.abs()) * 0.1 + torch.minimum(least, x) * 0.1

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = Problem(model(step), PLAIN, [], torch.tensor([[-1.0, 0.3, 2.0]], dtype=D), N)
        U = 5.0 * drawn(1, N, 3)
        found = open_loop(problem, U)
    torch.testing.assert_close(found, rollout.open_loop(problem.dynamics, problem.x0, U), equal_nan=True)
    assert bool(found.isnan().any()) and bool(found[:, -1].isfinite().any())


@compiled
def test_quotients_of_whole_numbers_have_the_type_that_they_have_in_pytorch() -> None:
    """Single precision, or in costs and where k is asked for that of the problem."""
    shares = lambda x: x * (torch.arange(3) / 7)
    late = lambda x, k: k / 7 if isinstance(k, int) else (k / 7).unsqueeze(-1)
    for step in (lambda x, u: shares(x) + 0.1 * u, lambda x, u, k: shares(x) + 0.1 * u + late(x, k)):
        cost = FunctionCost(lambda x, u: shares(x).square().sum(-1) + u.square().sum(-1), lambda x: shares(x).sum(-1))
        problem = Problem(model(step), cost, [FunctionConstraint(lambda x: shares(x) - 0.1)], drawn(B, 3), N)
        U = drawn(B, N, 3)
        X = rollout.open_loop(problem.dynamics, problem.x0, U)
        assert engine_of(problem) is not None
        torch.testing.assert_close(open_loop(problem, U), X, rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(measured(problem, X, U), violation(problem.constraints, X, U), rtol=1e-14, atol=0.0)
        lagrangian = Lagrangian(problem, Multipliers.zero(problem, 3.0), None, True)
        torch.testing.assert_close(value(lagrangian, X, U)[0], problem.cost.total(X, U), rtol=1e-14, atol=1e-14)


def ring(x: Tensor) -> Tensor:
    return F.pad(x.reshape(-1, 1, 3), (1, 1), mode="circular")[..., 2:].reshape(x.shape)


EAGER: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "circular pad": (ring, "written by way of another"),
    "equal": (lambda x: x if torch.equal(x, torch.zeros_like(x)) else 0.5 * x, "torch.equal"),
    "allclose": (lambda x: x if torch.allclose(x, torch.zeros_like(x)) else 0.5 * x, "torch.allclose"),
    "numel of a mask": (lambda x: x if x[x != 0.0].numel() == 0 else 0.5 * x, "shapes"),
    "integer buffer": (lambda x: x + 0.1 * torch.zeros(x.shape, dtype=torch.int64).copy_(4.0 * x), "other numbers"),
}  # fmt: skip


@compiled
@pytest.mark.parametrize("name", EAGER)
def test_code_that_cannot_be_compiled_is_solved_as_it_is(name: str) -> None:
    function, message = EAGER[name]
    problem = Problem(model(lambda x, u: function(x) + 0.1 * u), PLAIN, [], drawn(2, 3), N)
    with pytest.warns(EagerWarning, match=message):
        assert engine_of(problem) is None


class Remembers(torch.nn.Module):
    """Writes into its own buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("last", torch.zeros(3))

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        self.last.copy_(x.reshape(-1, 3)[0])
        return x + 0.1 * u


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_model_that_writes_into_its_buffer_is_refused_in_one_line(dtype: torch.dtype) -> None:
    problem = Problem(model(Remembers().to(dtype)), PLAIN, [], torch.zeros(2, 3, dtype=dtype), N)
    with pytest.raises(InputError, match="in-place") as caught:
        solve(problem)
    assert caught.value.field == "dynamics.step" and "\n" not in str(caught.value)
