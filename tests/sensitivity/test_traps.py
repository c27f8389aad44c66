"""What would go wrong unseen: compilers in training loops, gradients lost while binding, numbers of another age."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from torch import Tensor

import torchgco
from tests.sensitivity.problems import TIGHT, D
from tests.slow import mostly
from torchgco import ControlBounds, FunctionDynamics, Goal, Layouts, Problem, QuadraticCost, Spheres
from torchgco.experiments.config.build import compose
from torchgco.native import compiler

N = 15


def point(x0: Tensor, model: FunctionDynamics, radius: Tensor | float, **weights: Tensor) -> Problem:
    cost = QuadraticCost(**{"Q": [1.0, 1.0], "R": [0.1, 0.1], "Qf": [20.0, 20.0], "x_ref": [2.0, 0.0]} | weights)
    parts = [Spheres(torch.tensor([[1.0, 0.1]], dtype=D), radius, 0.1), ControlBounds(-4, 4)]
    return Problem(model, cost, parts, x0, N, Goal([2.0, 0.0], 0.5))


def steered() -> FunctionDynamics:
    return FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")  # of the interior point alone
@pytest.mark.parametrize(
    ("solver", "warm"), mostly([("gco", False), ("interior_point", True)], ("gco", False), several=True)
)
def test_a_training_step_calls_no_compiler(solver: str, warm: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(4, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2)).double()
    model = FunctionDynamics(lambda x, u: u + 0.3 * net(torch.cat((x, u), -1)), 2, 2, 0.1, "rk4", slice(0, 2))
    problem = point(torch.zeros(2, 2, dtype=D), model, torch.tensor([0.3], dtype=D))
    optimizer = torch.optim.SGD(net.parameters(), lr=1e-2)
    losses, solution = [], None
    for step in range(4):
        solution = torchgco.solve(problem, solver=solver, warm=solution if warm else None, verbose=False)
        assert bool(solution.differentiable.all())  # of the weights as they are now, in C as in PyTorch
        loss = torch.where(solution.differentiable, solution.cost, 0.0).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if step == 0:
            monkeypatch.setattr(compiler, "_start", lambda *_: pytest.fail("a compiler is called"))
    assert all(after < before for before, after in pairwise(losses))


def test_weights_that_look_like_less_have_all_their_gradients() -> None:
    """A matrix that happens to be diagonal, linear terms that happen to be 0, and no cross term."""
    Q, R = torch.eye(2, dtype=D).requires_grad_(), torch.diag(torch.tensor([0.1, 0.1], dtype=D)).requires_grad_()
    q, r, qf = (torch.zeros(2, dtype=D, requires_grad=True) for _ in range(3))
    H = torch.zeros(2, 2, dtype=D, requires_grad=True)
    problem = point(torch.zeros(1, 2, dtype=D), steered(), torch.tensor([0.3], dtype=D), Q=Q, R=R, q=q, r=r, qf=qf, H=H)
    solution = torchgco.solve(problem, verbose=False)
    assert bool(solution.differentiable.all())
    slopes = torch.autograd.grad(solution.U[:, :5].square().sum(), (Q, R, q, r, qf, H))
    assert all(bool((slope != 0).all()) for slope in slopes)
    plain = {name: part.detach() for name, part in {"Q": Q, "R": R, "q": q, "r": r, "qf": qf}.items()}
    bound = point(torch.zeros(1, 2, dtype=D), steered(), 0.3 * torch.ones(1, dtype=D), **plain).cost
    assert bound.diagonal and bound.q is None  # type: ignore[attr-defined]  # where nothing asks, what is quicker stays


def test_a_disc_is_the_same_in_both_its_copies() -> None:
    """Values in PyTorch are products with `weights`, kernels in C read centres and radii: one graph leads to both."""
    radius = torch.tensor([0.3], dtype=D, requires_grad=True)
    part = point(torch.zeros(1, 2, dtype=D), steered(), radius).recorded().constraints[0]
    X = torch.rand(1, N + 1, 2, dtype=D)
    value = part.value(X, torch.zeros(1, N, 2, dtype=D)).sum()
    apart = X[:, 1:, None] - part.centers.unsqueeze(1)
    own = (part.inflated_radii.square().unsqueeze(1) - apart.square().sum(-1)).sum()
    slopes = [torch.autograd.grad(of, radius, retain_graph=True)[0] for of in (value, own)]
    torch.testing.assert_close(value, own)
    torch.testing.assert_close(*slopes)


def test_a_kept_problem_has_the_numbers_of_now() -> None:
    radius = torch.tensor([0.3], dtype=D, requires_grad=True)
    kept = point(torch.zeros(1, 2, dtype=D), steered(), radius)
    before = torchgco.solve(kept, verbose=False)
    with torch.no_grad():
        radius += 0.2
    fresh = torchgco.solve(point(torch.zeros(1, 2, dtype=D), steered(), radius), verbose=False)
    for problem in (kept, kept.take(torch.tensor([0]))):
        after = torchgco.solve(problem, verbose=False)
        assert torch.equal(after.X, fresh.X) and not torch.equal(after.X, before.X)
        (slope,), (want,) = (torch.autograd.grad(one.cost.sum(), radius, retain_graph=True) for one in (after, fresh))
        assert torch.equal(slope, want)
        direct = TIGHT.solve(problem, fresh.U.detach())
        assert torch.allclose(direct.X, fresh.X.detach(), atol=1e-6)


def test_parts_of_a_batch_keep_their_gradients() -> None:
    x0 = torch.tensor([[0.0, 0.0], [0.1, -0.2], [-0.1, 0.3]], dtype=D, requires_grad=True)
    whole = point(x0, steered(), torch.tensor([0.3], dtype=D))
    part = torchgco.solve(whole.take(torch.tensor([2, 0])), verbose=False, ids=torch.tensor([2, 0]))
    (slope,) = torch.autograd.grad(part.cost.sum(), x0)
    assert not slope[1].any() and bool((slope[[0, 2]] != 0).any(-1).all())


@pytest.mark.slow
def test_rows_that_hold_are_held_exactly() -> None:
    """planar_trap: with a softer hold of active rows, derivatives of half of these problems are off by over 1e-4."""
    planner = compose(["model=planar", "scenario=planar_trap"])
    layouts = Layouts.load("benchmarks/data/planar_trap.npz").take(range(6))
    task = planner.vehicle.task(layouts)
    given, discs = task.problem, task.problem.constraints[0]
    own = discs.inflated_radii - discs.vehicle_radius.unsqueeze(-1)
    direction = 0.5 * own

    def made(radii: Tensor) -> Problem:
        parts = [Spheres(discs.centers, radii, discs.vehicle_radius), *given.constraints[1:]]
        return Problem(given.dynamics, given.cost, parts, given.x0, given.N, given.goal)

    leaf = own.clone().requires_grad_()
    solution = torchgco.solve(made(leaf), U0=task.U0, verbose=False)
    assert int(solution.differentiable.sum()) >= 5
    (slope,) = torch.autograd.grad(solution.U.square().sum(), leaf)
    mine, start, best = (slope * direction).sum(-1), solution.detach(), torch.full((6,), torch.inf, dtype=D)
    for h in (1e-4, 1e-5):
        ends = [
            TIGHT.solve(made(own + sign * h * direction), start.U, warm=start.multipliers, X0=start.X).U.square()
            for sign in (1, -1)
        ]
        change = (ends[0] - ends[1]).sum((1, 2)) / (2 * h)
        best = torch.minimum(best, (change - mine).abs() / mine.abs())
    assert float(best[solution.differentiable].max()) < 1e-5
