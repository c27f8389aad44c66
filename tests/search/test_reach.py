"""Horizons that are too short for the way to the goal, said before the solve."""

import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    Field,
    FunctionDynamics,
    Goal,
    HorizonWarning,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    RateBounds,
    StateBounds,
    Status,
    Unicycle,
)
from torchgco.dynamics import Dynamics
from torchgco.search.reach import limit_of, short_horizons

FREE = float("inf")
POINT = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, "euler", slice(0, 2))
SPEED = ControlBounds([-1.0, 0.0], [1.0, 0.0])  # along x alone


def task(model: Dynamics, parts: list, N: int, x0: list[list[float]], goal: Goal | None) -> Problem:
    n = model.n
    cost = QuadraticCost([1.0] * n, [1.0] * 2, [1.0] * n, [8.0, 1.0, *[0.0] * (n - 2)])
    start = torch.tensor(x0, dtype=torch.float64)
    return Problem(model, cost, parts, start, N, goal)


def test_the_number_of_stages_that_would_do_is_named() -> None:
    starts = [[2.0, 1.0], [7.0, 1.0]]
    for N, count in ((56, 1), (57, 0)):  # 5.7 m to the edge of the goal, 0.1 m a stage
        said = short_horizons(task(POINT, [SPEED], N, starts, Goal([8.0, 1.0], 0.3)))
        assert (said is not None) == bool(count)
        assert said is None or (said.startswith("1 of 2 horizons") and "N = 57 would do" in said and "6 m long" in said)


@pytest.mark.parametrize("bounds", [(0.0, 0.0), (1e-12, 0.0)])
@pytest.mark.parametrize("far", [0.0, 1e160, 1e308])
def test_a_vehicle_that_cannot_move_and_one_too_far_away_lose_no_other(bounds: tuple[float, float], far: float) -> None:
    """No number of stages serves the first, and the way of the second overflows."""
    problem = task(POINT, [ControlBounds([0.0, 0.0], bounds)], 20, [[far, 0.0], [0.0, 0.0]], Goal([8.0, 1.0], 0.3))
    still = bounds == (0.0, 0.0)
    with pytest.warns(HorizonWarning, match="no horizon would do" if still else "N = .* would do"):
        found = torchgco.solve(problem)
    assert found.statuses[1] in (Status.CONVERGED, Status.FEASIBLE) and float(found.cost[1]) < 1e4
    assert (found.statuses[0] is Status.NON_FINITE) == (far > 0.0)


class Stepped(Dynamics):
    """A model that has a whole step alone."""

    n, m, dt, position = 4, 2, 0.1, slice(0, 2)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., :2] + 0.1 * x[..., 2:] + 0.005 * u, x[..., 2:] + 0.1 * u), dim=-1)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("more", [[], [RateBounds(-1.0, 1.0)]])
def test_a_model_with_a_step_alone_and_bounded_rates_are_looked_at(more: list) -> None:
    """A step may begin at 1 m/s along x and along y, and end at 1.1 m/s: it is 1.05 times as long."""
    held = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
    parts = [ControlBounds(-1.0, 1.0), StateBounds([-99.0, -99.0, -1.0, -1.0], [99.0, 99.0, 1.0, 1.0]), *more]
    for model, stages in ((held, 41), (Stepped(), 39)):
        problem = task(model, parts, 20, [[2.0, 1.0, 0.0, 0.0]], Goal([8.0, 1.0], 0.3))
        with pytest.warns(HorizonWarning, match=f"N = {stages} "):
            assert torchgco.solve(problem).statuses == [Status.CONVERGED]


def test_it_is_said_among_tangents_of_many_directions() -> None:
    """The vmap of PyTorch's `jacobian` refuses to draw the samples, though they have a seed of their own."""
    said = []

    def solved(x0: Tensor) -> Tensor:
        said.append(short_horizons(task(POINT, [SPEED], 56, [[2.0, 1.0]], Goal([8.0, 1.0], 0.3))))
        return 2.0 * x0

    slopes = torch.autograd.functional.jacobian(solved, torch.ones(2), vectorize=True, strategy="forward-mode")
    assert "N = 57 would do" in said[0] and torch.equal(torch.as_tensor(slopes), 2.0 * torch.eye(2))


def test_through_a_map_the_way_is_the_roadmaps() -> None:
    cells = np.zeros((100, 100), bool)
    cells[50:52, :90] = True
    field = Field(OccupancyGrid(cells, [0, 0], 0.1).enclosed(), 0.3)
    both = ControlBounds([-0.7, -0.7], [0.7, 0.7])  # 0.99 m/s along a diagonal
    problem = task(POINT, [field, both], 100, [[2.0, 1.0]], Goal([8.0, 1.0], 0.3))
    detour = 2 * np.hypot(3.0, 8.4)  # past the end of the wall, at 0.3 m from it
    said = short_horizons(problem)
    assert said is not None and short_horizons(task(POINT, [field, both], 190, [[2.0, 1.0]], problem.goal)) is None
    length = float(said.split("first is ")[1].split(" m")[0])
    assert detour <= length < 1.1 * detour
    with pytest.warns(HorizonWarning, match="N = "):
        solution = torchgco.solve(problem, solver="hold")
    with warnings.catch_warnings():
        warnings.simplefilter("error", HorizonWarning)
        torchgco.solve(problem, solver="hold", warm=solution)  # the horizon of an MPC ends before the goal
        torchgco.solve(task(POINT, [both], 10, [[2.0, 1.0]], None), solver="hold")  # a goal that nobody stated


