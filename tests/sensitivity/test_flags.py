"""Where solutions have no derivatives: said so, with gradients of 0 that poison nobody."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.sensitivity.problems import asking, box_numbers, boxed, discs, numbers
from tests.sensitivity.test_forms import FORMS
from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, Goal, Problem, QuadraticCost, Spheres, Status
from torchgco.base.status import Differentiability as Why
from torchgco.kernels import current
from torchgco.sensitivity import attached
from torchgco.sensitivity.points import Points, points_of

D = torch.float64
N = 10
MODEL = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4")
COST = QuadraticCost([1.0, 0.1], [0.1], [5.0, 1.0])


def start(*rows: tuple[float, float]) -> Tensor:
    return torch.tensor(rows, dtype=D).requires_grad_()


def reasons(problem: Problem, **options: object) -> list[Why]:
    solution = torchgco.solve(problem, verbose=False, **options)  # type: ignore[arg-type]
    assert solution.reason is not None
    assert solution.differentiable.tolist() == [reason == Why.DIFFERENTIABLE for reason in solution.reason.tolist()]
    assert solution.why_not == [Why(reason).sentence for reason in solution.reason.tolist()]
    return [Why(reason) for reason in solution.reason.tolist()]


def test_a_bound_on_the_edge_of_holding() -> None:
    """The bound is the control itself: where it is a hair larger it doesn't push, where it is smaller it does."""
    x0 = start((1.0, 0.0))
    free = torchgco.solve(Problem(MODEL, COST, [ControlBounds(-50, 50)], x0, N), verbose=False).U[0, 0].detach()
    edges = {-1e-3: Why.DIFFERENTIABLE, -1e-9: Why.WEAKLY_ACTIVE, 1e-9: Why.WEAKLY_ACTIVE, 1e-3: Why.DIFFERENTIABLE}
    for more, why in edges.items():
        low = free + more * free.abs()  # the free control is negative: brakes
        assert reasons(Problem(MODEL, COST, [ControlBounds(low, 50.0)], x0, N)) == [why], more


def test_weak_rows_that_don_t_matter_are_no_reason() -> None:
    """A row of its own control, which no derivative depends on: a spare control that rests on its bound."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u[..., :1]), -1), 2, 2, 0.1, "rk4")
    cost = QuadraticCost([1.0, 0.1], [0.1, 1.0], [5.0, 1.0])
    bounds = ControlBounds([-50.0, 0.0], [50.0, 1.0])
    solution = torchgco.solve(Problem(model, cost, [bounds], start((1.0, 0.0)), N), verbose=False)
    slack, lam = solution.U[0, :, 1].detach(), solution.multipliers.lam[0][0, :, 3].detach()
    assert float(slack.abs().max()) < 1e-5 and float(lam.abs().max()) < 1e-4  # on the edge at every stage
    assert solution.reason is not None and solution.reason.tolist() == [Why.WEAKLY_ACTIVE]  # U depends on the bound


@pytest.mark.slow
def test_dependent_rows() -> None:
    ends = FunctionConstraint(lambda x: x[..., :1] - 0.2, "equality", knots=[N])
    assert reasons(Problem(MODEL, COST, [ends], start((1.0, 0.0)), N)) == [Why.DIFFERENTIABLE]
    assert reasons(Problem(MODEL, COST, [ends, ends], start((1.0, 0.0)), N)) == [Why.DEPENDENT_ROWS]


def test_a_flat_minimum() -> None:
    """Two controls do the same, and cost nothing apart: one may take what the other leaves."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u.sum(-1, keepdim=True)), -1), 2, 2, 0.1, "rk4")
    cost = QuadraticCost([1.0, 0.1], [[0.1, 0.1], [0.1, 0.1]], [5.0, 1.0])
    assert reasons(Problem(model, cost, [ControlBounds(-50, 50)], start((1.0, 0.0)), N)) == [Why.NOT_STRICT]


@pytest.mark.parametrize(
    ("worth", "why"), [(400.0, Why.DIFFERENTIABLE), (380.0, Why.LEAVES_GOAL), (100.0, Why.LEAVES_GOAL)]
)
def test_trajectories_whose_minimum_nearby_is_elsewhere(worth: float, why: Why) -> None:
    """A solver may keep a trajectory that arrives where the end is worth too little for the minimum to do so."""
    model = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))

    def make(worth: float, radius: float) -> Problem:
        cost = QuadraticCost([0.0, 0.0], [1.0, 1.0], [worth, worth], x_ref=[3.0, 0.0])
        return Problem(model, cost, [ControlBounds(-9, 9)], start((0.0, 0.0)), N, Goal([3.0, 0.0], radius))

    arrived = torchgco.solve(make(400.0, 1.0), verbose=False).detach()
    radius = 1.02 * float((arrived.X[0, -1] - torch.tensor([3.0, 0.0])).norm())
    asked = make(worth, radius)
    reason = attached(asked, current(asked), arrived).reason
    assert reason is not None and reason.tolist() == [why]


