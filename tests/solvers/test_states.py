"""States to begin with: which solvers take them, that they matter, and one clear error for all others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch
from tests.search.test_starts import swing_up
from torchgco import ControlBounds, InputError, Problem, QuadraticCost, RateBounds, Unicycle, kernels, presets, solve
from torchgco.search import Starts

D = torch.float64
SWINGS = swing_up(0.0, 0.3)


def turns(number: float) -> Tensor:
    """States that swing up by a number of turns, (2, N+1, 2)."""
    share = torch.linspace(0, 1, SWINGS.N + 1, dtype=D).view(1, -1, 1)
    end = torch.tensor([2 * torch.pi * number, 0.0], dtype=D)
    return SWINGS.x0.unsqueeze(1) + share * (end - SWINGS.x0).unsqueeze(1)


@pytest.mark.parametrize("name", ["interior_point", "gco", "ipopt"])
def test_the_optimum_depends_on_them(name: str) -> None:
    """From states near an optimum a solver finds it at once; the first state is no guess."""
    near = solve(SWINGS, solver="interior_point", X0=turns(0.5))
    moved = torch.cat((near.X[:, :1] + 1.0, near.X[:, 1:]), dim=1)
    found = solve(SWINGS, near.U, name, X0=moved)
    torch.testing.assert_close(found.cost, near.cost, rtol=1e-4, atol=0)
    assert torch.equal(found.X[:, 0], SWINGS.x0)
    cold = solve(SWINGS, solver=name)
    other = solve(SWINGS, solver=name, X0=turns(0.5))
    assert not torch.equal(cold.U, other.U) and bool((other.violation <= 1e-5).all())


def test_they_are_those_of_the_problem_in_any_batch_and_of_the_solver() -> None:
    X0, U0 = turns(0.5), SWINGS.x0.new_zeros(2, SWINGS.N, 1)
    solver = presets.interior_point(SWINGS)
    whole = solve(SWINGS, U0, solver, X0=X0)
    assert torch.equal(whole.U, solver.solve(SWINGS, U0, X0=X0).U)
    for name in ("interior_point", "gco"):
        both = solve(SWINGS, solver=name, X0=X0)
        for b in range(2):
            alone = solve(SWINGS.take(slice(b, b + 1)), solver=name, X0=X0[b : b + 1], ids=torch.tensor([b]))
            assert torch.equal(alone.U[0], both.U[b])


def test_bounds_on_rates_need_no_more_states() -> None:
    """The controls before, which are further states within, are those of U0."""
    model = Unicycle(dt=0.1)
    cost = QuadraticCost([0.0] * model.n, [1.0] * model.m, [10.0] * model.n, x_ref=[1.0] + [0.0] * (model.n - 1))
    rows = [ControlBounds([-2.0] * model.m, [2.0] * model.m), RateBounds([-1.0] * model.m, [1.0] * model.m)]
    problem = Problem(model, cost, rows, torch.zeros(2, model.n, dtype=D), 12)
    X0 = torch.linspace(0, 1, 13, dtype=D).view(1, -1, 1) * torch.tensor([1.0] + [0.0] * (model.n - 1), dtype=D)
    X0 = X0.expand(2, -1, -1).contiguous()
    found, plain = (solve(problem, solver="interior_point", X0=X) for X in (X0, None))
    assert found.X.shape == X0.shape and not torch.equal(found.iterations, plain.iterations * 0)
    torch.testing.assert_close(found.cost, plain.cost, rtol=1e-5, atol=1e-9)


def test_states_that_are_no_numbers_end_their_own_problem() -> None:
    X0 = turns(0.5)
    held = SWINGS.x0.unsqueeze(1).expand_as(X0).contiguous()
    broken = torch.stack((X0[0], torch.full_like(X0[1], torch.nan)))
    found = solve(SWINGS, solver="interior_point", X0=broken)
    mixed = solve(SWINGS, solver="interior_point", X0=torch.stack((X0[0], held[1])))
    assert torch.equal(found.U[0], mixed.U[0]) and found.status[0] == mixed.status[0]
    assert found.statuses[1].name == "NON_FINITE"


@pytest.mark.parametrize("name", ["al_ilqr", "ilqr", "multistart", "hold", "mppi", "gco", "fatrop_guided"])
def test_solvers_that_cannot_use_them_say_so(name: str) -> None:
    problem, U0 = planar_batch(B=2, N=6, obstacles=1)  # for gco: among obstacles
    with pytest.raises(InputError) as caught:
        solve(problem, U0, name, X0=problem.x0.new_zeros(2, 7, problem.n))
    assert caught.value.field == "X0" and len(str(caught.value).splitlines()) == 1
    assert "interior_point" in str(caught.value)


def test_what_does_not_fit_is_refused() -> None:
    X0 = turns(0.5)
    wrong: list[Any] = [X0[:, 1:], X0[:1], X0.float(), X0.numpy(), X0.clone().requires_grad_()]
    for bad in wrong:
        with pytest.raises(InputError, match=r"^X0"):
            solve(SWINGS, solver="interior_point", X0=bad)
    solver = presets.gco(SWINGS)
    with pytest.raises(InputError, match=r"^X0"):  # no interior point comes first
        solve(SWINGS, solver=replace(solver, passes=solver.passes.steps[1:]), X0=X0)
    assert any(isinstance(step, Starts) for step in solver.passes.steps)


def test_without_native_kernels_they_are_taken_too() -> None:
    swing = SWINGS.take(torch.tensor([0]))
    native = solve(swing, solver="interior_point", X0=turns(0.5)[:1])
    kernels.use_native(False)
    try:
        found = solve(swing, solver="interior_point", X0=turns(0.5)[:1])
    finally:
        kernels.use_native(True)
    assert found.statuses == native.statuses
    torch.testing.assert_close(found.cost, native.cost, rtol=1e-6, atol=0)
