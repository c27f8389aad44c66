"""torch.inference_mode() and torch.no_grad() change no derivative, wherever the tensors were made."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from tests.problems import planar_batch, quadrotor_batch, quick_gco
from tests.slow import mostly
from torchgco import Cost, FunctionConstraint, FunctionDynamics, Hold, Problem, certify, judge
from torchgco.base.autodiff import gradients


class Race(Cost):
    """Cost of a race to 1 m along a line; its derivatives come from torch.func."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return (x[..., 0] - 1).square() + 0.1 * x[..., 1].square() + 0.01 * u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 10.0 * (x[..., 0] - 1).square()


def functions() -> tuple[Problem, Tensor]:
    """A problem of user functions that close over tensors."""
    A = torch.tensor([[0.0, 1.0], [0.0, 0.0]], dtype=torch.float64)
    limit = torch.tensor([0.6], dtype=torch.float64)

    def field(x: Tensor, u: Tensor) -> Tensor:
        return x @ A.mT + torch.cat((0.0 * u, u * (1 + 0.1 * x[..., :1].sin())), -1)

    rows = [
        FunctionConstraint(lambda x: x[..., 1:] - limit),
        FunctionConstraint(lambda x, u: x[..., :1] * u - 5, of="xu"),
    ]
    start = torch.tensor([[0.0, 0.0], [0.1, 0.0]], dtype=torch.float64)
    return Problem(FunctionDynamics(field, 2, 1, 0.1, "rk4", slice(0, 1)), Race(), rows, start, 25), start.new_zeros(
        2, 25, 1
    )


MAKERS = {
    "planar": lambda: planar_batch(B=2, N=20, obstacles=6, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=2, N=15),
    "functions": functions,
}


def everything(problem: Problem, U0: Tensor) -> list[Tensor]:
    """All results of solve, judge and certify."""
    quick = quick_gco(problem)
    solver = replace(quick, local=replace(quick.local, max_outer_iterations=4))
    solution, held = torchgco.solve(problem, U0, solver), Hold().solve(problem, U0)
    goal = problem.x0.new_zeros(problem.dynamics.position.stop)
    reports = [certify(problem, s.X, s.U) for s in (solution, held)] + [judge(problem, solution.U, goal, 0.3)]
    return [
        solution.X,
        solution.U,
        solution.K,
        *(value for report in reports for value in vars(report).values()),
    ]


@pytest.mark.slow
@compiled
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")  # 0.1 s between knots is long
@pytest.mark.parametrize("name", mostly(MAKERS, "planar", "quadrotor"))
def test_every_mode_gives_the_same_bits(name: str) -> None:
    outside = MAKERS[name]()
    expected = everything(*outside)
    assert float(certify(outside[0], *_held(*outside)).kkt_residual.max()) > 0.05  # a constant 0 would pass
    with torch.inference_mode():
        inside = MAKERS[name]()
        runs = [everything(*outside), everything(*inside)]
    runs.append(everything(*inside))
    with torch.no_grad():
        runs.append(everything(*outside))
    for got in runs:
        for mine, theirs in zip(got, expected, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=0.0, atol=0.0, equal_nan=True)


def _held(problem: Problem, U0: Tensor) -> tuple[Tensor, Tensor]:
    held = Hold().solve(problem, U0)
    return held.X, held.U


def test_gradients_by_unused_arguments_are_zero() -> None:
    x, y = torch.tensor([2.0]), torch.tensor([3.0, 4.0])
    with torch.inference_mode():
        by_x, by_y = gradients(lambda x, y: y.square(), x, y)
        assert by_x.tolist() == [0.0] and by_y.tolist() == [6.0, 8.0]
        assert gradients(lambda x: torch.ones(3), x)[0].tolist() == [0.0]