@pytest.mark.filterwarnings("ignore::torchgco.ScaleWarning")
def test_gradients_of_others_are_those_without_them() -> None:
    """One problem has no solution, another a NaN in its start; upstream gradients of these are NaN."""
    model = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))
    cost = QuadraticCost([1.0, 1.0], [0.1, 0.1], [5.0, 5.0], x_ref=[2.0, 0.0])
    make = lambda x0: Problem(
        model, cost, [Spheres([[1.0, 0.1]], [0.3]), ControlBounds(-9, 9)], x0, N, Goal([2.0, 0.0], 0.5)
    )
    x0 = torch.tensor([[0.0, 0.0], [1.0, 0.1], [torch.nan, 0.0], [0.1, -0.1]], dtype=D)
    both, leaf = x0.clone().requires_grad_(), x0[[0, 3]].clone().requires_grad_()
    solution, alone = (
        torchgco.solve(make(both), verbose=False),
        torchgco.solve(make(leaf), verbose=False, ids=torch.tensor([0, 3])),
    )
    assert solution.statuses[1:3] == [Status.INVALID_START, Status.NON_FINITE]
    assert solution.differentiable.tolist() == [True, False, False, True]
    assert solution.reason is not None and solution.reason[1:3].tolist() == [Why.NOT_SOLVED] * 2
    weight = torch.where(solution.differentiable, 1.0, torch.nan).view(-1, 1, 1)
    (slope,) = torch.autograd.grad(
        (weight * solution.U).sum() + (weight * solution.X).sum() + solution.cost.sum(), both
    )
    (want,) = torch.autograd.grad(alone.U.sum() + alone.X.sum() + alone.cost.sum(), leaf)
    assert torch.equal(slope[[0, 3]], want) and not slope[1:3].any()


def test_gradients_of_a_batch_without_derivatives_are_zero() -> None:
    """With respect to all that it is made of, captured tensors too; upstream gradients that are NaN change nothing."""
    ends, x0 = FunctionConstraint(lambda x: x[..., :1] - 0.2, "equality", knots=[N]), start((1.0, 0.0))
    spring, Q = (torch.tensor(part, dtype=D, requires_grad=True) for part in (0.3, [1.0, 0.1]))
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u - spring * x[..., :1]), -1), 2, 1, 0.1, "rk4")
    problem = Problem(model, QuadraticCost(Q, [0.1], [5.0, 1.0]), [ends, ends], x0, N)
    solution = torchgco.solve(problem, verbose=False)
    assert not solution.differentiable.any()
    for part in (solution.X, solution.U, solution.cost, solution.multipliers.lam[0]):
        slopes = torch.autograd.grad(torch.nan * part.sum(), (x0, spring, Q), retain_graph=True)
        assert all(torch.equal(slope, torch.zeros_like(slope)) for slope in slopes)
    (solution.X.sum() + solution.cost.sum()).backward()
    assert x0.grad is not None and not x0.grad.any()


@pytest.mark.sampled(2)
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
@pytest.mark.parametrize("form", [*FORMS, "discs", "boxed"])
def test_no_gradient_is_missing_where_there_is_none(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, given = FORMS.get(form) or {"discs": (discs, numbers()), "boxed": (boxed, box_numbers())}[form]

    def none_of(*arguments: Any) -> Points:
        points = points_of(*arguments)
        return replace(points, reason=torch.full_like(points.reason, int(Why.MOVED)))

    monkeypatch.setattr("torchgco.sensitivity.attach.points_of", none_of)
    leaves = asking(given)
    found = torchgco.solve(make(leaves), solver="interior_point", verbose=False)
    slopes = torch.autograd.grad(found.X.sum() + found.U.sum() + found.cost.sum(), list(leaves.values()))
    assert all(torch.equal(slope, torch.zeros_like(slope)) for slope in slopes)


def test_functions_that_take_no_empty_batch() -> None:
    """Gradients of their problems are those of tensors that a loss doesn't depend on."""
    ends, x0 = FunctionConstraint(lambda x: x[..., :1] - 0.2, "equality", knots=[N]), start((1.0, 0.0))

    def field(x: Tensor, u: Tensor) -> Tensor:
        if x.numel() == 0:
            raise ValueError("nothing to do")
        return torch.cat((x[..., 1:], u), -1)

    model = FunctionDynamics(field, 2, 1, 0.1, "rk4")
    solution = torchgco.solve(Problem(model, COST, [ends, ends], x0, N), verbose=False)
    assert not solution.differentiable.any()
    (solution.X.sum() + solution.U.sum() + solution.cost.sum() + solution.multipliers.lam[0].sum()).backward()
    assert x0.grad is None


def test_solved_without_gradients() -> None:
    x0 = torch.tensor([[1.0, 0.0]], dtype=D)
    solution = torchgco.solve(Problem(MODEL, COST, [ControlBounds(-5, 5)], x0, N), verbose=False)
    assert solution.reason is None and not solution.differentiable.any()
    assert solution.why_not == [Why.NOT_ASKED.sentence]
