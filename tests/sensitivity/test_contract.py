"""What holds of every gradient: batches, solves without them, other ways to differentiate, and what is refused."""

from __future__ import annotations

import gc
import resource

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from tests.sensitivity.problems import B, D, along, asking, box_numbers, boxed, discs, numbers, solved, weights
from torchgco import (
    ControlBounds,
    FunctionDynamics,
    Goal,
    InputError,
    Problem,
    QuadraticCost,
    Solution,
)
from torchgco.kernels import use_native

PER_PROBLEM = "x0", "centers", "radii", "vehicle", "velocities", "x_ref", "lower", "upper", "drag"
MODEL = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4")
COST = QuadraticCost([1.0, 0.1], [0.1], [5.0, 1.0])


def small(x0: Tensor, high: Tensor | float = 3.0) -> Solution:
    return torchgco.solve(Problem(MODEL, COST, [ControlBounds(-3.0, high)], x0, 10), verbose=False)


@pytest.mark.slow
@compiled
def test_gradients_of_a_problem_do_not_depend_on_its_batch() -> None:
    th = numbers()
    leaves, whole = solved(discs, numbers)
    aim = weights(whole)
    mine = torch.autograd.grad(along(whole, aim).sum(), [leaves[name] for name in PER_PROBLEM], retain_graph=True)
    for rows in ([2, 0], [1]):
        part = {name: value[rows] if name in PER_PROBLEM else value for name, value in th.items()}
        own = asking(part)
        solution = torchgco.solve(discs(own), verbose=False, ids=torch.tensor(rows))
        assert torch.equal(solution.X, whole.X[rows])
        slopes = torch.autograd.grad(
            along(solution, tuple(one[rows] for one in aim)).sum(), [own[n] for n in PER_PROBLEM]
        )
        for name, one, all_of_them in zip(PER_PROBLEM, slopes, mine, strict=True):
            assert torch.equal(one, all_of_them[rows]), name


@pytest.mark.sampled(1)
@pytest.mark.parametrize("in_c", [pytest.param(True, marks=compiled), False])
def test_gradients_keep_their_bits_in_both_kernels(in_c: bool) -> None:
    """Of a model without a product of all knots with one matrix, whose last bits PyTorch's kernels can't keep."""
    x0, high = (
        torch.tensor([[1.0, 0.0], [-1.5, 1.0], [0.3, 0.2]], dtype=D),
        torch.tensor([[0.8], [0.9], [0.1]], dtype=D),
    )
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u - 0.1 * x[..., :1].sin()), -1), 2, 1, 0.2, "rk4")

    def slopes(rows: list[int]) -> tuple[Tensor, ...]:
        start, bound = x0[rows].requires_grad_(), high[rows].requires_grad_()
        problem = Problem(model, COST, [ControlBounds(-bound, bound)], start, 8)
        found = torchgco.solve(problem, solver="interior_point", verbose=False, ids=torch.tensor(rows))
        assert bool(found.differentiable.all())
        return found.X.detach(), *torch.autograd.grad(found.X[:, 4].sum(), (start, bound))

    use_native(in_c)
    try:
        whole = slopes([0, 1, 2])
        for rows in ([2, 0], [1]):
            assert all(torch.equal(one, all_of[rows]) for one, all_of in zip(slopes(rows), whole, strict=True))
    finally:
        use_native(True)


def test_solves_that_nothing_asks_gradients_of_keep_their_bits() -> None:
    """And those within no_grad: the same trajectories, without a polish and without a graph."""
    plain = torchgco.solve(discs(numbers()), verbose=False)
    with torch.no_grad():
        quiet = torchgco.solve(discs(asking(numbers())), verbose=False)
    for name in ("X", "U", "cost", "violation", "K", "status", "iterations"):
        assert torch.equal(getattr(plain, name), getattr(quiet, name))
    assert plain.reason is None and quiet.reason is None and not quiet.X.requires_grad
    _, live = solved(discs, numbers)
    assert torch.equal(live.status, plain.status) and torch.allclose(live.X, plain.X, atol=1e-4)


@pytest.mark.slow
def test_gradcheck() -> None:
    x0, high = torch.tensor([[1.0, 0.0], [-1.5, 1.0]], dtype=D), torch.tensor([[0.9], [1.2]], dtype=D)

    def values(x0: Tensor, high: Tensor) -> tuple[Tensor, ...]:
        found = torchgco.solve(Problem(MODEL, COST, [ControlBounds(-high, high)], x0, 10), verbose=False)
        return found.X, found.U, found.multipliers.lam[0], found.cost

    leaves = x0.requires_grad_(), high.requires_grad_()
    assert float(values(*leaves)[2].detach().max()) > 0.1  # bounds hold
    assert torch.autograd.gradcheck(values, leaves, eps=1e-5, atol=1e-6, rtol=1e-6)


