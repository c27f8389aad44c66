"""Limits of time hold for every preset that repeats something."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import Problem, Status, presets
from torchgco.base import clock
from torchgco.baselines.pursuit import PathPursuit
from torchgco.solvers.ilqr import ILQR


class Clock:
    """Stands still until it is told that the time is over."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(clock, "seconds", lambda: self.now)

    def after(self, calls: int, function: Callable) -> Callable:
        """The function, after so many calls of which the time is over."""
        left = [calls]

        def counted(*arguments: object, **named: object) -> object:
            left[0] -= 1
            self.now += 1e9 * (left[0] == 0)
            return function(*arguments, **named)

        return counted


@pytest.mark.sampled(3)
@pytest.mark.filterwarnings("ignore::torchgco.GuidanceWarning")
@pytest.mark.parametrize(
    "name", ["al_ilqr", "ilqr", "mppi", "multistart", "gco", "gco_fast", "gco_max", "interior_point"]
)
def test_a_limit_ends_a_solve_early(name: str) -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    whole = torchgco.solve(problem, U0, name, verbose=False)
    ended = torchgco.solve(problem, U0, name, max_seconds=1e-6, verbose=False)
    assert bool((ended.iterations < whole.iterations).all())
    assert not any(status.name in ("CONVERGED", "INFEASIBLE") for status in ended.statuses)
    assert bool(torch.isfinite(ended.U).all())


@pytest.mark.parametrize("seed", range(3))
def test_ilqr_ends_within_its_only_inner_solve(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It went on to its own limit of iterations; what ends earlier is as it is without a limit."""
    problem, U0 = planar_batch(B=4, N=20, obstacles=2, seed=seed)
    solver = ILQR(tolerance=0.0, max_iterations=30)
    whole = torchgco.solve(problem, U0, solver, verbose=False)
    late = Clock(monkeypatch)
    same = torchgco.solve(problem, U0, solver, max_seconds=1.0, verbose=False)
    assert torch.equal(same.U, whole.U) and torch.equal(same.status, whole.status)
    told = Clock.after(late, 5, lambda call: call.deadline is not None and clock.seconds() >= call.deadline)
    monkeypatch.setattr("torchgco.solvers.contracts.Call.late", property(told))
    ended = torchgco.solve(problem, U0, solver, max_seconds=1.0, verbose=False)
    assert int(ended.iterations.max()) == 4 < int(whole.iterations.min())
    violated = ended.violation > 1e-3
    assert bool(violated.any()) and bool((ended.status[violated] == Status.TIME_LIMIT).all())


def test_a_path_is_sought_only_while_there_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, sought = room(5), []
    late = Clock(monkeypatch)
    track = late.after(2, PathPursuit._track)
    monkeypatch.setattr(PathPursuit, "_track", lambda *given: (sought.append(1), track(*given))[1])
    ended = torchgco.solve(problem, solver="path_pursuit", max_seconds=1.0, verbose=False)
    assert len(sought) == 2 and ended.guided.tolist() == [1, 1, 0, 0, 0]
    assert not any(status.name in ("CONVERGED", "INFEASIBLE") for status in ended.statuses)


def room(B: int) -> Problem:
    """Unicycles that drive around a disc."""
    x0 = torch.zeros(B, 4, dtype=torch.float64)
    x0[:, 1] = torch.linspace(-0.3, 0.3, B)
    cost = torchgco.QuadraticCost([1.0, 1.0, 0.0, 0.0], [0.1, 0.1], [10.0, 10.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0])
    parts = [torchgco.Spheres([[2.0, 0.01]], 0.4, 0.2), torchgco.ControlBounds(-2.0, 2.0)]
    return Problem(torchgco.Unicycle(dt=0.1), cost, parts, x0, 40, torchgco.Goal([4.0, 0.0], 0.3))


@pytest.mark.parametrize("seed", range(3))
def test_starts_that_are_not_tried_any_more_are_a_matter_of_time(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """They were said to have reached a limit of iterations, or to be infeasible."""
    problem, U0 = planar_batch(B=6, N=20, obstacles=4, seed=seed)
    short = presets.multistart(problem)
    short = replace(short, local=replace(short.local, max_outer_iterations=1))
    late = Clock(monkeypatch)
    one = torchgco.solve(problem, U0, replace(short, starts=1), max_seconds=1.0, verbose=False)
    solved = late.after(1, type(short.local).outer_loop)
    monkeypatch.setattr(type(short.local), "outer_loop", solved)
    ended = torchgco.solve(problem, U0, short, max_seconds=1.0, verbose=False)
    assert torch.equal(ended.U, one.U)
    gave_up = (one.status == Status.MAX_ITERATIONS) | (one.status == Status.INFEASIBLE)
    assert bool(gave_up.any()) and torch.equal(ended.status, torch.where(gave_up, int(Status.TIME_LIMIT), one.status))
