"""Paths through the free space of maps: walls, rooms with doors, spirals, floors; their classes and their lengths."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference.blocks import everywhere, plain_blocks
from tests.slow import mostly
from torchgco import (
    Boxes,
    Constraint,
    Field,
    Goal,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Roadmap,
    Spheres,
    presets,
)
from torchgco.maps import DistanceField, OccupancyGrid
from torchgco.maps.field import BoundField
from torchgco.native.compiler import NativeError
from torchgco.obstacles.base import Obstacles, Solids
from torchgco.roadmap.geometry import Inflated, has_paths, length, scene_of
from torchgco.roadmap.homotopy import classes
from torchgco.roadmap.lattice import blocks_of, lattice_of
from torchgco.roadmap.mapped import Ways, _swept_on_the_way, keys, swept, tightened
from torchgco.roadmap.shortest import shortest_way
from torchgco.solvers.contracts import Solver

R = 0.2


def problem_in(
    cells: np.ndarray, start: list[float], goal: list[float], *others: Constraint, radius: float = R
) -> Problem:
    d = cells.ndim
    model = Planar(dt=0.05) if d == 2 else QuadrotorPlanning(dt=0.05)
    rest = [0.0] * (model.n - d)
    cost = QuadraticCost([0.0] * model.n, [1.0] * model.m, [1.0] * model.n, [*goal, *rest])
    field = Field(DistanceField.of(OccupancyGrid(cells, [0.0] * d, 0.1)), radius)
    x0 = torch.tensor([[*start, *rest]], dtype=torch.float64)
    return Problem(model, cost, [field, *others], x0, 20, Goal(goal, 0.2))


def paths_in(problem: Problem, count: int = 4) -> tuple[Tensor, Tensor, Inflated]:
    scene = scene_of(problem, torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64))
    assert scene is not None
    paths, found = Roadmap().paths(scene, count)
    return paths, found, scene.obstacles


def assert_clear(problem: Problem, path: Tensor, slack: float = 0.02) -> None:
    """Nowhere nearer to any obstacle than the full radius, up to the step at which a path is looked at."""
    share = torch.linspace(0, 1, 40, dtype=torch.float64).view(-1, 1, 1)
    points = (path[:-1] + share * path.diff(dim=0)).reshape(1, -1, path.shape[-1])
    for part in problem.constraints:
        if isinstance(part, Obstacles):
            assert float(part.signed_distance(points, points.new_zeros(1)).amin()) > -slack


def spiral() -> np.ndarray:
    cells = np.zeros((80, 80), bool)
    cells[[0, -1]], cells[:, [0, -1]] = True, True
    turns = [(0, 12), (66, 12), (66, 66), (12, 66), (12, 26), (52, 26), (52, 52), (26, 52)]
    for (a, b), (c, d) in itertools.pairwise(turns):
        cells[min(a, c) : max(a, c) + 1, min(b, d) : max(b, d) + 1] = True
    return cells


def test_the_only_way_through_a_spiral_is_found() -> None:
    problem = problem_in(spiral(), [0.6, 0.6], [3.9, 3.9])
    paths, found, obstacles = paths_in(problem)
    assert bool(found) and classes(paths, obstacles).unique().tolist() == [0]
    assert_clear(problem, paths[0, 0])
    corners = [
        (0.6, 0.6),
        (7.0, 0.9),
        (7.0, 7.0),
        (0.9, 7.0),
        (0.9, 2.3),
        (5.5, 2.3),
        (5.5, 5.5),
        (2.4, 5.5),
        (3.9, 3.9),
    ]
    due = sum(np.linalg.norm(np.subtract(a, b)) for a, b in itertools.pairwise(corners))
    assert 0.9 * due < float(length(paths[:, 0])) < 1.05 * due


def test_each_way_around_a_block_is_a_class_and_the_shortest_comes_first() -> None:
    cells = np.zeros((60, 60), bool)
    cells[25:35, 20:45] = True  # nearer to its lower end
    problem = problem_in(cells, [1.0, 3.0], [5.0, 3.0])
    paths, found, obstacles = paths_in(problem, 3)
    label = classes(paths, obstacles)[0].tolist()
    assert bool(found) and label == [0, 1, 0]
    low, high = paths[0, 0], paths[0, 1]
    assert float(low[:, 1].min()) < 1.85 and float(high[:, 1].max()) > 4.65
    # Of a taut string around the corners, grown by the radius: two tangents, two arcs, and the straight part between.
    for path, corner in ((low, 1.0), (high, 1.5)):
        assert_clear(problem, path)
        straight = 2 * np.hypot(1.5, corner + R) + 1.0
        assert straight - 0.05 < float(length(path[None])) < straight + 0.25
    assert len(keys(5)) == len(set(keys(5).tolist()))


def test_sums_along_ways_are_those_of_their_polylines_and_tell_windings_apart() -> None:
    rng = np.random.default_rng(0)
    cells = rng.random((40, 40)) < 0.03
    problem = problem_in(cells, [0.1, 0.1], [3.9, 3.9], radius=0.05)
    field = problem.constraints[0]
    assert isinstance(field, BoundField)
    ends = np.array([[0.1, 0.1], [3.9, 3.9]])
    lattice = lattice_of([field], [], ends)
    ways = Ways(blocks_of(lattice, 0.05, 4096), ends, lambda p: np.ones(len(p)), R, 0.0)
    for end in (0, 1):
        sums, others = _swept_on_the_way(ways, end), _swept_on_the_way(ways, 1 - end)
        for v in np.flatnonzero(np.isfinite(ways.total))[::97]:
            assert int((sums - others)[v]) == (1 - 2 * end) * swept(lattice, ways.path(int(v)))
    for some in range(30):  # two polylines between the same ends, by winding angles and by sums
        a, b = (np.concatenate((ends[:1], rng.uniform(0, 4, (3, 2)), ends[1:])) for _ in range(2))
        marks = lattice.position(lattice.marks)
        turned = [_angle(path[:, None] - marks) for path in (a, b)]
        alike = bool((np.abs(turned[0] - turned[1]) < np.pi).all())
        assert (swept(lattice, a) == swept(lattice, b)) == alike, some


def _angle(seen: np.ndarray) -> np.ndarray:
    """Angles (M,) that paths (P, M, 2) sweep around the origin."""
    a, b = seen[:-1], seen[1:]
    return np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1)).sum(0)


def test_between_floors_the_way_leads_through_the_opening() -> None:
    cells = np.zeros((40, 40, 40), bool)
    cells[:, :, [0, -1]], cells[:, [0, -1]], cells[[0, -1]] = True, True, True
    cells[:, :, 19:21] = True
    cells[28:36, 28:36, 19:21] = False  # 0.8 m wide, far from the straight line
    problem = problem_in(cells, [1.0, 1.0, 1.0], [1.0, 1.0, 3.0])
    paths, found, _ = paths_in(problem, 2)
    assert bool(found)
    assert_clear(problem, paths[0, 0], slack=0.05)
    through = np.linalg.norm([2.0, 2.0, 1.0]) * 2
    assert float(length(paths[:, 0])) < 1.1 * through


def test_closed_rooms_have_no_path_and_others_not_through_gaps_that_are_too_narrow() -> None:
    cells = np.zeros((60, 60), bool)
    cells[30] = True
    cells[:, [0, -1]], cells[[0, -1]] = True, True
    paths, found, _ = paths_in(problem_in(cells, [1.0, 3.0], [5.0, 3.0]))
    assert not bool(found) and float(length(paths[:, 0])) == pytest.approx(4.0)
    cells[30, 28:31] = False  # 0.3 m
    cells[30, 50:56] = False  # 0.6 m
    problem = problem_in(cells, [1.0, 3.0], [5.0, 3.0])
    paths, found, _ = paths_in(problem)
    assert bool(found) and float(paths[0, 0, :, 1].max()) > 5.0
    assert_clear(problem, paths[0, 0])


def test_other_obstacles_beside_a_map_and_ends_outside_of_it() -> None:
    cells = np.zeros((40, 40), bool)
    cells[20, 10:30] = True
    sphere, box = Spheres([[2.05, 0.4]], [0.5], R), Boxes([[2.05, 3.6]], [[0.2, 0.8]], R)
    problem = problem_in(cells, [-1.0, 2.0], [5.0, 2.0], sphere, box)
    paths, found, obstacles = paths_in(problem, 4)
    assert bool(found) and len(classes(paths, obstacles)[0].unique()) > 1
    for path in paths[0]:
        assert_clear(problem, path)
    assert float(paths[0, 0, :, 1].min()) < -0.2  # around the sphere: the gap between it and the wall is closed


def test_batches_take_each_problems_own_map_and_give_the_same_paths() -> None:
    rng = np.random.default_rng(2)
    cells = rng.random((3, 40, 40)) < 0.02
    cells[:, :8], cells[:, -8:] = False, False
    model = Planar(dt=0.05)
    x0 = torch.tensor([[0.4, 2.0, 0, 0, 0, 0]] * 3, dtype=torch.float64)
    cost = QuadraticCost([0.0] * 6, [1.0] * 2, [1.0] * 6, [3.6, 2.0, 0, 0, 0, 0])
    problem = Problem(model, cost, [Field(OccupancyGrid(cells, [0, 0], 0.1), 0.1)], x0, 20, Goal([3.6, 2.0], 0.2))
    assert has_paths(problem)
    paths, found, _ = paths_in(problem, 3)
    for b in (2, 0):
        alone, arrives, _ = paths_in(problem.take(torch.tensor([b])), 3)
        assert torch.equal(alone[0], paths[b]) and bool(arrives[0]) == bool(found[b])
    assert bool(found.all()) and not torch.equal(paths[0], paths[1])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("merged", mostly([True, False], False))
def test_numpy_finds_the_same_blocks_ways_and_taut_paths(d: int, merged: bool) -> None:
    rng = np.random.default_rng(1)
    cells = rng.random([24] * d) < 0.03
    problem = problem_in(cells, [0.1] * d, [2.3] * d, radius=0.15)
    field = problem.constraints[0]
    assert isinstance(field, BoundField)
    ends = np.array([[0.1] * d, [2.3] * d])

    def price(points: np.ndarray) -> np.ndarray:
        return 1.0 + points[:, 0] ** 2

    lattice = lattice_of([field], [], ends)
    blocks = blocks_of(lattice, 0.15, 2**12, 0.01, merged)
    other = plain_blocks(lattice, blocks, 0.01, merged)
    ways, other_ways = (Ways(one, ends, price, R, 0.0) for one in (blocks, other))
    clear, other_clear = lattice.map.everywhere, everywhere(lattice.map)
    np.testing.assert_allclose(clear, other_clear, rtol=1e-6, atol=1e-7)
    assert (blocks.layers == 2).any() == merged and len(blocks.nodes) == len(other.nodes)
    held = blocks.block >= 0  # blocks are numbered in another order
    np.testing.assert_array_equal(held, other.block >= 0)
    for a, b in ((blocks.room, other.room), (blocks.own, other.own), *zip(ways.costs, other_ways.costs, strict=True)):
        np.testing.assert_allclose(a[blocks.block[held]], b[other.block[held]], rtol=1e-6)
    assert np.isfinite(ways.costs[0][blocks.block[held]]).any()
    path = ways.path(int(ways.total.argmin()))
    taut = tightened(lattice, path, ways.least)
    far = Solids(torch.full((1, 1, d), 1e6).double(), torch.ones(1, 1).double(), torch.zeros(1, 1, dtype=torch.bool))
    np.testing.assert_allclose(tightened(replace(lattice, solids=(far,)), path, ways.least), taut, atol=1e-12)
    assert 2 <= len(taut) < len(path)


def solver_of(problem: Problem) -> Solver:
    return presets.gco(problem)


@pytest.mark.slow
def test_gco_flies_around_walls_with_the_same_bits_alone_and_in_a_batch() -> None:
    cells = np.zeros((30, 24), bool)
    cells[14:16, :14] = True  # the straight way ends in front of it
    field = DistanceField.of(OccupancyGrid(cells, [-1.5, -1.0], 0.1))
    x0 = torch.zeros(3, 6, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.0, torch.tensor([0.0, -0.4, 0.2])
    cost = QuadraticCost([5.0, 5, 0, 1, 1, 0], [0.1, 0.1], [50.0, 50, 0, 1, 1, 0], [1.0, -0.2, 0, 0, 0, 0])
    problem = Problem(Planar(dt=0.05), cost, [Field(field, 0.1)], x0, 160, Goal([1.0, -0.2], 0.2))
    rest = torch.zeros(3, 160, 2, dtype=torch.float64)
    whole = solver_of(problem).solve(problem, rest)
    some = torch.tensor([2, 0])
    part = solver_of(problem).solve(problem.take(some), rest[some], ids=some)
    assert torch.equal(part.U, whole.U[some]) and torch.equal(part.X, whole.X[some])
    from torchgco import judge

    assert bool(judge(problem, whole.U).reached.all())


def test_without_a_compiler_no_way_is_found_in_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CC", "none")
    cells = np.zeros((30, 24), bool)
    cells[14:16, :14] = True
    problem = problem_in(cells, [0.5, 1.0], [2.5, 1.0], radius=0.1)
    seen = scene_of(problem, torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64))
    assert seen is not None
    paths, found = Roadmap().paths(seen, 3)
    assert not bool(found.any()) and bool((paths[:, :, 1:] == seen.goal[:, None, None]).all())
    assert classes(paths, seen.obstacles).shape == paths.shape[:2]
    with pytest.raises(NativeError, match="state the stages"):
        shortest_way(DistanceField.of(OccupancyGrid(cells, [0.0, 0.0], 0.1)), 0.1, [0.5, 1.0], [2.5, 1.0])
