"""Ways over a grid, compared with a search that relaxes every edge until nothing changes."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from tests.reference.maps import distance_from_cells
from torchgco.maps import DistanceField, OccupancyGrid
from torchgco.maps.ways import Ways, length

H = 0.5  # m


def cheapest(ways: Ways, start: int) -> np.ndarray:
    """Costs of all nodes by the rounds of Bellman and Ford."""
    shape, d = ways.distance.shape, ways.distance.ndim
    nodes = list(product(*map(range, shape)))
    far = ways.distance - ways.radius
    rate = 1.0 + ways.weight * np.clip(1.0 - far / max(ways.near, 1e-9), 0.0, 1.0)
    edges = []
    for a in nodes:
        for step in product((-1, 0, 1), repeat=d):
            b = tuple(np.add(a, step))
            if any(step) and all(0 <= i < n for i, n in zip(b, shape, strict=True)):
                long = ways.spacing * np.sqrt(np.square(step).sum())
                if far[a] + far[b] > long:
                    edges.append((a, b, long * 0.5 * (rate[a] + rate[b])))
    cost = np.full(shape, np.inf)
    cost.flat[start] = 0.0
    changed = True
    while changed:
        changed = False
        for a, b, long in edges:
            if cost[a] + long < cost[b] - 1e-12:
                cost[b], changed = cost[a] + long, True
    return cost.ravel()


@pytest.mark.parametrize(("d", "weight"), [(2, 0.0), (2, 3.0), (3, 1.0)])
def test_costs_are_those_of_a_slow_search(d: int, weight: float) -> None:
    rng = np.random.default_rng(d)
    distance = rng.uniform(0.0, 1.4, (9, 7) if d == 2 else (5, 4, 4))
    ways = Ways(distance, np.zeros(d), H, 0.2 if d == 2 else 0.5, near=0.5, weight=weight)
    start = int(distance.argmax())
    found, _ = ways.costs(ways.places(start))
    np.testing.assert_allclose(found, cheapest(ways, start), rtol=1e-9)
    reached = np.flatnonzero(np.isfinite(found))
    assert 3 < len(reached) < distance.size, "some are barred"
    goal = int(reached[found[reached].argmax()])
    way = ways.way(ways.places(start), ways.places(goal))
    assert way is not None and (way[[0, -1]] == ways.places([start, goal])).all()
    assert length(way) == pytest.approx(found[goal]) if weight == 0.0 else length(way) < found[goal]


def test_a_way_is_as_free_as_it_says_everywhere() -> None:
    rng = np.random.default_rng(5)
    grid = OccupancyGrid(rng.uniform(size=(40, 30)) < 0.03, [-1.0, 2.0], 0.2)
    ways = Ways.through(DistanceField.of(grid), 0, 0.3)
    assert 0.075 < ways.spacing <= 0.15
    free = np.flatnonzero(ways.distance.ravel() > 0.4)
    way = ways.way(ways.places(free[0]), ways.places(free[-1]))
    assert way is not None and len(way) > 20
    for a, b in pairwise(way):
        for p in np.linspace(a, b, 9):
            assert distance_from_cells(p, grid.is_occupied, grid.origin, grid.resolution) >= 0.3 - 1e-6


def test_walls_bar_ways_and_closeness_has_its_price() -> None:
    cells = np.zeros((60, 40), bool)
    cells[28:32] = True
    field = DistanceField.of(OccupancyGrid(cells, [0.0, 0.0], 0.1).enclosed())
    assert Ways.through(field, 0, 0.2).way([1.0, 1.0], [5.0, 1.0]) is None
    cells[28:32, 2:12] = False  # a door of 1 m
    field = DistanceField.of(OccupancyGrid(cells, [0.0, 0.0], 0.1).enclosed())
    straight = Ways.through(field, 0, 0.2)
    off = Ways(straight.distance, straight.origin, straight.spacing, 0.2, near=0.5, weight=5.0)
    start, goal = [1.0, 0.3], [5.0, 0.3]
    ways = [some.way(start, goal) for some in (straight, off)]
    assert ways[0] is not None and ways[1] is not None
    assert length(ways[0]) == pytest.approx(4.0, abs=0.2) and length(ways[0]) + 0.1 < length(ways[1]) < 5.5
    through = [way[np.abs(way[:, 0] - 3.0).argmin(), 1] for way in ways]
    assert through[0] < 0.55 and through[1] == pytest.approx(0.7, abs=0.16), "the middle of the door"
    assert Ways.through(field, 0, 0.55).way([1.0, 1.0], [5.0, 1.0]) is None, "too wide"