def test_the_systems_are_symmetric() -> None:
    _, solution = solved(discs, numbers)
    node = solution.U.grad_fn
    assert node is not None
    system = node.system  # type: ignore[attr-defined]
    torch.manual_seed(3)
    tangents = [torch.randn(1, B, *shape, dtype=D) for shape in ((25, 4), (24, 2), (24, 4), (system.active.shape[1],))]
    up = [torch.randn(1, B, *shape, dtype=D) for shape in ((25, 4), (24, 2), (system.active.shape[1],))]
    tangents[0][:, :, 0] = up[0][:, :, 0] = 0.0  # of a given start
    x, u, _, v = system.solve(*tangents)
    ahead = sum((a * b).sum() for a, b in zip(up, (x, u, v), strict=True))
    back = system.solve(up[0], up[1], None, up[2])
    active = system.active.to(D)
    tangents[3] = tangents[3] * active
    torch.testing.assert_close(
        ahead, sum((a * b).sum() for a, b in zip(tangents, back, strict=True)), rtol=1e-8, atol=0
    )


def test_each_solve_has_a_graph_of_its_own() -> None:
    problem = Problem(MODEL, COST, [ControlBounds(-3, 3)], torch.tensor([[1.0, 0.0]], dtype=D, requires_grad=True), 10)
    first, second = (torchgco.solve(problem, verbose=False) for _ in range(2))
    first.cost.sum().backward()
    second.cost.sum().backward()  # of the same problem: nothing of the first graph is in it
    with pytest.raises(RuntimeError, match="second time"):
        first.cost.sum().backward()


@pytest.mark.slow
def test_solutions_with_gradients_serve_as_others_do(tmp_path) -> None:
    leaves, solution = solved(boxed, box_numbers)
    problem = boxed(leaves)
    frame = solution.to_frame(problem)
    assert frame["cost"].tolist() == solution.cost.tolist()
    solution.save(tmp_path / "solution.npz")
    assert torch.equal(Solution.load(tmp_path / "solution.npz").X, solution.X)
    assert torch.equal(solution.detach().X, solution.X) and not solution.detach().cost.requires_grad
    assert solution.detach().detach() is not solution
    again = torchgco.solve(problem, warm=solution, verbose=False)  # a guess takes no part in derivatives
    assert again.X.requires_grad and bool(again.differentiable.all())
    assert solution[1].X.requires_grad and solution[1].differentiable.tolist() == [True]
    assert str(solution.explain(0)) and solution.to_dict()["X"].shape == solution.X.shape


@pytest.mark.parametrize(
    ("field", "make"),
    [
        ("problem", lambda x: Problem(MODEL, COST, [ControlBounds(-3, 3)], x.float().detach().requires_grad_(), 10)),
        ("goal.radius", lambda x: Problem(FunctionDynamics(lambda x, u: u, 1, 1, 0.1, position=slice(0, 1)),
            QuadraticCost([1.0], [1.0], [1.0]), [], x[:, :1].detach(), 10, Goal([1.0], x[0, 0]))),
    ],
)  # fmt: skip
def test_what_is_not_served_is_refused_in_one_line(field: str, make) -> None:
    x0 = torch.tensor([[1.0, 0.0]], dtype=D, requires_grad=True)
    with pytest.raises(InputError) as caught:
        torchgco.solve(make(x0), verbose=False)
    assert caught.value.field == field and "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_thousand_gradients_take_no_memory() -> None:
    x0 = torch.tensor([[1.0, 0.0], [-1.5, 1.0]], dtype=D, requires_grad=True)
    used = []
    for i in range(1000):
        small(x0).U.sum().backward()
        if i % 100 == 99:
            gc.collect()
            used.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert used[-1] - used[1] < 4096  # kB in 800 solves


@pytest.mark.parametrize("step", [0.01, 0.5])
def test_numbers_that_change_before_backward_change_no_gradient(step: float) -> None:
    """An optimizer steps between a solve and its gradient."""

    def slopes(by: float) -> Tensor:
        aim = torch.tensor([1.0, 0.2], dtype=D, requires_grad=True)
        cost = QuadraticCost([1.0, 0.1], [0.1], [5.0, 1.0], x_ref=aim)
        x0 = torch.tensor([[0.3, 0.0], [-0.4, 0.2]], dtype=D)
        found = torchgco.solve(Problem(MODEL, cost, [ControlBounds(-3.0, 3.0)], x0, 10), verbose=False)
        with torch.no_grad():
            aim += by
        return torch.autograd.grad(found.X.square().sum(), aim)[0]

    torch.testing.assert_close(slopes(step), slopes(0.0), rtol=1e-12, atol=0.0)
