"""Paths tracked closely and solved by the interior point: where it arrives, what it keeps, and its parts by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import assert_same_bits, planar_batch
from torchgco import (
    ControlBounds,
    Field,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    Restarts,
    Unicycle,
    judge,
    presets,
    solve,
)
from torchgco.dynamics import Dynamics
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.lagrangian.quality import has_arrived
from torchgco.maps import OccupancyGrid
from torchgco.roadmap.clear import clear_path
from torchgco.roadmap.geometry import length, scene_of
from torchgco.roadmap.mapped import in_each
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search import Solve, Tube, solved_candidates, tube
from torchgco.search.following import Free, Paths

D = torch.float64
RADIUS = 0.25
UNICYCLE = Unicycle(dt=0.1)


def room(walls: float = 0.4, B: int = 2, N: int = 110, model: Dynamics = UNICYCLE, radius: float = RADIUS) -> Problem:
    """Rooms beside each other, joined by a door at the far end of a thick wall between start and goal."""
    cells = np.zeros((80, 60), bool)
    cells[[0, -1]], cells[:, [0, -1]] = True, True
    thick = int(walls / 0.1)
    cells[38 : 38 + thick, :46] = True
    start = torch.tensor([[1.5, 1.5, 0.5 * b, 0.0] for b in range(B)], dtype=D)
    cost = QuadraticCost(Q=[0.1, 0.1, 0, 2], R=[0.5, 0.5], Qf=[200, 200, 0, 10], x_ref=[6.3, 1.5, 0, 0])
    rows = [Field(OccupancyGrid(cells, [0.0, 0.0], 0.1), radius), ControlBounds([-2, -1.5], [2, 1.5])]
    return Problem(model, cost, rows, start, N, Goal([6.3, 1.5], 0.3))


def rest(problem: Problem) -> Tensor:
    return problem.x0.new_zeros(problem.B, problem.N, problem.m)


def alone(problem: Problem, row: Tube) -> Restarts:
    """A first solve and this row."""
    return Restarts(presets.gco(problem).local, (Solve(single_contact_after=3), row))


# Whose equations can't be seen: it is tracked in a tube, and not driven.
STEPS = FunctionDynamics(UNICYCLE.step, 4, 2, 0.1, "none", position=slice(0, 2))
MODELS = pytest.mark.parametrize("model", [UNICYCLE, STEPS], ids=["driven", "tracked"])


@pytest.mark.sampled(1)
@MODELS
def test_it_arrives_behind_a_thick_wall_of_a_map(model: Dynamics) -> None:
    problem = room(model=model)
    found = judge(problem, alone(problem, Tube("maps")).solve(problem, rest(problem)).U)
    assert bool((found.clear_95 & (found.goal_distance < 0.3)).all()), "nothing clears the ways between the knots"
    assert bool(judge(problem, solve(problem).U).reached.all())


@pytest.mark.sampled(1)
def test_it_arrives_where_steps_are_longer_than_the_vehicle_is_wide() -> None:
    """Every candidate cuts a corner between two knots by most of the vehicle's width, and can be brought clear."""
    problem = room(N=50, radius=0.01)
    verdict = judge(problem, solve(problem).U)
    assert bool(verdict.reached.all()) and float(verdict.cost.max()) < 210.0


@MODELS
def test_the_cheapest_that_is_feasible_and_arrives_is_kept(monkeypatch, model: Dynamics) -> None:
    problem, ends = room(B=1, model=model), list[tuple[Problem, SolveEnd]]()

    def note(solver, call, X, real=solved_candidates.solved_nearby):
        ends.append((call.problem, real(solver, call, X)))
        return ends[-1][1]

    monkeypatch.setattr(solved_candidates, "solved_nearby", note)
    found = alone(problem, Tube("maps")).solve(problem, rest(problem))
    ((part, end),) = ends
    assert 1 < part.B <= (tube.TOP if model is STEPS else tube.SOLVED_WAYS)
    good = [
        float(end.best.cost[i])
        for i in range(part.B)
        if float(end.best.violation[i]) <= 1e-3 and bool(has_arrived(part, end.best.X)[i])
    ]
    assert len(good) > 1 and float(found.cost[0]) == pytest.approx(min(good) * float(problem.cost_unit[0]), rel=1e-9)


@pytest.mark.sampled(1)
@MODELS
def test_the_result_does_not_depend_on_the_batch(model: Dynamics) -> None:
    problem = room(model=model)
    solver, ids = alone(problem, Tube("maps")), torch.arange(2)
    whole = solver.solve(problem, rest(problem), ids=ids)
    for b in (1, 0):
        rows = torch.tensor([b])
        part = solver.solve(problem.take(rows), rest(problem)[rows], ids=ids[rows])
        assert_same_bits(part, whole.take(rows))


