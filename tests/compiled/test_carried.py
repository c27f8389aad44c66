"""Compiled problems with rows of two knots: packed once, with what the rows carry among the states that C has."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.kinds import START, N, car, point, reference
from torchgco import MPC, InputError, Link, Problem, RateBounds, Spheres, Status
from torchgco.native.compiler import find_compiler
from torchgco.solvers.interior import InteriorPoint

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
INF = np.inf
KINDS: dict[str, Callable[..., Problem]] = {
    "rates": lambda lower=-0.4, upper=0.5, previous=0.1: car(RateBounds(lower, upper, previous=previous)),
    "one control": lambda lower=-0.2, upper=0.3, previous=0.0: car(
        RateBounds([lower, -INF], [INF, upper], previous=[previous, previous], knots=[0, 3, 4, 9])
    ),
    "free first controls": lambda lower=-0.2, upper=0.3: car(RateBounds(lower, upper)),
    "a link": lambda gap=0.4: point(Link(lambda a, b, gap: a + gap - b, (3, 9), "inequality", [0], {"gap": [[gap]]})),
    "rates and a link": lambda lower=-2.5, upper=2.5, previous=0.5: point(
        Link(knots=(2, 8), components=[3, 1]), RateBounds(lower, upper, previous=previous)
    ),
}
CHANGED = {"lower": 0.8, "upper": 0.9, "previous": 0.7, "gap": 1.5}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", KINDS)
def test_warm_calls_are_solved_in_c_with_new_numbers(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And give what a solve of these numbers gives."""
    compiled, draws = torchgco.compile(KINDS[kind](), "interior_point"), np.random.default_rng(0)
    compiled()
    rows = [name for name in compiled.numbers if re.match(r"constraints\[[12]", name)]
    new = {name: CHANGED[name.rpartition(".")[2]] * compiled.numbers[name] for name in rows}
    own = {name.rpartition(".")[2]: float(value[np.isfinite(value)][0]) for name, value in new.items()}
    x = compiled.problem.x0 + 0.05 * torch.from_numpy(draws.standard_normal((1, 4)))
    changed = KINDS[kind](**own)
    fresh = torchgco.solve(Problem(changed.dynamics, changed.cost, list(changed.constraints), x, N))
    monkeypatch.setattr(InteriorPoint, "run", None)
    answer = compiled(x0=x, numbers=new)
    assert bool(answer.warm[0]) and answer.statuses == fresh.statuses == [Status.CONVERGED]
    torch.testing.assert_close(answer.X, fresh.X, rtol=0, atol=1e-4)
    torch.testing.assert_close(answer.U, fresh.U, rtol=0, atol=1e-4)
    assert answer.K.shape == (1, N, 2, 4) and compiled.solution().K.shape == (1, N, 2, 4)


@pytest.mark.parametrize("kind", ["rates", "a link"])
def test_failed_warm_calls_begin_again_from_what_is_flown(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan before, within bounds of controls and rates, before the solver begins anew."""
    mpc = MPC(KINDS[kind](), "interior_point")
    x = mpc.compiled.problem.x0.numpy()[0]
    u = mpc.step(x)
    assert mpc.answer is not None
    x = mpc.answer.X[0, 1].numpy()
    kept: Any = mpc.compiled._kept
    kept.X[:, 5:], kept.U[:] = torch.nan, torch.nan
    monkeypatch.setattr(InteriorPoint, "run", None)
    then = mpc.step(x)
    assert mpc.statuses == [Status.CONVERGED] and not bool(mpc.answer.warm[0])
    assert kind != "rates" or float((then - u).abs().max()) <= 0.5 + 1e-6


def test_what_the_solver_finds_is_gone_on_from_in_c() -> None:
    mpc = MPC(car(RateBounds(-0.3, 0.3, previous=0.0), Spheres([[2.5, 0.4]], [0.3], 0.2)), "gco")
    x, found, warm = np.array(START), 0, 0
    for k in range(12):
        u = mpc.step(x, x_ref=reference(0.1 * k), centers=[[4.5, 1.2] if k > 5 else [2.5, 0.4]])
        assert mpc.answer is not None and mpc.statuses == [Status.CONVERGED] and bool((u.abs() <= 3.0).all())
        found, warm = found + (not bool(mpc.answer.warm[0])), warm + bool(mpc.answer.warm[0])
        x = mpc.answer.X[0, 1].numpy()
    assert warm >= 8


@pytest.mark.parametrize(
    ("new", "told"),
    [
        ({"lower": np.nan}, "numbers or -inf"),
        ({"lower": [[0.6, 0.6]]}, "at most the upper"),
        ({"upper": -INF}, "numbers or inf"),
        ({"previous": [[np.nan, 0.0]]}, "finite"),
    ],
)
def test_rates_that_cannot_be_are_refused(new: dict[str, Any], told: str) -> None:
    compiled = torchgco.compile(KINDS["rates"](), "interior_point")
    with pytest.raises(InputError, match=told):
        compiled(numbers={f"constraints[1].{name}": np.broadcast_to(value, (1, 2)) for name, value in new.items()})
    assert compiled().statuses == [Status.CONVERGED]
