"""Ways through space and time where obstacles move: they arrive where a solve from the guess alone waits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from torchgco import (
    Boxes,
    ControlBounds,
    FunctionDynamics,
    Goal,
    NormBounds,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    Restarts,
    Solution,
    Spheres,
    StateBounds,
    judge,
    presets,
    solve,
)
from torchgco.base.errors import HorizonWarning
from torchgco.dynamics.planar import Unicycle
from torchgco.kernels import path_clearance
from torchgco.problem.times import bulge
from torchgco.roadmap.timed import library_for
from torchgco.search.timed_scenes import MOVES, STATES, Velocity, can_search, scene_in_time

D, INF = torch.float64, float("inf")
GCO = presets.gco(2)
WITHOUT = replace(GCO, passes=GCO.passes.changed(timed=None))


def solved(problem: Problem, solver: Restarts | None = None, **options: Any) -> Solution:
    return solve(problem, solver=solver or GCO, verbose=False, **options)


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def point(dt: float = 0.2) -> FunctionDynamics:
    return FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, dt, "rk4", slice(0, 2))


def cost(goal: list[float]) -> QuadraticCost:
    return QuadraticCost([0.2, 0.2, 0.02, 0.02], [0.02, 0.02], [50.0, 50, 5, 5], x_ref=goal)


def traffic(seed: int, B: int = 3, lanes: int = 4) -> Problem:
    """Lanes of discs that drive across the way at random speeds, with random gaps."""
    rows = []
    for b in range(B):
        rng, discs = np.random.default_rng((seed, b)), []
        for x in np.linspace(2, 2 + 1.6 * (lanes - 1), lanes):
            speed, side, radius = rng.uniform(0.5, 1.5), rng.choice([-1.0, 1.0]), rng.uniform(0.4, 0.55)
            gap = 2 * (radius + 0.2) + rng.uniform(0.5, 1.0)
            first, count = rng.uniform(0, gap), 16
            discs += [(x, side * (3 - first - j * gap), radius, side * speed) for j in range(count)]
        rows.append(discs)
    x, y, radius, speed = np.moveaxis(np.array(rows), -1, 0)
    end = 3.6 + 1.6 * (lanes - 1)
    moving = Spheres(np.stack((x, y), -1), radius, 0.2, np.stack((0 * speed, speed), -1))
    rows = [moving, ControlBounds(-2.0, 2.0), StateBounds([-1, -2, -INF, -INF], [end + 1, 2, INF, INF]),
            NormBounds(("x", [2, 3]), upper=2.5)]  # fmt: skip
    return Problem(point(), cost([end, 0, 0, 0]), rows, torch.zeros(B, 4, dtype=D), 50, Goal([end, 0.0], 0.3))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ContactWarning")  # of the solver without the row
def test_lanes_of_traffic_are_crossed_and_the_same_alone() -> None:
    problem = traffic(2)
    solution, before = solved(problem), judge(problem, solved(problem, WITHOUT).U)
    verdict = judge(problem, solution.U)
    assert verdict.reached.all(), solution.statuses
    assert not before.reached.all(), "or the test shows nothing"
    both = verdict.reached & before.reached
    assert (verdict.cost[both] <= 1.001 * before.cost[both]).all(), "what has arrived is not made dearer"
    assert (verdict.cost[both] < 0.6 * before.cost[both]).all(), "from the guess it waits for all lanes to be empty"
    one = torch.tensor([2])
    alone = solved(problem.take(one), ids=one)
    assert torch.equal(alone.U, solution.U[one]) and torch.equal(alone.iterations, solution.iterations[one])


@pytest.mark.slow
def test_where_there_is_no_way_the_status_says_so() -> None:
    """A row of discs without gaps that drives across: nothing passes it before the end."""
    y = np.arange(-12, 12, 0.5)
    discs = Spheres(np.stack((0 * y + 2, y), -1), 0 * y + 0.3, 0.2, np.stack((0 * y, 0 * y + 0.5), -1))
    bounds = [ControlBounds(-2.0, 2.0), StateBounds([-1, -2, -INF, -INF], [5, 2, INF, INF])]
    problem = Problem(
        point(), cost([4, 0, 0, 0]), [discs, *bounds], torch.zeros(1, 4, dtype=D), 25, Goal([4.0, 0.0], 0.3)
    )
    solution = solved(problem)
    verdict = judge(problem, solution.U)
    assert not verdict.reached.any()
    assert verdict.feasible.all(), "it waits"
    assert solution.statuses[0].name in ("CONVERGED", "FEASIBLE")


@pytest.mark.slow
def test_a_leaf_that_slides_is_passed_while_it_is_open_clear_between_knots_too() -> None:
    c, half = [[2.0, -1.65], [2.0, 1.65], [2.0, 0.6]], [[0.1, 1.35], [0.1, 1.35], [0.12, 0.3]]
    zero = np.zeros((3, 1, 2))
    amplitude, rate = zero.copy(), zero.copy()
    amplitude[2, 0, 1], rate[2, 0, 1] = 0.6, 1.5
    leaf = OscillatingBoxes(Boxes(c, half, 0.15), amplitude, rate, zero - 0.5 * np.pi)
    rows = [leaf, ControlBounds(-2.0, 2.0), StateBounds([-1, -2.5, -INF, -INF], [5, 2.5, INF, INF])]
    problem = Problem(point(0.1), cost([4, 0, 0, 0]), rows, torch.zeros(1, 4, dtype=D), 60, Goal([4.0, 0.0], 0.3))
    solution = solved(problem)
    assert judge(problem, solution.U).reached.all()
    assert (path_clearance(problem, solution.X, solution.U) >= 0).all()


def test_a_swinging_box_is_measured_where_the_vehicle_is() -> None:
    """How far a trajectory leaves its chords is the vehicle's, whatever the obstacles are: as a resting box says."""
    box = Boxes([[2.0, 1.0]], [[0.3, 0.3]], 0.1)
    swings = OscillatingBoxes(box, [[[0.2, 0.0]]], [[[1.0, 0]]], [[[0.0, 0]]])
    X = torch.randn(2, 11, 4, dtype=D, generator=torch.Generator().manual_seed(0))
    U = torch.ones(2, 10, 2, dtype=D)
    due, got = (
        bulge(Problem(point(), cost([4, 0, 0, 0]), [part], X[:, 0], 10, Goal([4.0, 0.0], 0.3)), X, U)
        for part in (box, swings)
    )
    assert torch.equal(got, due) and (due > 0).all()


