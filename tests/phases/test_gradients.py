"""Gradients through solutions of phases, against differences of solves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

import torchgco
from tests.engines import compiled
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Jump,
    Link,
    Phases,
    PhasesSolution,
    Problem,
    QuadraticCost,
)

pytestmark = compiled
D = torch.float64
B = 2
Numbers = Mapping[str, Tensor]
STEP, FAR = 1e-4, 1e-5  # of differences; by what share of their size they differ from gradients at most


def glide(x: Tensor, u: Tensor, drag: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u - drag * x[..., 2:]), -1)


def model(numbers: Numbers) -> FunctionDynamics:
    return FunctionDynamics(glide, n=4, m=2, dt=0.1, integrator="rk4", values={"drag": numbers["drag"]})


def jumping(numbers: Numbers) -> Phases:
    """A flight of free duration to a line that a function captures, and on from there after a push that costs."""
    effort = FunctionCost(lambda x, u, w: w[..., 0] * u.square().sum(-1), values={"w": numbers["w"]})
    line = FunctionConstraint(lambda x: x[..., :1] - numbers["line"], "equality", knots=[-1])
    first = Problem(
        model(numbers), effort, [ControlBounds(-9.0, 0.2 * numbers["most"]), line], numbers["x0"], 6,
        time=FreeTime(0.2, 9.0, weight=numbers["hurry"]),
    )  # fmt: skip
    there = QuadraticCost([0.0] * 4, [0.1, 0.1], numbers["Qf"], x_ref=[2.0, 1.0, 0.0, 0.0])
    then = Problem(model(numbers), there, [], torch.tensor([[1.0, 0.5, 0.5, 0.5]], dtype=D).repeat(B, 1), 5)
    push = Jump(
        lambda x, v, kept: torch.cat((x[..., :2], kept * x[..., 2:] + v), -1), controls=2,
        cost=lambda x, v: v.square().sum(-1), constraints=[ControlBounds(-0.2, numbers["push"])],
        values={"kept": numbers["kept"]},
    )  # fmt: skip
    return Phases([first, then], [push])


def linked(numbers: Numbers) -> Phases:
    """Two phases whose velocities are linked, and a loop from the last place to a free first one."""
    toward = lambda place: QuadraticCost([1.0, 1.0, 0.1, 0.1], [0.1, 0.1], numbers["Qf"], x_ref=[*place, 0.0, 0.0])
    slower = Link(lambda x, y: torch.cat((y[..., :2] - x[..., :2], y[..., 2:] - numbers["line"] * x[..., 2:]), -1))
    back = Link(lambda x, y: y[..., :2] - x[..., :2] - numbers["push"])
    out = Problem(
        model(numbers), toward([1.0, 0.0]), [ControlBounds(-9.0, numbers["most"])], numbers["x0"], 6,
        free_start=[True, True, False, False],
    )  # fmt: skip
    home = Problem(model(numbers), toward([0.0, 1.0]), [], numbers["x0"].detach(), 6)
    return Phases([out, home], [slower], loop=back)


def drawn(seed: int) -> dict[str, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    uniform = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, dtype=D, generator=draw)
    return {
        "drag": uniform(0.2, 0.6, B, 1), "w": uniform(0.1, 0.3, B, 1), "line": uniform(0.6, 0.9, 1),
        "most": uniform(0.6, 1.2, 2), "x0": uniform(-0.2, 0.2, B, 4), "hurry": uniform(0.5, 1.0, B),
        "Qf": uniform(5.0, 20.0, 4), "push": uniform(0.05, 0.1, 2), "kept": uniform(0.5, 0.9, B, 1),
    }  # fmt: skip


@dataclass(frozen=True)
class Case:
    phases: Callable[[Numbers], Phases]
    names: tuple[str, ...]


CASES = {
    "jumps": Case(jumping, ("drag", "w", "line", "most", "x0", "hurry", "Qf", "push", "kept")),
    "links": Case(linked, ("drag", "line", "most", "push", "Qf")),
}


def losses(solution: PhasesSolution) -> Tensor:
    """Numbers of all that has gradients."""
    first, then = solution
    rows = [lam.square().sum() for lam in first.multipliers.lam]
    own = [first.X[:, 3].sum(), then.X[:, -2].square().sum(), first.U[:, 1].sum(), then.U.square().sum()]
    costs = [first.cost.square().sum(), then.cost.sum(), solution.cost.sum()]
    return torch.stack([*own, *costs, solution.begins.square().sum(), solution.found.U.sum(), sum(rows)])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_gradients_are_differences(name: str, seed: int) -> None:
    case, numbers = CASES[name], drawn(seed)
    live = {key: value.clone().requires_grad_() for key, value in numbers.items()}
    solution = torchgco.solve(case.phases(live))
    assert bool(solution.differentiable.all()), solution.why_not
    found, asking = losses(solution), [live[key] for key in case.names]
    grads = [torch.autograd.grad(loss, asking, retain_graph=True, materialize_grads=True) for loss in found]
    draw = torch.Generator().manual_seed(seed)
    for i, key in enumerate(case.names):
        way = torch.randn(live[key].shape, dtype=D, generator=draw)
        slopes = torch.stack([(of[i] * way).sum() for of in grads])
        places = ((live[key] + h * way).detach().requires_grad_() for h in (STEP, -STEP))  # they are polished, too
        after, before = (losses(torchgco.solve(case.phases({**numbers, key: place}))).detach() for place in places)
        differences = (after - before) / (2.0 * STEP)
        torch.testing.assert_close(slopes, differences, rtol=FAR, atol=FAR, msg=lambda told, key=key: f"{key}: {told}")
        assert float(slopes.abs().max()) > 1e-3, key


def test_costs_of_phases_and_jumps_add_up_with_their_gradients() -> None:
    numbers = drawn(3)
    x0 = numbers["x0"].requires_grad_()
    solution = torchgco.solve(jumping(numbers))
    parts = sum(one.cost for one in solution) + solution.jumps[0].square().sum(-1)
    torch.testing.assert_close(parts, solution.cost, rtol=1e-12, atol=0.0)
    whole, summed = (torch.autograd.grad(cost.sum(), x0, retain_graph=True)[0] for cost in (solution.cost, parts))
    torch.testing.assert_close(whole, summed, rtol=1e-5, atol=1e-6)


def test_forward_mode_gives_the_same() -> None:
    numbers = drawn(4)
    start, way = numbers["x0"], torch.randn(B, 4, dtype=D, generator=torch.Generator().manual_seed(4))
    with forward_ad.dual_level():
        dual = torchgco.solve(jumping({**numbers, "x0": forward_ad.make_dual(start, way)}))
        slopes = forward_ad.unpack_dual(losses(dual)).tangent
    live = start.clone().requires_grad_()
    found = losses(torchgco.solve(jumping({**numbers, "x0": live})))
    rows = torch.stack([(torch.autograd.grad(loss, live, retain_graph=True)[0] * way).sum() for loss in found])
    torch.testing.assert_close(slopes, rows, rtol=1e-9, atol=1e-9)


def test_a_problem_that_fails_has_none_and_leaves_the_others_theirs() -> None:
    numbers = drawn(5)
    alone = numbers["x0"].clone().requires_grad_()
    torchgco.solve(jumping({**numbers, "x0": alone})).cost[0].backward()
    broken = numbers["x0"].clone()
    broken[1, 0] = torch.nan
    broken.requires_grad_()
    solution = torchgco.solve(jumping({**numbers, "x0": broken}))
    assert solution.differentiable.tolist() == [True, False]
    torch.where(solution.differentiable, solution.cost + solution[0].cost, 0.0).sum().backward()
    assert broken.grad is not None and alone.grad is not None and float(broken.grad[1].abs().max()) == 0.0
    assert float((broken.grad[0] - alone.grad[0]).abs().max()) > 0.0


def test_what_begins_with_such_a_solution_and_what_asks_for_none() -> None:
    numbers = drawn(6)
    x0 = numbers["x0"].requires_grad_()
    phases = jumping(numbers)
    solution = torchgco.solve(phases)
    assert solution.cost.requires_grad and solution[0].t.requires_grad and not solution[0].violation.requires_grad
    assert bool(torchgco.judge(phases, solution.detach()).feasible.all())
    warm = torchgco.solve(phases, warm=solution)
    gradients = (torch.autograd.grad(one.cost.sum(), x0)[0] for one in (solution, warm))
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-6)
    with torch.no_grad():
        bare = torchgco.solve(phases)
    assert not bare.cost.requires_grad and not bool(bare.differentiable.any())
    torch.testing.assert_close(bare.found.X, solution.found.X.detach(), rtol=1e-5, atol=1e-5)


def test_a_captured_tensor_that_begins_to_ask_is_seen() -> None:
    numbers = drawn(7)
    phases = jumping(numbers)
    assert not torchgco.solve(phases).cost.requires_grad and not torchgco.solve(phases).cost.requires_grad
    numbers["line"].requires_grad_()
    assert torchgco.solve(phases).cost.requires_grad
    numbers["line"].requires_grad_(False)
    assert not torchgco.solve(phases).cost.requires_grad


def test_smoothed_phases_differ_by_little_and_have_gradients_of_bounds_that_do_not_hold() -> None:
    numbers = drawn(8)
    sharp = torchgco.solve(jumping(numbers))
    numbers["most"] = (10.0 * numbers["most"]).requires_grad_()
    solution = torchgco.solve(jumping(numbers), smoothing=1e-3)
    assert bool(solution.differentiable.all()), solution.why_not
    (slopes,) = torch.autograd.grad(solution.cost.sum(), numbers["most"])
    assert float(slopes.abs().min()) > 0.0 and not sharp.cost.requires_grad
    with torch.no_grad():
        again = torchgco.solve(jumping(numbers), smoothing=1e-3)
    torch.testing.assert_close(again.cost, solution.cost.detach(), rtol=1e-9, atol=0.0)
    assert bool((again.cost > torchgco.solve(jumping({**numbers, "most": numbers["most"].detach()})).cost).all())