def test_a_longest_step_inside_the_bounds_is_climbed_to() -> None:
    """A tricycle drives the farthest with its front wheel straight, which is no corner of its bounds."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        heading, speed, steering = x[..., 2], x[..., 3], x[..., 4]
        ahead = speed * steering.cos()
        turning = torch.stack((ahead * heading.cos(), ahead * heading.sin(), speed * steering.sin()), -1)
        return torch.cat((turning, u), -1)

    model = FunctionDynamics(field, 5, 2, 0.1, "euler", slice(0, 2))
    bounds = StateBounds([-FREE, -FREE, -FREE, -1.0, -0.9], [FREE, FREE, FREE, 3.0, 0.5])
    goal = Goal([10.0, 0.0], 0.05)
    for N, fits in ((34, True), (33, False)):  # 9.95 m, 0.3 m a stage
        problem = task(model, [bounds], N, [[0.0] * 5], goal)
        assert float(limit_of(problem)[0][0]) < 0.2999  # type: ignore
        said = short_horizons(problem)
        assert (said is None) == fits and (said is None or "N = 34 would do" in said)


def test_a_limit_is_seen_where_there_is_one_alone() -> None:
    def longest(model: Dynamics, parts: list) -> float | None:
        found = limit_of(task(model, parts, 5, [[0.0] * model.n], None))
        return float(found.step[0]) if found is not None and bool(found.step.isfinite().all()) else None

    turns = ControlBounds([-2.0, -1.5], [2.0, 1.5])
    speeds = StateBounds([-FREE, -FREE, -FREE, -1.0], [FREE, FREE, FREE, 1.5])
    assert longest(Unicycle(dt=0.1), [turns]) is None, "it may go on accelerating"
    assert longest(Unicycle(dt=0.1), [speeds]) == pytest.approx(0.15), "whatever its heading"
    assert longest(POINT, [SPEED]) == pytest.approx(0.1) and longest(POINT, []) is None
    jump = FunctionDynamics(lambda x, u: x + 0.2 * u, 2, 2, 0.1, "none", slice(0, 2))
    assert longest(jump, [SPEED]) == pytest.approx(0.2), "of a step without a field"
    flow = FunctionDynamics(lambda x, u: u + x[..., :1] * 0.5, 2, 2, 0.1, "euler", slice(0, 2))
    assert longest(flow, [SPEED]) is None, "a flow that grows with the place"


def pushed(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u), -1)


def dragged(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u - 10.0 * x[..., 2:]), -1)


def blown(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u + 0.1 * x[..., 2:]), -1)


def test_where_acceleration_alone_is_limited_the_least_time_counts() -> None:
    """A double integrator covers 0.5 a t^2 from rest; from rest to rest the way takes 2 sqrt(way / a)."""
    model = FunctionDynamics(pushed, 4, 2, 0.1, "rk4", slice(0, 2))
    along, goal = ControlBounds([-2.0, 0.0], [2.0, 0.0]), Goal([8.0, 1.0], 0.25)
    starts = [[1.75, 1.0, 0.0, 0.0], [1.75, 1.0, 3.0, 0.0]]  # 6 m to the edge of the goal; one of them moves
    for N, who in ((24, [0]), (25, []), (13, [0, 1]), (14, [0])):  # 24.5 stages from rest; 3 t + t^2 = 6 at 1.37 s
        said = short_horizons(task(model, [along], N, starts, goal))
        assert (said is None) == (not who)
        if said is not None:
            assert said.startswith(f"{len(who)} of 2 horizons") and f"problem {', '.join(map(str, who))})" in said
            assert "from rest to rest it takes N = 35 at full acceleration" in said  # 2 sqrt(3) s
    both = ControlBounds([-2.0, -2.0], [2.0, 2.0])
    assert float(limit_of(task(model, [both], 9, starts, None)).push[0]) == pytest.approx(8**0.5, rel=1e-6)  # type: ignore


def test_what_limits_the_acceleration_is_seen_in_the_equations() -> None:
    def strongest(model: Dynamics, parts: list, climbs: int = 40) -> float | None:
        found = limit_of(task(model, parts, 5, [[0.0] * model.n], None), climbs)
        return float(found.push[0]) if found is not None and bool(found.push.isfinite().all()) else None

    bounds = ControlBounds([-2.0, -1.5], [2.0, 1.5])
    drag, wind, free = (FunctionDynamics(f, 4, 2, 0.1, "rk4", slice(0, 2)) for f in (dragged, blown, pushed))
    assert strongest(Unicycle(dt=0.1), [bounds]) == pytest.approx(2.0), "whatever its heading and speed"
    assert strongest(drag, [bounds]) == pytest.approx(2.5, rel=0.02), "where it stands"
    assert strongest(wind, [bounds]) is None, "which grows with the speed"
    assert strongest(free, []) is None and strongest(POINT, [SPEED]) is None
