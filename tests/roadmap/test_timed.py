"""Ways through a lattice in space and time, against dynamic programming state by state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.reference.timed import Ways
from torchgco import (
    Boxes,
    Ellipsoids,
    FunctionDynamics,
    Moved,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    Spheres,
)
from torchgco.native.engine import run
from torchgco.roadmap.timed import (
    FAR,
    PARTS,
    Others,
    Surroundings,
    TimedLattice,
    TimedScene,
    field_of,
    library_for,
    timed_ways,
)

SPACING, TAU, MARGIN = 0.5, 0.5, 0.05


def scene_of(lattice: TimedLattice, parts: tuple[np.ndarray, ...], start: int, first: int, margin: float) -> TimedScene:
    gap, cost, end, move, last, change = (torch.from_numpy(part).float().contiguous() for part in parts)
    d = lattice.d
    field = Surroundings(
        gap, gap.new_zeros(len(gap), 0, d), gap.new_zeros(0, d), gap.new_zeros(0, d, d), gap.new_zeros(0), 0
    )
    return TimedScene(lattice, field, cost, end, move, last, change, start, first, margin)


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def drawn(counts: tuple[int, ...], layers: int, seed: int, ends: int = 1) -> TimedScene:
    """Discs that drift over a small lattice, random costs, a start at a corner, an end at one of the last layers."""
    rng, d = np.random.default_rng(seed), len(counts)
    least, most = np.full(d, -1), np.full(d, 2 if d == 2 else 1)
    lattice = TimedLattice(np.zeros(d), np.array(counts), SPACING, TAU, layers, least, most)
    times = np.arange(layers * PARTS + 1) * TAU / PARTS
    gap = np.full((len(times), lattice.cells), 9.0)
    for _ in range(3):
        center, velocity = rng.uniform(0, SPACING * np.array(counts), d), rng.uniform(-0.6, 0.6, d)
        way = center + times[:, None] * velocity
        gap = np.minimum(gap, np.linalg.norm(lattice.points - way[:, None], axis=-1) - rng.uniform(0.3, 0.6))
    cost, end = rng.uniform(0, 1, (layers, lattice.cells)), rng.uniform(0, 1, (ends, lattice.cells))
    for part in (cost, end):
        part[rng.uniform(size=part.shape) < 0.05] = FAR
    cost[0, 0] = 0.5  # the start is open
    moves = len(lattice.velocities)
    move = rng.uniform(0, 1, moves)
    move[rng.uniform(size=moves) < 0.1] = FAR
    change = np.append(rng.uniform(0.1, 0.5, d), np.zeros(3 - d))
    last = rng.uniform(0, 1, moves)
    first = lattice.move(np.zeros(d))
    return scene_of(lattice, (gap, cost, end, move, last, change), 0, first, MARGIN)


def tolls(scene: TimedScene) -> np.ndarray:
    """What being at each cell at each part costs."""
    paid = np.zeros(scene.field.away.shape)
    if scene.others is not None:
        for center, reach, price in zip(
            scene.others.center.transpose(0, 1), scene.others.reach, scene.others.price, strict=True
        ):
            away = np.linalg.norm(scene.lattice.points - center.numpy()[:, None], axis=-1)
            paid += float(price) / PARTS * np.maximum(0.0, 1.0 - away / float(reach))
    return paid


def reference(scene: TimedScene) -> np.ndarray:
    a = scene.lattice
    counts, least, most = (tuple(int(n) for n in part) for part in (a.counts, a.least, a.most))
    parts = (part.numpy().astype(float).reshape(-1, *counts) for part in (scene.cell_cost, scene.end_cost))
    cost, end = (np.where(part < FAR, part, np.inf) for part in parts)
    ways = Ways(
        counts, least, most, PARTS, MARGIN, scene.field.away.numpy().astype(float).reshape(-1, *counts),
        cost, end, {}, {}, tuple(scene.change[: a.d].tolist()), tolls(scene).reshape(-1, *counts),
    )  # fmt: skip
    finite = lambda v: float(v) if v < FAR else np.inf
    ways.move_cost = dict(zip(ways.moves, map(finite, scene.move_cost.tolist()), strict=True))
    ways.last_cost = dict(zip(ways.moves, map(finite, scene.last_cost.tolist()), strict=True))
    return ways.through((0,) * a.d, ways.moves[scene.first]).reshape(a.layers + 1, -1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("counts", "layers", "seed", "ends"),
    [((6, 5), 6, 0, 1), ((6, 5), 6, 1, 3), ((7, 4), 5, 2, 6), ((4, 3, 3), 4, 3, 1), ((3, 4, 3), 4, 4, 3)],
)
def test_costs_through_all_states_are_those_of_plain_dynamic_programming(counts, layers, seed, ends) -> None:
    scene, library = drawn(counts, layers, seed, ends), library_for(len(counts))
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


def test_the_cheapest_way_among_others_that_may_be_met_at_a_price() -> None:
    """As plain dynamic programming with tolls; others go the way that is the cheapest without them."""
    scene = drawn((6, 5), 6, 0)
    (free,) = timed_ways([scene], 1, 0.0)
    assert float(free.costs[0]) == pytest.approx(reference(scene).min(), abs=1e-4)
    times = np.arange(6 * PARTS + 1) / PARTS
    way = np.stack([np.interp(times, np.arange(len(free.points[0])), x) for x in free.points[0].T], axis=-1)
    center = torch.from_numpy(np.stack((way, way + 0.7 * SPACING), axis=1))
    met = replace(scene, others=Others(center, torch.tensor([0.4, 0.6]), torch.tensor([0.3, 0.5])))
    (found,) = timed_ways([met], 1, 0.0)
    assert len(found.points) == 1 and float(found.costs[0]) > float(free.costs[0]) + 0.01
    assert float(found.costs[0]) == pytest.approx(reference(met).min(), abs=1e-4)


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
    cost, end = np.repeat(0.25 * away[None], 24, axis=0), np.where(away < 0.1, 0.0, FAR)[None]
    moves = (lattice.velocities**2).sum(1)
    parts = (gap, cost, end, 0.01 * moves, 0 * moves, np.array([0.1, 0.1, 0.0]))
    return scene_of(lattice, parts, lattice.cell(np.array([0, 1.0])), lattice.move(np.zeros(2)), 0.0)


def test_ways_through_two_doors_are_two_classes() -> None:
    found = timed_ways([wall((0.0, 0.0)), wall((0.0, np.inf)), wall((np.inf, np.inf))], 4, 0.5)
    both, one, none = found
    assert len(both.costs) >= 2 and np.allclose(both.costs[0], both.costs[1], rtol=1e-3)
    above = lambda ways: [bool(way[np.abs(way[:, 0] - 1.5).argmin(), 1] > 1.0) for way in ways.points]
    assert sorted(above(both)[:2]) == [False, True]
    assert len(one.costs) >= 1 and not any(above(one)) and len(none.costs) == 0
    step = np.diff(np.stack(both.points), 2, axis=1)
    assert np.abs(step).max() <= 0.25 + 1e-12, "a move differs by a cell at most"


def test_what_is_found_does_not_depend_on_the_batch() -> None:
    scenes = [wall((0.0, 1.0)), drawn((6, 5), 6, 0), drawn((7, 4), 5, 2)]
    whole = timed_ways(scenes, 3, 0.5)
    for scene, ways in zip(scenes, whole, strict=True):
        alone = timed_ways([scene], 3, 0.5)
        assert all(map(np.array_equal, alone[0].points, ways.points)) and np.array_equal(alone[0].costs, ways.costs)


def test_ways_end_where_it_is_cheapest_and_a_class_per_window() -> None:
    """The door below is open at first, the other one much later: who may end at any time waits for none."""
    scene = wall((0.0, 3.0))
    early = replace(scene, end_cost=scene.end_cost + 1.0 * torch.arange(20.0).unsqueeze(-1) * TAU)
    (found,) = timed_ways([early], 4, 2.0)
    (late,) = timed_ways([scene], 4, 2.0)
    assert len(found.points[0]) < len(late.points[0]) == 25
    assert np.allclose([way[-1] for way in found.points], [3.0, 1.0], atol=0.3)
    assert (np.diff(found.costs) >= 0).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("d", [2, 3])
def test_distances_are_those_of_the_obstacles_where_they_matter(d: int, seed: int) -> None:
    rng = np.random.default_rng((seed, d))
    place = lambda count: rng.uniform(-0.5, 3.0, (count, d))
    turn = (
        rng.uniform(-3, 3, 3) if d == 2 else (q := rng.normal(size=(3, 4))) / np.linalg.norm(q, axis=1, keepdims=True)
    )
    boxes = Boxes(place(3), rng.uniform(0.05, 0.6, (3, d)), 0.1, rotations=turn, radii=rng.uniform(0, 0.2, 3))
    sines = [rng.uniform(low, high, (3, 1, d)) for low, high in ((-0.5, 0.5), (0.0, 3.0), (0.0, 6.0))]
    sines[0][0] = 0.0  # one rests
    balls, radii = place(4), rng.uniform(0.1, 0.5, 4)
    balls[1], radii[1] = np.nan, np.nan
    path = place(2) + np.cumsum(rng.uniform(-0.2, 0.2, (21, 2, d)), axis=0)
    parts = [
        Spheres(balls, radii, 0.2, rng.uniform(-1, 1, (4, d))),
        Spheres(place(1), 0.3, 0.2),
        boxes,
        OscillatingBoxes(boxes, *sines),
        Moved(path, 0.2, 0.1),
        Ellipsoids(place(1), rng.uniform(0.2, 0.6, (1, d)), 0.1),
    ]
    x0 = torch.zeros(1, 2 * d, dtype=torch.float64)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., d:], u), -1), 2 * d, d, 0.1, "rk4", slice(0, d))
    problem = Problem(model, QuadraticCost([1.0] * 2 * d, [1.0] * d, [1.0] * 2 * d), parts, x0, 20)
    lattice = TimedLattice(
        np.full(d, -0.3), np.arange(9, 9 + d), 0.27, 0.3, 6, np.full(d, -1), np.full(d, 1)
    )  # fmt: skip
    field, moves = field_of(problem.obstacles, lattice), torch.zeros(3**d)
    assert len(field.radius) == 3 + 1 + 3 + 3 + 2 and field.resting == 1 + 3 + 1
    cost = torch.zeros(6, lattice.cells)
    scene = TimedScene(lattice, field, cost, cost[:1], moves, moves, torch.zeros(3), 0, 0, MARGIN)
    one, got = scene.arguments(1, 1.0), field.away.clone()
    one.clearance = got
    run(library_for(d).tgco_timed, 1, 1, one)  # type: ignore[union-attr]
    points, far = torch.from_numpy(lattice.points).unsqueeze(0), MARGIN + 0.27 * np.sqrt(d)
    for k, row in enumerate(got):
        t = torch.full((1,), k * 0.3 / PARTS, dtype=torch.float64)
        due = torch.stack([part.signed_distance(points, t)[0].amin(-1) for part in problem.obstacles]).amin(0)
        assert torch.allclose(row.double(), due.clamp(max=far), atol=1e-5)