def test_a_unicycle_crosses_lanes_too() -> None:
    problem = traffic(7, B=2, lanes=2)
    bounds = [ControlBounds([-1.5, -2.0], [1.5, 2.0]), StateBounds([-1, -2, -INF, -0.5], [6, 2, INF, 1.5])]
    goal = QuadraticCost([0.2, 0.2, 0, 0.02], [0.02, 0.02], [50.0, 50, 0, 5], x_ref=[5.2, 0, 0, 0])
    rows = [problem.constraints[0], *bounds]
    drives = Problem(Unicycle(dt=0.2), goal, rows, problem.x0, 40, Goal([5.2, 0.0], 0.3))
    assert can_search(drives)
    assert judge(drives, solved(drives).U).reached.all()


def test_velocities_are_read_from_the_equations() -> None:
    problem = traffic(5, B=1)
    velocity = Velocity.of(problem)
    assert velocity.places == (2, 3) and not velocity.by_heading
    v = np.array([[1.0, -0.5], [0.0, 3.0]])
    states = velocity.states(v)
    assert states[:, 2:].tolist() == v.tolist()
    assert velocity.admitted(v).tolist() == [True, False]
    moving, last = velocity.cost_of(v, 5.0)
    assert np.allclose(moving, 5 * 0.5 * 0.02 * (v**2).sum(1)) and np.allclose(last, 0.5 * 5 * (v**2).sum(1))
    assert np.allclose(velocity.cost_of_change(2.0, 5.0), 5 * 0.5 * 0.02 * 4.0)
    rows = [problem.constraints[0]]
    drives = Problem(Unicycle(dt=0.2), QuadraticCost([1, 1, 0, 1], [1, 1], [1, 1, 0, 1]), rows, problem.x0, 30)
    velocity = Velocity.of(drives)
    assert velocity.by_heading and velocity.places == (2, 3)
    assert np.allclose(velocity.states(np.array([[0.0, 2.0]]))[0, 2:], [0.5 * np.pi, 2.0])


