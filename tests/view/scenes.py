"""Layouts with obstacles of every kind and two trajectories each, for the page: one around, one straight through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchgco import Boxes, Capsules, FunctionDynamics, Goal, Problem, QuadraticCost, Solution, Spheres
from torchgco.exploration.sensing.grid import FREE, OCCUPIED
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.missions.log import SeenLog
from torchgco.view.document import Document, SearchPart, ShownFlight, flights_of
from torchgco.view.sensed import Sensed
from torchgco.view.vehicles import Look

N, RADIUS, DT = 40, 0.3, 0.1
SOLVERS = ("gco", "al_ilqr")
WORDS = '<img src=x onerror="document.title=1"></script>'  # what no page may run
UNEVEN = 2.0 * (torch.linspace(0, 1, N + 1, dtype=torch.float64) ** 2).numpy()  # s, of the knots of layout 1
GOOD, BAD = "reached", "failed"


def problem(layouts: int = 3) -> Problem:
    """From (0, 0, 0) to (8, 0, 0) past a sphere, a moving one, two boxes, one turned and rounded, and a trunk."""
    x0 = torch.zeros(layouts, 3, dtype=torch.float64)
    goal = torch.tensor([8.0, 0, 0]).double()
    spheres = Spheres(
        [[3.0, 0, 0], [6.0, 2.5, 0], [torch.nan] * 3], [0.8, 0.5, torch.nan], RADIUS,
        velocities=[[0.0, 0, 0], [0, -0.5, 0], [torch.nan] * 3],
    )  # fmt: skip
    boxes = Boxes(
        [[4.5, -2.0, 0], [5.5, -3.0, 0.5]], [[0.5, 0.3, 0.8], [0.4, 0.3, 0.2]], RADIUS,
        rotations=[[1.0, 0, 0, 0], [0.8, 0, 0, 0.6]], radii=[0.0, 0.2],
    )  # fmt: skip
    trunks = Capsules([[2.0, 2.5, -9.0]], [[2.0, 2.5, 9.0]], [0.3], RADIUS)
    return Problem(
        FunctionDynamics(lambda x, u: u, n=3, m=3, dt=DT, position=slice(0, 3)),
        QuadraticCost(Q=[0.0] * 3, R=[1.0] * 3, Qf=[1.0] * 3, x_ref=[8.0, 0, 0]), [spheres, boxes, trunks], x0, N,
        Goal(goal, 1.0),
    )  # fmt: skip


def trajectories(layouts: int = 3) -> dict[str, Tensor]:
    """States (B, N+1, 3) by solver: an arc that ends a little further in every layout, and the straight line."""
    share = torch.linspace(0, 1, N + 1, dtype=torch.float64)
    arc = torch.stack(
        (8 * share, -1.7 * (torch.pi * share).sin() * (1 - share), 1.2 * (torch.pi * share).sin()), dim=-1
    )
    more = torch.arange(layouts, dtype=torch.float64).view(-1, 1, 1) * 0.1 * share.view(1, -1, 1)
    line = torch.stack((8 * share, 0 * share, 0 * share), dim=-1)
    return dict(zip(SOLVERS, (arc + more, line.expand(layouts, -1, -1)), strict=True))


def solution(task: Problem, X: Tensor, U: Tensor | None = None) -> Solution:
    """A solution with these states: velocities are the controls, if no others are given."""
    U = (X[:, 1:] - X[:, :-1]) / DT if U is None else U
    none, K = torch.zeros(len(X), dtype=torch.int64), X.new_zeros(*U.shape, task.n)
    cost = task.cost.total(X, U)
    return Solution(X, U, K, U, Multipliers.zero(task, 1.0), cost, none.double(), none, none, none, none)


def sensed() -> Sensed:
    """What the first trajectory's vehicle may have seen: free cells come behind it, an occupied one comes and goes.

    Its grid has cells of 1 m, from (-1, -4, -2) on. In period k the column x = k / 4 of the middle rows becomes free.
    """
    shape, changes = (10, 8, 4), []
    for k in range(N + 1):
        cells = [(k // 4, y, z) for y in (3, 4) for z in range(4)] if k % 4 == 0 and k < 40 else []
        states = [FREE] * len(cells)
        if k in (10, 30):
            cells, states = [*cells, (5, 6, 1)], [*states, OCCUPIED if k == 10 else FREE]
        flat = np.array([np.ravel_multi_index(cell, shape) for cell in cells], dtype=np.int32)
        changes.append((flat, np.array(states, dtype=np.uint8)))
    path = trajectories(1)[SOLVERS[0]][0].numpy()
    goal = np.array([8.0, 0, 0])
    sought = [np.stack((place, place + 0.5 * (goal - place), goal)) for place in path]
    return Sensed(SeenLog(np.array([-1.0, -4, -2]), shape, 1.0, changes), sought, np.arange(N + 1) % 2 == 0)


def flown_by_a_mission(flight: ShownFlight) -> ShownFlight:
    """A flight with plans, each 2 m on from where the vehicle is along y, and what `sensed` says."""
    ahead = np.stack((np.zeros(9), np.linspace(0, 2, 9), np.zeros(9)), axis=-1)
    return replace(flight, plan=flight.path[:, None] + ahead, sensed=sensed())


def document(layouts: int = 3, search: SearchPart | None = None, mission: bool = False) -> Document:
    """The page's content; the title holds what would run if it were not escaped."""
    task, flown = problem(layouts), []
    for name, X in trajectories(layouts).items():
        U, good = X.new_zeros(layouts, N, 3), name == SOLVERS[0]
        rows = [[("status", WORDS), ("cost", f"{1 + b}")] for b in range(layouts)]
        touching = torch.ones(layouts, dtype=torch.bool).numpy()
        flown.append(flights_of(task, Look(), X, U, name, [GOOD if good else BAD] * layouts, rows, 1e-3, touching))
    held = Document(
        WORDS, "about " + WORDS, 3, DT, Look("quadrotor"), RADIUS, list(SOLVERS),
        ["spheres", WORDS, "trunks"], mission=mission,
    )  # fmt: skip
    if mission:
        flown[0] = [flown_by_a_mission(flight) for flight in flown[0]]
    for b in range(layouts):
        times = UNEVEN if b == 1 and not mission else None
        held.add(f"layout {b} {WORDS}", task, b, [flights[b] for flights in flown], search, times)
    return held
