"""Ways through a lattice in space and time, against dynamic programming state by state."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference.timed import Ways
from torchgco.native.engine import run
from torchgco.roadmap.timed import FAR, PARTS, TimedLattice, TimedScene, library_for, timed_ways

SPACING, TAU, MARGIN = 0.5, 0.5, 0.05


def scene_of(lattice: TimedLattice, parts: tuple[np.ndarray, ...], start: int, first: int, margin: float) -> TimedScene:
    gap, cost, move, last, change = (torch.from_numpy(part).float().contiguous() for part in parts)
    return TimedScene(lattice, gap, cost, move, last, change, start, first, margin)


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def drawn(counts: tuple[int, ...], layers: int, seed: int) -> TimedScene:
    """Discs that drift over a small lattice, random costs, and a start at a corner."""
    rng, d = np.random.default_rng(seed), len(counts)
    least, most = np.full(d, -1), np.full(d, 2 if d == 2 else 1)
    lattice = TimedLattice(np.zeros(d), np.array(counts), SPACING, TAU, layers, least, most)
    times = np.arange(layers * PARTS + 1) * TAU / PARTS
    gap = np.full((len(times), lattice.cells), 9.0)
    for _ in range(3):
        center, velocity = rng.uniform(0, SPACING * np.array(counts), d), rng.uniform(-0.6, 0.6, d)
        way = center + times[:, None] * velocity
        gap = np.minimum(gap, np.linalg.norm(lattice.points - way[:, None], axis=-1) - rng.uniform(0.3, 0.6))
    gap[:, 0] += 1.0  # the start is clear
    cost = rng.uniform(0, 1, (layers + 1, lattice.cells))
    cost[rng.uniform(size=cost.shape) < 0.05] = FAR
    moves = len(lattice.velocities)
    move = rng.uniform(0, 1, moves)
    move[rng.uniform(size=moves) < 0.1] = FAR
    change = np.append(rng.uniform(0.1, 0.5, d), np.zeros(3 - d))
    last = rng.uniform(0, 1, moves)
    first = lattice.move(np.zeros(d))
    return scene_of(lattice, (gap, cost, move, last, change), 0, first, MARGIN)


def reference(scene: TimedScene) -> np.ndarray:
    a = scene.lattice
    counts, least, most = (tuple(int(n) for n in part) for part in (a.counts, a.least, a.most))
    cost = np.where(scene.cell_cost.numpy() < FAR, scene.cell_cost.numpy(), np.inf).astype(float)
    ways = Ways(
        counts, least, most, PARTS, MARGIN, scene.clearance.numpy().astype(float).reshape(-1, *counts),
        cost.reshape(-1, *counts), {}, {}, tuple(scene.change[: a.d].tolist()),
    )  # fmt: skip
    finite = lambda v: float(v) if v < FAR else np.inf
    ways.move_cost = dict(zip(ways.moves, map(finite, scene.move_cost.tolist()), strict=True))
    ways.last_cost = dict(zip(ways.moves, map(finite, scene.last_cost.tolist()), strict=True))
    return ways.through((0,) * a.d, ways.moves[scene.first]).reshape(a.layers + 1, -1)


@pytest.mark.parametrize(
    ("counts", "layers", "seed"), [((6, 5), 6, 0), ((6, 5), 6, 1), ((7, 4), 5, 2), ((4, 3, 3), 4, 3)]
)
def test_costs_through_all_states_are_those_of_plain_dynamic_programming(counts, layers, seed) -> None:
    scene, library = drawn(counts, layers, seed), library_for(len(counts))
    assert library is not None
    one = scene.arguments(4, 1e3)
    got = torch.empty(layers + 1, scene.lattice.cells)
    one.through = got
    run(library.tgco_timed, 1, 1, one)
    due = reference(scene)
    some = np.isfinite(due)
    assert some.any() and (~some).any()
    assert np.array_equal(got.numpy() < FAR, some) and np.allclose(got.numpy()[some], due[some], atol=1e-4)
    assert one.found >= 1


def wall(opens: tuple[float, float], closes: float = np.inf) -> TimedScene:
    """A wall across the middle of a strip, with a door above and one below; these open at their own times."""
    lattice = TimedLattice(np.zeros(2), np.array([13, 9]), 0.25, 0.25, 24, np.array([-2, -2]), np.array([2, 2]))
    p, times = lattice.points, np.arange(24 * PARTS + 1) * 0.25 / PARTS
    bricks = np.stack((np.full(41, 1.5), np.linspace(0, 2, 41)), axis=1)
    away = np.linalg.norm(p[:, None] - bricks, axis=-1) - 0.1
    closed = [
        [
            np.abs(y - brick[1]) > 0.3 or not opening <= t < closes
            for y, opening in zip((0.25, 1.75), opens, strict=True)
        ]
        for t in times
        for brick in bricks
    ]
    there = np.array(closed).all(1).reshape(len(times), len(bricks))
    gap = np.where(there[:, None], away, 9.0).min(-1)
    away = ((p - [3.0, 1.0]) ** 2).sum(1)
    cost = np.repeat(0.25 * away[None], 25, axis=0)
    cost[-1] = np.where(away < 0.1, 0.0, FAR)
    moves = (lattice.velocities**2).sum(1)
    parts = (gap, cost, 0.01 * moves, 0 * moves, np.array([0.1, 0.1, 0.0]))
    return scene_of(lattice, parts, lattice.cell(np.array([0, 1.0])), lattice.move(np.zeros(2)), 0.0)


def test_ways_through_two_doors_are_two_classes() -> None:
    found = timed_ways([wall((0.0, 0.0)), wall((0.0, np.inf)), wall((np.inf, np.inf))], 4, 0.5)
    both, one, none = found
    assert len(both.costs) >= 2 and np.allclose(both.costs[0], both.costs[1], rtol=1e-3)
    above = lambda ways: [bool(way[np.abs(way[:, 0] - 1.5).argmin(), 1] > 1.0) for way in ways.points]
    assert sorted(above(both)[:2]) == [False, True]
    assert len(one.costs) >= 1 and not any(above(one)) and len(none.costs) == 0
    step = np.diff(both.points, 2, axis=1)
    assert np.abs(step).max() <= 0.25 + 1e-12, "a move differs by a cell at most"


def test_what_is_found_does_not_depend_on_the_batch() -> None:
    scenes = [wall((0.0, 1.0)), drawn((6, 5), 6, 0), drawn((7, 4), 5, 2)]
    whole = timed_ways(scenes, 3, 0.5)
    for scene, ways in zip(scenes, whole, strict=True):
        alone = timed_ways([scene], 3, 0.5)
        assert np.array_equal(alone[0].points, ways.points) and np.array_equal(alone[0].costs, ways.costs)
