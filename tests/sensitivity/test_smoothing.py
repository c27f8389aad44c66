"""Solutions of barrier problems: where rows are on the edge of holding, derivatives are smooth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from tests.sensitivity.problems import D, Named, along, asking, boxed, discs, large_numbers, numbers, weights
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    Status,
)
from torchgco.base.status import Differentiability as Why
from torchgco.kernels import use_native

MU, STEP = 1e-3, 1e-4
TIGHT = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9)
MODEL = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4")
COST = QuadraticCost([1.0, 0.1], [0.1], [5.0, 1.0])
N = 10


@pytest.fixture(params=["C", "PyTorch"])
def kernels(request: pytest.FixtureRequest) -> Iterator[str]:
    use_native(request.param == "C")
    yield request.param
    use_native(True)


def brake(low: Tensor, smoothing: float | None = None) -> Solution:
    """A double integrator that is brought to rest, with controls of at least `low`."""
    x0 = torch.tensor([[1.0, 0.0]], dtype=D)
    return torchgco.solve(
        Problem(MODEL, COST, [ControlBounds(low, 50.0)], x0, N), verbose=False, solver=TIGHT, smoothing=smoothing
    )


def test_it_is_the_minimum_of_the_cost_with_logarithms(kernels: str) -> None:
    """By Newton's method on all controls, of which the states are linear functions."""
    low, upper = torch.tensor([-4.0], dtype=D), 50.0
    A, B = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=D), torch.tensor([0.005, 0.1], dtype=D)
    free = [torch.linalg.matrix_power(A, k)[:, 0] for k in range(N + 1)]  # from (1, 0), without controls
    by_u = [[torch.linalg.matrix_power(A, k - 1 - j) @ B if j < k else 0 * B for j in range(N)] for k in range(N + 1)]
    H, g = 0.1 * torch.eye(N, dtype=D), torch.zeros(N, dtype=D)
    for k in range(N + 1):
        moved, weight = (
            torch.stack(by_u[k], dim=1),
            torch.diag(torch.tensor([5.0, 1.0] if k == N else [1.0, 0.1], dtype=D)),
        )
        H, g = H + moved.T @ weight @ moved, g + moved.T @ weight @ free[k]
    u = brake(low).U[0, :, 0] + 0.05
    for _ in range(50):
        slope = H @ u + g - MU / (u - low) + MU / (upper - u)
        bend = H + torch.diag(MU / (u - low) ** 2 + MU / (upper - u) ** 2)
        step, t = torch.linalg.solve(bend, slope), 1.0
        while bool((u - t * step <= low).any()):
            t *= 0.5
        u = u - t * step
    assert float(slope.abs().max()) < 1e-10
    found = brake(low, MU)
    assert (found.U[0, :, 0] - u).abs().max() < 1e-8
    assert found.statuses == [Status.FEASIBLE] and not found.X.requires_grad and bool(found.differentiable.all())


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name",
    mostly(
        ("x0", "centers", "velocities", "Q", "qf", "upper", "fastest", "drag", "first", "budget"),
        "velocities", "qf", "fastest", "first",
    ),
)  # fmt: skip
def test_gradients_by_everything_that_a_problem_is_made_of(name: str) -> None:
    check(discs, numbers, name)


def test_gradients_around_a_box() -> None:
    check(boxed, large_numbers, "angles")


def check(make: Callable[[Named], Problem], given: Callable[[], Named], name: str) -> None:
    """Of states and controls, of multipliers and of costs, against differences of fourth order of smoothed solves."""
    leaves, found = smoothed(make, given)
    assert bool(found.differentiable.all()), found.why_not
    aim, th = weights(found), given()
    torch.manual_seed(2)
    direction = torch.where(torch.isfinite(th[name]), torch.randn_like(th[name]), 0.0)
    if th[name].dim() > 1 and name in ("R", "Qf"):
        direction = direction + direction.mT
    change = torch.zeros(3, dtype=D)
    for steps, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
        problem = make({**th, name: th[name] + steps * STEP * direction})
        with torch.no_grad():
            end = torchgco.solve(problem, warm=found, solver=TIGHT, smoothing=MU, verbose=False)
        assert bool(end.differentiable.all())
        change += weight * along(end, aim).sum(-1) / (12 * STEP)
    for i, row in enumerate(along(found, aim)):
        (slope,) = torch.autograd.grad(row.sum(), leaves[name], retain_graph=True)
        mine = float((slope * direction).sum())
        assert abs(float(change[i]) - mine) <= 5e-7 * max(1.0, abs(mine)), (name, i, mine, float(change[i]))


@cache
def smoothed(make: Callable[[Named], Problem], given: Callable[[], Named]) -> tuple[dict[str, Tensor], Solution]:
    """The leaves and the smoothed solution of a problem; once for all tests."""
    leaves = asking(given())
    return leaves, torchgco.solve(make(leaves), smoothing=MU, verbose=False)