def test_it_works_on_its_own_kind_of_problem_alone() -> None:
    mapped, discs = room(B=1), planar_batch(B=2, N=60, obstacles=8, seed=3)[0]
    for problem, own in ((mapped, "maps"), (discs, "bodies")):
        other = "bodies" if own == "maps" else "maps"
        none = Restarts(presets.gco(problem).local, (Solve(single_contact_after=3),)).solve(problem, rest(problem))
        idle = alone(problem, Tube(other)).solve(problem, rest(problem))
        assert torch.equal(idle.U, none.U) and torch.equal(idle.iterations, none.iterations)
        busy = alone(problem, Tube(own)).solve(problem, rest(problem))
        assert bool((busy.iterations > none.iterations).any())


def test_paces_lie_between_that_without_obstacles_and_the_whole_horizon() -> None:
    bent = torch.tensor([[0.0, 0], [2.0, 2.0 * 3**0.5], [4.0, 0.0]], dtype=D)  # twice as long
    paths = torch.stack((torch.tensor([[0.0, 0], [2, 0], [4, 0]], dtype=D), bent)).unsqueeze(0)
    none = torch.zeros(1, 2, dtype=torch.int64)
    known = Paths(paths, none, none == 0, torch.ones(1, dtype=D), torch.ones(1, dtype=D), None)  # type: ignore[arg-type]

    def shares(share: float) -> list[float]:
        one = torch.ones(1, dtype=D)
        found = Tube()._arrivals(known, Free(one, share * one, one, one.long()))
        return [round(float(x), 9) for x in found]

    quarter = [0.2 + i * 0.8 / 3 for i in range(4)], [0.4 + i * 0.6 / 3 for i in range(4)]
    assert shares(0.2) == [round(x, 9) for part in quarter for x in part]
    latest = [round(0.55 + i * 0.15, 9) for i in range(4)]
    assert shares(0.6) == latest * 2 == shares(float("inf"))


def test_only_a_vehicle_that_can_turn_on_the_spot_is_turned_first() -> None:
    """A unicycle at rest; neither one that moves, nor a car, whose wheels turn nothing at rest, nor thrusters."""
    unicycle = room(B=1)
    starts, usable = tube._starts(unicycle, rest(unicycle))
    assert usable.tolist() == [[True] * 3] and not bool(starts[0, 0].any())
    turned = starts[0, 1:, :, 1]
    assert turned.amax().item() == 0.75 and turned.amin().item() == -0.75
    assert int((turned[0] != 0).sum()) == 11 and not bool(starts[0, 1:, :, 0].any())  # a tenth of 110 stages
    moving = replace(unicycle, x0=unicycle.x0 + torch.tensor([0.0, 0, 0, 1.0], dtype=D))

    def bicycle(x: Tensor, u: Tensor) -> Tensor:
        speed, heading = x[..., 3], x[..., 2]
        turn = speed * u[..., 1].tan() / 2.5
        return torch.stack((speed * heading.cos(), speed * heading.sin(), turn, u[..., 0]), dim=-1)

    car = replace(unicycle, dynamics=FunctionDynamics(bicycle, 4, 2, 0.1, "rk4", position=slice(0, 2)))
    for problem in (moving, car, planar_batch(B=1)[0]):
        assert tube._starts(problem, rest(problem))[1].tolist() == [[True]]
    both = room(B=2)
    both = replace(both, x0=both.x0 + torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, 1.0]], dtype=D))
    assert tube._starts(both, rest(both))[1].tolist() == [[True] * 3, [True, False, False]]


def test_one_path_keeps_clear_of_the_map() -> None:
    problem = room(B=1)
    scene = scene_of(problem.in_cost_units(), rest(problem))
    assert scene is not None
    taut, there = Roadmap().paths(scene)
    clear, found = in_each(scene, 1, 0.0, clear_path)
    assert bool(there) and bool(found) and clear.shape == taut.shape
    torch.testing.assert_close(clear[0, 0, [0, -1]], torch.stack((scene.start[0], scene.goal[0])))
    field = problem.geometric[0]
    share = torch.linspace(0, 1, 20, dtype=D).view(-1, 1, 1)

    def nearest(path: Tensor) -> float:
        inner = path[(path - scene.start[0]).norm(dim=-1) > 0.5]
        points = (inner[:-1] + share * inner.diff(dim=0)).reshape(1, -1, 2)
        points = points[:, (points[0] - scene.goal[0]).norm(dim=-1) > 0.5]
        return float(field.signed_distance(points, points.new_zeros(1)).min())  # type: ignore[union-attr]

    assert nearest(clear[0, 0]) > nearest(taut[0, 0]) + 0.05
    assert 1.0 < float(length(clear[:, 0]) / length(taut[:, 0])) < 1.4


@MODELS
def test_candidates_are_told_in_the_record(model: Dynamics) -> None:
    problem = room(B=1, model=model)
    found = solve(problem, record=True)
    assert found.search is not None
    number = 1 + presets.gco(problem).passes.names.index("maps")
    one = next(one for one in found.search.comparisons if one.number == number)
    assert int(torch.isfinite(one.cost).sum()) > 1 and f"{number} maps" in found.explain(0)
