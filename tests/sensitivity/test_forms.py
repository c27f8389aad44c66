"""Gradients of problems whose solvers work on another form: free starts and times, rates, horizons, goals that bind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Gates,
    Goal,
    InteriorPoint,
    NormBounds,
    Problem,
    QuadraticCost,
    RateBounds,
    Solution,
    Spheres,
    StateBounds,
)

D = torch.float64
TIGHT = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9)
CART = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4")
BOAT = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", position=slice(0, 2))
STEP = 1e-4

Named = Mapping[str, Tensor]


def numbers(**given: Any) -> dict[str, Tensor]:
    return {name: torch.tensor(value, dtype=D) for name, value in given.items()}


def free_start(th: Named) -> Problem:
    """Where to begin, within bounds, on the way around a disc."""
    bounds = [ControlBounds(-9, 9), StateBounds([-0.1, -5, -50, -50], [0.1, 5, 50, 50], knots=[0])]
    cost = QuadraticCost([0.0] * 4, th["R"], [5.0, 5, 1, 1], x_ref=[3.0, 0, 0, 0])
    return Problem(
        BOAT, cost, [Spheres(th["centers"], [0.4], 0.1), *bounds], th["x0"], 20, free_start=[True, True, False, False]
    )


def within_horizons(th: Named) -> Problem:
    """Rates of controls, and horizons of two problems that differ."""
    rates = RateBounds(-th["rate"], th["rate"])
    cost = QuadraticCost(th["Q"], [0.1], [5.0, 1.0])
    return Problem(CART, cost, [ControlBounds(-3, 3), rates], th["x0"], 10, horizon=[7, 10])


def through_gates(th: Named) -> Problem:
    """A required goal, gates, and limits on thrust and speed, all of which hold."""
    limits = [NormBounds("u", upper=th["thrust"]), NormBounds(("x", [2, 3]), upper=th["speed"])]
    cost = QuadraticCost([0.0] * 4, [0.1, 0.1], [0.0] * 4)
    goal = Goal(th["goal"], th["near"], required=True)
    return Problem(BOAT, cost, [Gates(th["centers"], th["radius"]), *limits], torch.zeros(1, 4, dtype=D), 20, goal)


def through_squares(th: Named) -> Problem:
    """Gates that are squares, and a state that must be reached, but for one component."""
    cost = QuadraticCost([0.0] * 4, [0.1, 0.1], [0.0] * 4)
    squares = Gates(th["centers"], normals=th["normals"], half_widths=th["half"])
    goal = Goal(state=torch.cat((th["goal"], th["goal"].new_tensor([torch.nan]))), required=True)
    return Problem(BOAT, cost, [squares, ControlBounds(-50, 50)], torch.zeros(1, 4, dtype=D), 20, goal)


def in_time(th: Named) -> Problem:
    """The duration of two segments, with bounds on controls and on their rates."""
    cost, goal = QuadraticCost([0.0, 0.0], [0.1], [0.0, 0.0]), Goal(state=th["end"], required=True)
    bounds = [ControlBounds(-th["force"], 3), RateBounds(-th["rate"], th["rate"])]
    return Problem(CART, cost, bounds, th["x0"], 20, goal, time=FreeTime(0.2, 3.0, th["weight"], segments=2))


FORMS: dict[str, tuple[Callable[[Named], Problem], dict[str, Tensor]]] = {
    "free start": (free_start, numbers(centers=[[1.5, 0.2]], R=[0.1, 0.1], x0=[[0.0, 0.0, 0.2, 0.0]])),
    "horizons": (within_horizons, numbers(rate=[0.5], Q=[1.0, 0.1], x0=[[1.0, 0.0], [-1.5, 1.0]])),
    "gates": (
        through_gates,
        numbers(centers=[[1.0, 0.5], [2.0, -0.5]], radius=0.1, goal=[3.0, 0.2], near=0.2, thrust=8.0, speed=2.7),
    ),
    "time": (in_time, numbers(force=[2.0], rate=[0.5], end=[0.0, 0.0], x0=[[1.0, 0.0]], weight=9.0)),
    "squares": (
        through_squares,
        numbers(centers=[[1.0, 0.5], [2.0, -0.5]], normals=[[1.0, 0.1], [1.0, -0.1]], half=0.1, goal=[3.0, 0.2, 0.0]),
    ),
}
SLOW = [pytest.param(*each, marks=pytest.mark.slow) for each in (("squares", 0.0), ("time", 1e-3))]


def value(found: Solution) -> Tensor:
    """A number in which nothing cancels: of states, controls, multipliers, costs and times."""
    along = torch.linspace(1.0, 2.0, found.X.shape[1], dtype=D).view(1, -1, 1)
    total = (found.X * along).sum() + found.U.square().sum() + found.cost.sum()
    total = total + sum((lam.sqrt() * (lam.detach() > 1e-6)).nan_to_num().sum() for lam in found.multipliers.lam[:1])
    return total if found.times is None else total + 3 * found.duration.sum() + found.t[:, 7].sum()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("form", "smoothing"), [*((form, 0.0) for form in list(FORMS)[:4]), ("horizons", 1e-3), *SLOW])
def test_gradients_are_differences(form: str, smoothing: float) -> None:
    make, given = FORMS[form]
    leaves = {name: part.clone().requires_grad_() for name, part in given.items()}
    soft = smoothing or None
    found = torchgco.solve(make(leaves), smoothing=soft, verbose=False)
    assert bool(found.differentiable.all()), found.why_not
    slopes = torch.autograd.grad(value(found), list(leaves.values()))
    torch.manual_seed(0)
    for (name, part), slope in zip(given.items(), slopes, strict=True):
        direction = torch.randn_like(part)
        ends = []
        for steps in (1, -1, 2, -2):
            moved = make({**given, name: part + steps * STEP * direction})
            end = torchgco.solve(moved, solver=TIGHT, warm=found, smoothing=soft, verbose=False)
            ends.append(value(end))
        change = float((8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * STEP))
        mine = float((slope * direction).sum())
        assert abs(mine - change) < 1e-5 * max(1.0, abs(mine)), (name, mine, change)
        assert abs(mine) > 1e-3, name


def test_solutions_in_free_time_serve_as_others_do(tmp_path) -> None:
    make, given = FORMS["time"]
    leaves = {name: part.clone().requires_grad_() for name, part in given.items()}
    problem = make(leaves)
    found = torchgco.solve(problem, verbose=False)
    assert found.duration.requires_grad and not found.detach().duration.requires_grad
    plain = found.detach()
    assert found.to_frame(problem)["duration"].tolist() == plain.duration.tolist()
    assert len(found.trajectories(rate=20.0)) == len(plain.trajectories(rate=20.0))
    assert found.worst_rows(problem).equals(plain.worst_rows(problem)) and str(found.explain())
    found.save(tmp_path / "solution.npz")
    assert torch.equal(Solution.load(tmp_path / "solution.npz").t, plain.t)


def test_predictions_of_free_starts() -> None:
    make, given = FORMS["free start"]
    before = torchgco.solve(make(given), verbose=False)
    moved = make({**given, "centers": given["centers"] + 1e-3})
    soon, due = before.predict(moved), torchgco.solve(moved, solver=TIGHT, warm=before, verbose=False)
    apart = [float((one.X - due.X).abs().max()) for one in (soon, before)]
    assert bool(soon.differentiable.all()) and apart[0] < 0.02 * apart[1]
    assert float((soon.X[:, 0] - before.X[:, 0]).abs().max()) > 1e-6