def test_a_problem_whose_obstacles_are_all_absent_loses_nothing() -> None:
    """Its goal is out of reach, so that it would be searched."""
    nan = torch.nan
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 3:], u), -1), 6, 3, 0.1, "rk4", slice(0, 3))
    cost = QuadraticCost([0.1] * 6, [0.01] * 3, [50.0] * 6, x_ref=[40.0, 0, 0, 0, 0, 0])
    spheres = Spheres([[[nan] * 3], [[5.0, 0, 0]]], [[nan], [0.5]], 0.3, [[0.0, 1.0, 0.0]])
    parts = [spheres, ControlBounds(-5.0, 5.0), StateBounds([-1e4] * 3 + [-3.0] * 3, [1e4] * 3 + [3.0] * 3)]
    problem = Problem(model, cost, parts, torch.zeros(2, 6).double(), 50, Goal([40.0, 0, 0], 0.3))
    with pytest.warns(HorizonWarning):
        solution = solve(problem, verbose=False)
    assert bool(judge(problem, solution.U).feasible.all())


@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ScaleWarning")
@pytest.mark.parametrize("scale", [1e-4, 1e-2, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("fast", [1.0, 18.0])
def test_lattices_have_few_moves_and_states_at_any_scale(scale: float, fast: float) -> None:
    """A ball of 0.3 m that flies 500 m in 5 s at up to 90 m/s, and slower ones, in other units of length."""
    B, rng = 3, np.random.default_rng(7)
    way, speed = scale * fast * 28.0, scale * fast * 5.0
    model = point(0.1)
    discs = Spheres(
        scale * rng.uniform(0, 20, (B, 12, 2)), 0.5 * scale, 0.3 * scale, scale * rng.normal(0, 3, (B, 12, 2))
    )
    rows = [discs, ControlBounds(-8.0 * scale * fast, 8.0 * scale * fast), NormBounds(("x", [2, 3]), upper=speed)]
    goal = QuadraticCost([0.1] * 4, [0.01] * 2, [10.0] * 4, x_ref=[way, 0.0, 0.0, 0.0])
    problem = Problem(model, goal, rows, torch.zeros(B, 4, dtype=D), 50, Goal([way, 0.0], 0.3 * scale))
    t = torch.linspace(0, 1, 51, dtype=D).unsqueeze(-1)
    free = torch.cat((t * torch.tensor([way, 0.0]), torch.ones_like(t) * torch.tensor([speed, 0.0])), dim=-1)
    for b in range(B):
        lattice = scene_in_time(problem.take(torch.tensor([b])), free).lattice
        assert len(lattice.velocities) <= MOVES and lattice.states <= STATES
        assert lattice.velocities[:, 0].max() >= 0.7 * speed and lattice.spacing >= 0.3 * scale * 0.999
        assert np.all(lattice.points.min(0) <= 0.0) and lattice.points[:, 0].max() >= way - lattice.spacing


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", range(3))
def test_a_default_of_double_precision_changes_nothing(seed: int) -> None:
    """C reads clearances and costs of ways in single precision: in double, the first search ended the solve."""
    found, default = solved(traffic(seed, B=2)), torch.get_default_dtype()
    torch.set_default_dtype(D)
    try:
        again = solved(traffic(seed, B=2))
    finally:
        torch.set_default_dtype(default)
    assert torch.equal(found.U, again.U) and torch.equal(found.status, again.status)
