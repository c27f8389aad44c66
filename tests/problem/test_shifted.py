"""`Solution.shifted`: the guess of the next period, against a loop over problems, knots and stages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, InputError, Problem, QuadraticCost, Solution

D = torch.float64
N = 9


def field(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 9.81 * x[..., 0].sin()), dim=-1)


MODEL = FunctionDynamics(field, 2, 1, 0.1, "rk4")
COST = QuadraticCost([1, 0.1], [0.1], [10, 1], x_ref=[1.0, 0.0])
ROWS = [
    ControlBounds([-8.0], [8.0]),
    FunctionConstraint(lambda x: x[..., 1:] - 3.0),  # knots 1..N
    FunctionConstraint(lambda x: x[..., :1] - 2.0, knots=[4, 5, 7]),
    FunctionConstraint(lambda x: x[..., :1] - 1.5, knots=[N]),
]


def problem(**others: Any) -> Problem:
    return Problem(MODEL, COST, ROWS, torch.tensor([[0.0, 0.0], [0.5, 1.0], [1.0, 0.0]], dtype=D), N, **others)


def drawn(of: Problem) -> Solution:
    """A solution of drawn numbers."""
    found, generator = torchgco.solve(of, solver="al_ilqr"), torch.Generator().manual_seed(0)
    draw = lambda t: torch.randn(t.shape, dtype=t.dtype, generator=generator)
    multipliers = replace(found.multipliers, lam=tuple(map(draw, found.multipliers.lam)))
    parts = {name: draw(getattr(found, name)) for name in ("X", "U", "K", "d")}
    return replace(found, multipliers=multipliers, **parts)


def later(values: Tensor, knots: list[int], steps: int, last: list[int]) -> Tensor:
    """Values (B, K, ...) at some knots, later."""
    new = values.clone()
    for b in range(len(values)):
        counted = [knot for knot in knots if knot <= last[b]]
        for i, knot in enumerate(counted):
            then = knot + steps
            if then in counted:
                new[b, i] = values[b, knots.index(then)]
            elif then > counted[-1]:
                new[b, i] = values[b, knots.index(counted[-1])]
    return new


@pytest.mark.parametrize("steps", [1, 3, 20])
@pytest.mark.parametrize("horizon", [None, [9, 6, 1]])
def test_every_knot_takes_what_a_later_one_has(steps: int, horizon: list[int] | None) -> None:
    rows = ROWS if horizon is None else [*ROWS[:2], ROWS[3]]  # none at knots beyond a horizon
    solution = drawn(replace(problem(), constraints=rows, horizon=horizon))
    last = horizon or [N, N, N]
    found = solution.shifted(steps)
    stages = [h - 1 for h in last]
    assert torch.equal(found.X, later(solution.X, list(range(N + 1)), steps, last))
    for name in ("U", "K", "d"):
        assert torch.equal(getattr(found, name), later(getattr(solution, name), list(range(N)), steps, stages))
    for lam, old, part in zip(found.multipliers.lam, solution.multipliers.lam, rows, strict=True):
        knots = list(range(N + 1))[1:] if part.knots is None else list(part.knots)
        knots = list(range(N)) if isinstance(part, ControlBounds) else knots
        assert torch.equal(lam, later(old, knots, steps, stages if isinstance(part, ControlBounds) else last))
    assert torch.equal(found.multipliers.mu, solution.multipliers.mu)


def test_it_says_that_nothing_is_solved_yet(tmp_path: Path) -> None:
    solution = torchgco.solve(problem())
    guess = solution.shifted()
    assert {status.name for status in guess.statuses} == {"RUNNING"}
    assert bool(guess.cost.isnan().all() and guess.violation.isnan().all()) and guess.iterations.tolist() == [0] * 3
    assert torch.equal(guess.t, solution.t) and len(guess[1]) == 1 and "RUNNING" in repr(guess)
    assert torch.equal(guess.shifted(2).X, solution.shifted(3).X)
    one = solution[1].shifted()
    assert torch.equal(one.X, guess.X[1:2]) and torch.equal(one.multipliers.lam[2], guess.multipliers.lam[2][1:2])
    solution.save(tmp_path / "one.npz")
    torch.testing.assert_close(Solution.load(tmp_path / "one.npz").shifted().U, guess.U, rtol=0, atol=0)
    part = 0.5 * (guess.U + solution.shifted(2).U)  # of a stage: the straight line between
    torch.testing.assert_close(solution.shifted(1.5).U, part, rtol=1e-12, atol=1e-12)
    for steps in (0, -1, float("inf"), "two"):
        with pytest.raises(InputError, match="steps"):
            solution.shifted(steps)  # type: ignore[arg-type]


@pytest.mark.parametrize("solver", ["gco", "al_ilqr"])
def test_a_loop_swings_up_a_pendulum_that_the_plan_of_before_does_not(solver: str) -> None:
    """Each period starts from the former plan, one stage later, with a disturbance: all of them end stationary."""
    generator = torch.Generator().manual_seed(1)
    cost = QuadraticCost([1, 0.1], [0.01], [100, 10], x_ref=[torch.pi, 0.0])
    x, warm, names = torch.zeros(1, 2, dtype=D), None, set()
    for _ in range(30):
        period = Problem(MODEL, cost, [ControlBounds([-12.0], [12.0])], x, 20)
        found = torchgco.solve(period, solver=solver, warm=warm)
        x = MODEL.step(x, found.U[:, 0]) + 0.002 * torch.randn(1, 2, generator=generator, dtype=D)
        warm = found.shifted()
        names.add(found.statuses[0].name)
    assert names == {"CONVERGED"} and abs(float(x[0, 0]) - torch.pi) < 0.1
