"""The vehicle's map against slow versions of the same: cells along rays, distances, corridors, paths."""

import ctypes

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tests.reference.sensing import chords, cubes, distances, inside
from torchgco.exploration.sensing import Lidar, Scan, SeenMap, World, library
from torchgco.exploration.sensing.grid import (
    CHORD,
    FREE,
    FREE_AT,
    FREE_BESIDE,
    HIT,
    MISS,
    OCCUPIED,
    OCCUPIED_AT,
    REACH,
    UNKNOWN,
    CellSearch,
)
from torchgco.exploration.sensing.sensors import Motion

CORNER, SIZE, SHAPE = np.array([-2.0, -1.5, -1.0]), 0.25, (17, 13, 9)
SPAN = np.array(SHAPE) * SIZE


def empty(reach: int = REACH) -> SeenMap:
    return SeenMap(CORNER, SHAPE, SIZE, reach)


def drawn(rng: np.random.Generator, free: float = 0.8) -> SeenMap:
    """A map with cells of all three states."""
    seen = empty()
    seen.state[:] = rng.choice([FREE, OCCUPIED, UNKNOWN], SHAPE, p=[free, 0.6 * (1 - free), 0.4 * (1 - free)])
    seen.measure()
    return seen


def scan_of(rng: np.random.Generator, rays: int, ending: float = 0.6) -> Scan:
    d = rng.normal(size=(rays, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    distances = np.where(rng.uniform(size=rays) < ending, rng.uniform(0.3, 2.5, rays), np.inf)
    return Scan(CORNER + SPAN * rng.uniform(0.3, 0.7, 3), d, distances)


def test_cells_along_rays_are_those_of_a_slow_version() -> None:
    rng = np.random.default_rng(0)
    seen, centers, odds = empty(), cubes(SHAPE, CORNER, SIZE), np.zeros(np.prod(SHAPE))
    for _ in range(3):
        scan = scan_of(rng, 250, 0.15)
        ended, doubtful, passed = np.zeros(len(odds), int), np.zeros(len(odds), bool), np.zeros(len(odds), int)
        for d, distance in zip(scan.directions, scan.distances, strict=True):
            length = distance if np.isfinite(distance) else 2.0
            chord = chords(scan.origin, d, length, centers, SIZE)
            within = np.isfinite(distance) & (np.abs(scan.origin + distance * d - centers) < 0.5 * SIZE).all(axis=1)
            passed += (chord >= CHORD * SIZE) & ~within
            ended += within
            doubtful |= np.abs(chord - CHORD * SIZE) < 1e-9
        hit = (ended > 0) & (passed <= 8 * ended)
        odds += np.where(hit, HIT, MISS * np.minimum(passed, 7))
        seen.add(scan, 2.0)
        assert not doubtful.any()
        assert np.allclose(seen.odds.ravel(), np.clip(odds, -2.0, 3.5), atol=1e-6)
    state = seen.state.ravel()
    beside = maximum_filter(odds.reshape(SHAPE), 3, mode="constant", cval=-9.0).ravel() >= OCCUPIED_AT
    limit = np.where(beside, FREE_BESIDE, FREE_AT)
    clear = np.abs(odds - limit) > 1e-6  # of rounding
    assert np.array_equal((state == FREE)[clear], (odds < limit)[clear]) and (state == FREE).sum() > 10
    assert (beside & (state == UNKNOWN) & (odds < FREE_AT)).any()
    assert (state[odds == HIT] == OCCUPIED).all() and (state == OCCUPIED).sum() > 10


def test_a_few_returns_among_many_passes_are_noise() -> None:
    at = CORNER + SIZE * np.array([8.5, 6.5, 4.5])
    origin, ray = at - np.array([1.0, 0, 0]), np.array([1.0, 0, 0])
    for passes, state in ((8, OCCUPIED), (9, FREE)):
        seen = empty()
        distances = np.array([1.0] + [np.inf] * passes)
        seen.add(Scan(origin, np.tile(ray, (passes + 1, 1)), distances), 2.0)
        assert seen.state[8, 6, 4] == state


def test_changes_are_those_of_the_state() -> None:
    rng = np.random.default_rng(1)
    seen = empty()
    for _ in range(4):
        before = seen.state.copy()
        changed = seen.add(scan_of(rng, 20), 2.0)
        assert sorted(changed) == list(np.flatnonzero((seen.state != before).ravel()))


def test_distances_are_those_to_the_nearest_cube() -> None:
    rng = np.random.default_rng(2)
    seen, centers = drawn(rng, 0.97), cubes(SHAPE, CORNER, SIZE)
    state = seen.state.ravel()
    slow = distances(centers, centers[state == OCCUPIED], SIZE)
    edge = np.minimum(centers - CORNER, CORNER + SPAN - centers).min(axis=1)  # what lies outside is blocked, too
    assert np.allclose(seen.from_occupied.ravel(), np.minimum(np.minimum(slow, edge), REACH * SIZE), atol=1e-6)


@pytest.mark.parametrize("share", [0.002, 0.3])
def test_distances_around_changes_alone_are_those_of_the_whole(share: float) -> None:
    rng = np.random.default_rng(3)
    part, whole = drawn(rng), empty(REACH)
    for _ in range(8):
        new = rng.choice([FREE, OCCUPIED, UNKNOWN], SHAPE, p=[0.8, 0.1, 0.1]).astype(np.uint8)
        before = part.state.copy()
        part.state[:] = whole.state[:] = np.where(rng.uniform(size=SHAPE) < share, new, before)
        part.remeasure(np.flatnonzero(part.state != before).astype(np.int32))
        whole.measure()
        assert np.array_equal(part.from_occupied, whole.from_occupied)
    assert (part.from_occupied == 0).sum() > 5


def test_gaps_are_exact_up_to_their_reach() -> None:
    rng = np.random.default_rng(4)
    seen, centers = drawn(rng, 0.97), cubes(SHAPE, CORNER, SIZE)
    points = CORNER + SPAN * rng.uniform(0.02, 0.98, (300, 3))
    edge = np.minimum(points - CORNER, CORNER + SPAN - points).min(axis=1)
    slow = np.minimum(distances(points, centers[seen.state.ravel() != FREE], SIZE), edge)
    assert np.allclose(seen.gaps(points, 0.7), np.minimum(slow, 0.7), atol=1e-9)
    assert np.array_equal(seen.gaps(CORNER - np.eye(3), 0.7), np.zeros(3))


def test_the_box_of_a_map_is_between_its_faces() -> None:
    low, high = empty().box(0.5)
    assert np.allclose(low, CORNER + 0.5) and np.allclose(high, CORNER + SPAN - 0.5)
    low, high = empty().box(9.0)
    assert np.allclose(low, CORNER + 0.5 * SPAN) and np.allclose(high, low)


def test_a_corridor_holds_no_blocked_cell() -> None:
    rng = np.random.default_rng(5)
    seen, centers, reach = drawn(rng, 0.98), cubes(SHAPE, CORNER, SIZE), 1.2
    blocked = centers[seen.state.ravel() != FREE]
    points = CORNER + SPAN * rng.uniform(0.2, 0.8, (60, 3))
    points = points[distances(points, blocked, SIZE) > 0.02]
    for most in (3, 12):
        planes, room = seen.corridor(points, reach, most)
        assert (room > 0).all()
        for p, own, far in zip(points, planes, room, strict=True):
            used = own[(own[:, :3] != 0).any(axis=1)]
            assert (used[:, :3] @ p > used[:, 3]).all()  # the point itself lies on the free side
            inside = p + rng.uniform(-1, 1, (400, 3)) * far
            inside = inside[(np.linalg.norm(inside - p, axis=1) < far) & (inside @ used[:, :3].T > used[:, 3]).all(1)]
            assert distances(inside, blocked, SIZE).min(initial=np.inf) > -1e-9
            assert not len(inside) or distances(inside, blocked, SIZE).min() > 0
    nearest = distances(points, blocked, SIZE)
    first = np.einsum("ij,ij->i", planes[:, 0, :3], points) - planes[:, 0, 3]
    near = nearest < reach
    assert np.allclose(first[near], nearest[near]) and near.sum() > 20


def dijkstra_cost(seen: SeenMap, radius: float, band: float, shy: float, start: tuple, goal: tuple) -> float:
    """The cost of the cheapest path by SciPy."""
    at = np.indices(SHAPE).reshape(3, -1)
    index, d = np.arange(at.shape[1]).reshape(SHAPE), seen.from_occupied.ravel()
    price = 1.0 + shy * np.clip(1.0 - (d - radius) / band, 0.0, None)
    rows, columns, lengths = [], [], []
    for step in np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3):
        to = at + step[:, None]
        fine = ((to >= 0) & (to < np.array(SHAPE)[:, None])).all(axis=0) & step.any()
        a, b = index[tuple(at[:, fine])], index[tuple(to[:, fine])]
        a, b = a[d[b] >= radius], b[d[b] >= radius]
        rows, columns = [*rows, a], [*columns, b]
        lengths.append(np.linalg.norm(step) * price[b])
    graph = coo_array((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), [index.size] * 2)
    return dijkstra(graph.tocsr(), indices=index[start])[index[goal]]


def whole(search: CellSearch, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, bool]:
    found = search.path(start, goal)
    assert found is not None and search.pending is None
    return found


@pytest.mark.parametrize("shy", [0.0, 1.5])
def test_the_cheapest_path_is_that_of_dijkstra(shy: float) -> None:
    rng = np.random.default_rng(6)
    found = 0
    for _ in range(6):
        seen = drawn(rng, 0.9)
        search = CellSearch(seen, radius=0.12, band=0.5, shy=shy)
        start, goal = (1, 1, 1), (15, 11, 7)
        slow = dijkstra_cost(seen, 0.12, 0.5, shy, start, goal)
        path, arrives = whole(search, *(CORNER + (np.array(c) + 0.5) * SIZE for c in (start, goal)))
        assert arrives == np.isfinite(slow)
        if arrives:
            found += 1
            cells = np.floor((path - CORNER) / SIZE).astype(int)
            d = seen.from_occupied[tuple(cells.T)]
            steps = np.linalg.norm(np.diff(cells, axis=0), axis=1)
            price = 1.0 + shy * np.clip(1.0 - (d - 0.12) / 0.5, 0.0, None)
            assert (steps * price[1:]).sum() == pytest.approx(slow, rel=1e-5)
            assert search.cost(path) == pytest.approx(slow, rel=1e-5)
    assert found >= 3


def test_where_no_path_leads_to_the_goal_it_ends_at_the_nearest_cell() -> None:
    seen = empty()
    seen.state[:] = FREE
    seen.state[9] = OCCUPIED  # a wall from side to side
    seen.measure()
    path, arrives = whole(CellSearch(seen, radius=0.1), CORNER + 0.6, CORNER + SPAN - 0.6)
    assert not arrives and seen.cell(path[-1])[0] == 8


@pytest.mark.parametrize("share", [0.9, 0.6])
def test_a_search_in_parts_ends_as_one_in_whole(share: float) -> None:
    """Also where the vehicle moves on meanwhile; another goal begins another search."""
    rng = np.random.default_rng(7)
    seen = drawn(rng, share)
    one, parts = CellSearch(seen, radius=0.12), CellSearch(seen, radius=0.12, limit=9)
    start, goal = CORNER + 0.4, CORNER + SPAN - 0.4
    path, arrives = whole(one, start, goal)
    calls, looked, found = 0, 0, None
    assert parts.path(start, start + SPAN / 2) is None
    while found is None:
        found = parts.path(start + 0.1 * calls, goal)
        calls, looked = calls + 1, looked + parts.expanded
        assert parts.expanded <= 9
    assert found[1] == arrives and np.array_equal(found[0], path) and looked == one.expanded > 9


def test_a_seen_world_is_free_where_it_is_free() -> None:
    """Bodies reach into cells that are known to be free by less than half a cell beyond their centres."""
    rng = np.random.default_rng(8)
    rows = [np.concatenate([rng.uniform([-1, -1, -0.5], [2, 1.5, 1.0]), np.eye(3).ravel(), [0, 0, 0.4], [0.25]])
            for _ in range(5)]  # fmt: skip
    world, seen = World(np.array(rows), Motion.steady(np.zeros((5, 3)))), empty()
    for step, x in enumerate(np.linspace(-1.8, 2.0, 12)):
        p = np.array([x, -1.3, 0.0])
        scan = Lidar(rays=(240, 60), noise=0.0).scan(world, p, [1, 0, 0, 0], 0.0, (0, 0, step))
        seen.add(scan, 15.0)
    free = cubes(SHAPE, CORNER, SIZE)[seen.state.ravel() == FREE]
    hidden = inside(free, world.boxes)  # the side of a trunk fills a cell in part, and rays pass through the rest
    assert len(free) > 1500 and hidden.mean() < 0.01
    slim = world.boxes - 0.5 * SIZE * (np.arange(16) == 15)
    assert not inside(free, slim).any()


def test_a_whole_number_is_a_length() -> None:
    """In place of a double it shifted all arguments, and memory was read that isn't the map's."""
    made = [SeenMap(CORNER, (5, 4, 3), size) for size in (1, 1.0)]
    scan = Scan(np.zeros(3), np.eye(3), np.full(3, 1.5))
    changed = [seen.add(scan, 2).tolist() for seen in made]
    for seen in made:
        seen.remeasure(np.arange(60, dtype=np.int32))
    assert changed[0] == changed[1] and np.array_equal(made[0].from_occupied, made[1].from_occupied)
    with pytest.raises(ctypes.ArgumentError):
        library.call("tgco_gaps", np.zeros(3), np.zeros(3), 1.0, np.zeros(1), 0.5, 1.0, 0, np.zeros(3), np.zeros(1))
