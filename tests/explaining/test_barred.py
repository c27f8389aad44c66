"""What a map says of a goal that no path reaches, and of a start in unknown cells."""

import heapq
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchgco
from tests.slow import mostly
from torchgco import (
    Body,
    ControlBounds,
    Field,
    Goal,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    StateBounds,
    Status,
    Unicycle,
    presets,
)
from torchgco.base.errors import HorizonWarning
from torchgco.maps import DistanceField
from torchgco.maps.passage import widest_passage
from torchgco.search import Solve

RESOLUTION = 0.05
Node = tuple[int, ...]


def room(door: int = 8) -> np.ndarray:
    """10 m by 6 m behind walls, with a wall across that has a door of so many cells."""
    held = np.zeros((200, 120), np.float32)
    held[0] = held[-1] = held[:, 0] = held[:, -1] = held[100:102] = 1
    held[100:102, 60 - door // 2 : 60 + (door + 1) // 2] = 0
    return held


def problem(cells: np.ndarray, radius: float, goal: tuple[float, float] = (8.0, 3.0)) -> Problem:
    cost = QuadraticCost([1, 1, 0, 2], [0.5, 0.5], [200, 200, 0, 10], [*goal, 0, 0])
    parts = [Field(OccupancyGrid(cells, [0, 0], RESOLUTION), radius), ControlBounds([-2, -1.5], [2, 1.5])]
    x0 = torch.tensor([[2.0, 3.0, 0, 0]]).double()
    return Problem(Unicycle(dt=0.1), cost, parts, x0, 80, Goal(list(goal), 0.3))


def told(task: Problem) -> str:
    return " ".join(torchgco.solve(task, solver="hold").explain(0).split())


def test_a_door_that_is_too_narrow_is_named_with_the_radius_that_passes() -> None:
    text = told(problem(room(), 0.3))
    no_way = "No way through the map leads a vehicle of radius 0.3 m to the goal: the widest has room for 0.2 m."
    assert no_way in text and "a vehicle_radius of at most 0.2 m" in text and "longer horizon" not in text
    for radius in (0.2, 0.19):
        assert "No way" not in told(problem(room(), radius)), "this vehicle passes"


def test_a_goal_that_no_vehicle_reaches_is_told_apart() -> None:
    text = told(problem(room(), 0.3, (50.0, 0.5)))
    assert "none of any radius" in text and "vehicle_radius of at most" not in text
    open_room = room()
    open_room[-1, 40:60] = 0
    assert "has room for 0.2 m" in told(problem(open_room, 0.3, (50.0, 0.5))), "through both doors, then outside"
    assert "another guess" not in Status.INFEASIBLE.sentence.lower()


def test_a_start_in_unknown_cells_is_no_start_in_a_wall() -> None:
    unknown, wall = room(), room()
    unknown[30:50, 50:70], wall[30:50, 50:70] = np.nan, 1
    for cells, named in ((unknown, True), (wall, False)):
        task = problem(cells, 0.15)
        solution = torchgco.solve(task, solver="hold")
        assert solution.statuses == [Status.INVALID_START]
        assert ("scenario.unknown=free" in " ".join(solution.explain(0).split())) == named


def bottleneck(values: np.ndarray, starts: list[Node], goals: list[Node]) -> float:
    """The widest way by a plain search from node to node, which takes the clearest node next."""
    best, heap = dict[Node, float](), [(-float(values[node]), node) for node in starts]
    heapq.heapify(heap)
    while heap:
        width, node = heapq.heappop(heap)
        if node in best:
            continue
        best[node] = -width
        for step in np.ndindex(*([3] * values.ndim)):
            other = tuple(a + b - 1 for a, b in zip(node, step, strict=True))
            if other not in best and all(0 <= a < n for a, n in zip(other, values.shape, strict=True)):
                heapq.heappush(heap, (max(width, -float(values[other])), other))
    return max(best[goal] for goal in goals)


def beside(node: Node, shape: tuple[int, ...]) -> list[Node]:
    """A node and its neighbours along the axes: the vehicle may begin and end within a node's distance."""
    around = [
        node,
        *(tuple(np.add(node, sign * row).tolist()) for row in np.eye(len(node), dtype=int) for sign in (1, -1)),
    ]
    return [one for one in around if all(0 <= a < n for a, n in zip(one, shape, strict=True))]


@pytest.mark.parametrize("shape", mostly([(10, 10), (3, 2, 2)], (3, 2, 2)))
def test_the_widest_way_is_that_of_a_plain_search(shape: tuple[int, ...]) -> None:
    rng, found = np.random.default_rng(1), []
    for _ in range(12):
        cells = rng.random(shape) < 0.35
        for axis in range(len(shape)):
            cells = cells.repeat(3, axis)
        field = DistanceField.of(OccupancyGrid(cells, [0.0] * len(shape), 0.1).enclosed(), refine=1)
        values = field.values[0]
        free = np.argwhere(values > 0)
        start, goal = (tuple(free[j].tolist()) for j in rng.integers(len(free), size=2))
        ends = (field.origin[0] + field.spacing * np.array(node) for node in (start, goal))
        found.append(widest_passage(field, 0, *ends, 1e-9, 10.0))
        wide = bottleneck(values, *(beside(node, values.shape) for node in (start, goal)))
        assert found[-1] == pytest.approx(max(wide, 0.0), abs=1e-6)
    assert len(set(found)) > 1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", range(3))
def test_a_place_off_a_map_that_is_occupied_all_around_is_named(seed: int) -> None:
    """On any side, of the start or the goal; not where the outside is free, nor a place on the map."""
    rng = np.random.default_rng(seed)
    axis, side = int(rng.integers(2)), int(rng.integers(2))
    place = rng.uniform([1.0, 1.0], [9.0, 5.0])
    place[axis] = (10.0, 6.0)[axis] + rng.uniform(0.5, 30.0) if side else -rng.uniform(0.5, 30.0)
    off, open_room = (float(place[0]), float(place[1])), np.zeros((200, 120), bool)
    closed = np.pad(open_room[1:-1, 1:-1], 1, constant_values=True)
    text = told(problem(closed, 0.2, off))
    assert "The goal lies outside of the map, which is occupied all around" in text
    assert 'outside="free"' in text and "scenario.outside=free" in text and "horizon" not in text
    turned = problem(closed, 0.2, (2.0, 3.0))
    x0 = turned.x0.clone()
    x0[0, :2] = torch.tensor(off)
    moved = Problem(turned.dynamics, turned.cost, list(turned.constraints), x0, 80, turned.goal)
    assert "The start lies outside" in told(moved)
    for cells, goal in ((open_room, off), (room(), (8.0, 3.0))):
        assert "outside" not in told(problem(cells, 0.3, goal))


@pytest.mark.slow
@pytest.mark.parametrize("speed", mostly([0.5, 1.0, 3.0], 0.5, 3.0))
def test_a_longer_horizon_is_advised_only_where_the_way_asks_for_it(speed: float) -> None:
    """A vehicle that stays where it is, square to a way around a wall: about 8 m, where 6 are straight."""
    cells = room()
    cells[100:102, :108], cells[100:102, 108:119] = 1, 0
    limits = [torch.inf] * 3
    bounds = StateBounds([-x for x in limits] + [-speed], [*limits, speed])
    held = problem(cells, 0.2)
    x0 = torch.tensor([[2.0, 3.0, 0.5 * torch.pi, 0.0]]).double()
    still = replace(presets.gco(2), passes=[Solve()])
    body = Body([[0.2, 0.0], [-0.2, 0.0]], 0.2)
    for radius in (0.2, body):
        parts = [Field(OccupancyGrid(cells, [0, 0], RESOLUTION), radius), *held.constraints[1:], bounds]
        for times, said in ((0.3, "short"), (0.9, "short"), (2.5, "enough")):
            task = Problem(held.dynamics, held.cost, parts, x0, round(times * 8.0 / speed / 0.1), held.goal)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", HorizonWarning)
                text = " ".join(torchgco.solve(task, solver=still).explain(0).split())
            assert "goal not reached" in text
            assert ("A longer horizon: the way to the goal is" in text) == (said == "short")
            assert ("though the horizon suffices for the way" in text) == (said == "enough")
            assert "A longer horizon N" not in text


def test_a_body_whose_inside_fits_through_no_way_is_told() -> None:
    held = problem(room(), 0.3)
    body = Body([[0.25, 0.0], [-0.25, 0.0]], 0.35)
    field = Field(OccupancyGrid(room(), [0, 0], RESOLUTION), body)
    text = told(Problem(held.dynamics, held.cost, [field, held.constraints[1]], held.x0, 80, held.goal))
    assert f"leads the ball inside the body, of radius {body.inscribed_radius:.3g} m to the goal" in text
    assert "a narrower body" in text and "vehicle_radius" not in text


@pytest.mark.parametrize("broken", [(0, np.nan), (1, np.inf), (1, -np.inf), (2, np.nan)])
def test_a_start_that_is_no_place_is_told(broken: tuple[int, float]) -> None:
    """The explanation was an error of NumPy."""
    task = problem(room(), 0.2)
    starts = task.x0.clone()
    starts[0, broken[0]] = broken[1]
    assert "NON_FINITE" in told(replace(task, x0=starts))
