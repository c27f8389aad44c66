"""Gradients of X, U, multipliers and cost by everything that a problem is made of, against differences of solves."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

import torchgco
from tests.sensitivity.problems import (
    KINDS,
    TIGHT,
    Named,
    along,
    asking,
    box_numbers,
    boxed,
    by_differences,
    discs,
    growth,
    large_numbers,
    numbers,
    solved,
    weights,
)
from tests.slow import mostly
from torchgco import Problem
from torchgco.kernels import use_native

WITHIN = 2e-7  # of the derivative; differences are no better


def check(
    make: Callable[[Named], Problem], given: Callable[[], Named], name: str, grown: torch.Tensor | None = None
) -> None:
    leaves, solution = solved(make, given)
    assert bool(solution.differentiable.all()), solution.why_not
    aim = weights(solution)
    torch.manual_seed(2)
    th = given()
    direction = torch.where(torch.isfinite(th[name]), torch.randn_like(th[name]), 0.0)
    if th[name].dim() > 1 and name in ("R", "Qf"):
        direction = direction + direction.mT  # weights are symmetric
    mine = []
    for row in along(solution, aim):
        (slope,) = torch.autograd.grad(row.sum(), leaves[name], retain_graph=True)
        mine.append((slope * direction).sum())
    ends = [one.sum(-1) for one in by_differences(make, th, name, direction, solution, aim, grown)]
    for i, slope in enumerate(mine):
        best = min(float((end[i] - slope).abs()) for end in ends)
        assert best <= WITHIN * max(1.0, float(slope.abs())), (name, i, float(slope), best)
    assert float(mine[0].abs()) > 1e-3 or name == "lower"


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", mostly(KINDS, *KINDS[::3], *KINDS[1::3]))
def test_among_discs(name: str) -> None:
    check(discs, numbers, name)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", mostly(box_numbers(), *tuple(box_numbers())[::2]))
def test_around_a_box(name: str) -> None:
    check(boxed, large_numbers, name)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", mostly(box_numbers(), *tuple(box_numbers())[::2]))
def test_cleared_between_knots(name: str) -> None:
    """Minima of the problem with a box that has grown for this, by a constant."""
    _, solution = solved(boxed, box_numbers)
    grown = growth(boxed(box_numbers()), solution)
    assert float(grown.min()) > 1e-3
    check(boxed, box_numbers, name, grown)


@pytest.mark.slow
def test_kernels_in_pytorch_give_the_same() -> None:
    leaves, solution = solved(discs, numbers)
    mine = torch.autograd.grad(along(solution, weights(solution)).sum(), list(leaves.values()), retain_graph=True)
    use_native(False)
    try:
        others = asking(numbers())
        same = torchgco.solve(discs(others), solver=TIGHT, U0=solution.U.detach(), warm=solution)
        assert bool(same.differentiable.all())
        slopes = torch.autograd.grad(along(same, weights(solution)).sum(), list(others.values()))
    finally:
        use_native(True)
    for name, one, other in zip(leaves, mine, slopes, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-7, msg=lambda text, name=name: f"{name}: {text}")


def test_a_bound_that_never_holds_has_a_derivative_of_exactly_0() -> None:
    leaves, solution = solved(discs, numbers)
    (slope,) = torch.autograd.grad(solution.X.sum() + solution.U.sum(), leaves["lower"], retain_graph=True)
    assert not slope.any()
    assert float(solution.multipliers.lam[1][..., 2:].detach().abs().max()) < 1e-9  # and none of its rows pushes


def test_each_kind_of_row_holds_somewhere() -> None:
    """Else the tests above would say nothing of bounds, discs and budgets."""
    _, solution = solved(discs, numbers)
    held = [bool((lam.detach() > 1e-3).any()) for lam in solution.multipliers.lam]
    assert held == [True] * 4