def test_on_the_edge_of_holding(kernels: str) -> None:
    """The derivative by a bound that just doesn't hold is between those of its two sides, and a difference agrees."""
    edge = brake(torch.tensor([-50.0], dtype=D)).U[0, 0]
    weak = brake(edge.clone().requires_grad_()).reason
    assert weak is not None and weak.tolist() == [Why.WEAKLY_ACTIVE]
    low = edge.clone().requires_grad_()
    found = brake(low, 1e-6)
    assert found.differentiable.all()
    (slope,) = torch.autograd.grad(found.U[0, 0, 0], low)
    h = 1e-5
    change = (brake(edge + h, 1e-6).U - brake(edge - h, 1e-6).U)[0, 0, 0] / (2 * h)
    assert float(slope) == pytest.approx(float(change), rel=1e-5)
    assert 0.2 < float(slope) < 0.8


def test_less_smoothing_is_nearer_to_the_solution() -> None:
    low = torch.tensor([-4.0], dtype=D)
    exact = brake(low)
    apart = [float((brake(low, mu).U - exact.U).abs().max()) for mu in (1e-2, 1e-4, 1e-6)]
    assert apart[0] > 5 * apart[1] > 25 * apart[2] > 0 and apart[2] < 1e-3


@pytest.mark.slow
@compiled
def test_both_kernels_and_any_batch_give_the_same() -> None:
    th = numbers()
    leaves, whole = smoothed(discs, numbers)
    mine = torch.autograd.grad(along(whole, weights(whole)).sum(), list(leaves.values()), retain_graph=True)
    use_native(False)
    try:
        others = asking(th)
        same = torchgco.solve(discs(others), solver=TIGHT, warm=whole, smoothing=MU, verbose=False)
        slopes = torch.autograd.grad(along(same, weights(whole)).sum(), list(others.values()))
    finally:
        use_native(True)
    for one, other in zip(mine, slopes, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    own = {name: part[1:2] if part.shape[0] == 3 else part for name, part in th.items()}
    alone = torchgco.solve(discs(own), smoothing=MU, verbose=False, ids=torch.tensor([1]))
    assert torch.equal(alone.X, whole.X[1:2].detach()) and torch.equal(alone.cost, whole.cost[1:2].detach())


@pytest.mark.filterwarnings("ignore::torchgco.ScaleWarning")
def test_where_no_smoothed_solution_is_found() -> None:
    """A start inside a disc, and one that is NaN: the solver's own result is returned, and the reason says so."""
    model = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))
    cost = QuadraticCost([1.0, 1.0], [0.1, 0.1], [5.0, 5.0], x_ref=[2.0, 0.0])
    x0 = torch.tensor([[0.0, 0.0], [1.0, 0.1], [torch.nan, 0.0]], dtype=D)
    problem = Problem(model, cost, [Spheres([[1.0, 0.1]], [0.3]), ControlBounds(-9, 9)], x0, N)
    found = torchgco.solve(problem, smoothing=1e-4, verbose=False)
    assert found.reason is not None
    assert found.reason.tolist() == [Why.DIFFERENTIABLE, Why.NOT_SOLVED, Why.NOT_SOLVED]
    plain = torchgco.solve(problem, verbose=False)
    assert torch.equal(found.X[1], plain.X[1]) and not torch.equal(found.X[0], plain.X[0])


def test_bounds_that_coincide_stay_equalities() -> None:
    low = torch.tensor([[-2.0]], dtype=D)
    bounds = [ControlBounds(-5.0, 5.0), ControlBounds(low, low, knots=[0])]
    x0 = torch.tensor([[1.0, 0.0]], dtype=D, requires_grad=True)
    found = torchgco.solve(Problem(MODEL, COST, bounds, x0, N), smoothing=1e-4, verbose=False)
    assert found.differentiable.all() and float(found.U[0, 0, 0].detach()) == pytest.approx(-2.0, abs=1e-9)
    (slope,) = torch.autograd.grad(found.U[0, 0, 0], x0, retain_graph=True)
    assert not slope.abs().max() > 1e-9
    assert torch.autograd.grad(found.U[0, 1, 0], x0)[0].abs().max() > 0.1


@pytest.mark.parametrize("smoothing", (0.0, -1.0, "much", True, float("nan")))
def test_refused(smoothing: object) -> None:
    with pytest.raises(InputError, match="smoothing"):
        brake(torch.tensor([-4.0], dtype=D), smoothing)  # type: ignore[arg-type]


@compiled
def test_without_problems_and_in_inference_mode() -> None:
    one = Problem(MODEL, COST, [ControlBounds(-4.0, 5.0)], torch.zeros(1, 2, dtype=D), N)
    none = one.take(torch.zeros(0, dtype=torch.int64))
    assert len(torchgco.solve(none, smoothing=1e-4, verbose=False)) == 0
    low = torch.tensor([-4.0], dtype=D)
    with torch.inference_mode():
        found = brake(low, 1e-4)
    assert torch.equal(found.U, brake(low, 1e-4).U) and found.differentiable.all()


def test_predictions_of_smoothed_solutions_are_refused() -> None:
    x0 = torch.tensor([[1.0, 0.0]], dtype=D)
    problem = Problem(MODEL, COST, [ControlBounds(-4.0, 5.0)], x0, N)
    found = torchgco.solve(problem, smoothing=1e-4, verbose=False)
    with pytest.raises(InputError, match="smoothing"):
        found.predict(Problem(MODEL, COST, [ControlBounds(-4.0, 5.0)], x0 + 0.01, N))
