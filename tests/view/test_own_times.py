"""Trajectories of several solvers in free time: each plays by its own times, along the path that is judged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tests.view.browser import Tab
from tests.view.test_packing import part
from torchgco import FreeTime, FunctionCost, FunctionDynamics, Goal, Problem, Spheres
from torchgco.experiments.results.durations import states_of
from torchgco.problem.times import curves
from torchgco.view.document import Document, flights_of
from torchgco.view.page import page
from torchgco.view.vehicles import Look

N, LAST = 8, (2.0, 4.0)


def document() -> tuple[Document, list[torch.Tensor], Problem]:
    """A mass that is pushed aside, by the same controls in 2 s and in 4 s, among a disc that moves."""
    field = lambda x, u: torch.cat((x[..., 2:], u), -1)
    model = FunctionDynamics(field, 4, 2, 0.1, "rk4", position=slice(0, 2))
    cost = FunctionCost(lambda x, u: 0.1 * u.square().sum(-1), lambda x: x[..., 0].square())
    disc = Spheres([[3.0, -3.0]], [0.5], 0.1, velocities=[[0.0, 0.5]])
    goal = Goal([4.0, 0.0], 0.2, required=True)
    problem = Problem(model, cost, [disc], [[0.0, 0.0, 1.0, 0.0]], N, goal, time=FreeTime(1.0, 6.0))
    U = torch.tensor([[0.0, 1.0]]).double().expand(1, N, 2).contiguous()
    look, flown, states = Look("ball"), [], []
    made = Document.of(problem, title="page", about="", dt=0.1, look=look, solvers=["fast", "slow"])
    for name, last in zip(made.solvers, LAST, strict=True):
        t = torch.linspace(0.0, last, N + 1).double().unsqueeze(0)
        X = states_of(problem, U, t)
        told = name, ["reached"], [[]], 1e-3, np.array([False])
        flown += flights_of(problem, look, X, U, *told, t)
        (fine,) = curves(problem, X, U, t)
        states.append(fine.X[0, :, :2])
    made.add("layout 0", problem, 0, flown)
    return made, states, problem


def test_flights_have_their_own_times_and_the_path_between_knots() -> None:
    made, states, _ = document()
    layout = part(page(made), "part-0")
    for flight, last, fine in zip(layout["flights"], LAST, states, strict=True):
        np.testing.assert_allclose(flight["times"], np.linspace(0.0, last, N + 1), atol=2e-3)
        assert flight["pieces"] > 1 and len(flight["path"]) == N + 1
        np.testing.assert_allclose(flight["way"], fine, atol=2e-3)
        chord = 0.5 * (fine[0] + fine[flight["pieces"]])
        assert float((fine[flight["pieces"] // 2] - chord).norm()) > 1e-3  # which was drawn


def test_the_page_plays_each_by_its_own_times(chromium: Callable[[], Tab], tmp_path: Path) -> None:
    """All were played at the times of the first: the slow one arrived with the fast one."""
    made, _, _ = document()
    (tmp_path / "view.html").write_text(page(made))
    tab = chromium()
    tab.open(tmp_path / "view.html")
    assert "of 4.00 s" in tab.evaluate("document.getElementById('clock').textContent")
    for t in (1.0, 1.87, 3.1):
        tab.evaluate(f"torchgcoView.setTime({t})")
        seen = tab.evaluate("torchgcoView.flights.all.map(({ body }) => [body.position.x, body.position.y])")
        due = [[s, 0.5 * s * s] for s in (min(t, last) for last in LAST)]  # by hand
        np.testing.assert_allclose(seen, due, atol=5e-3)
        assert tab.evaluate(f"torchgcoView.flights.clocks({t}).times") == [t]
    assert tab.errors == []
