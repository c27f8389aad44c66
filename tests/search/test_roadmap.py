"""Ways between spheres: free, short, found where there is one, and the cheapest of their graph."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torchgco.guidance.roadmap import FAR, Roadmap, Scene, halton, points_along
from torchgco.guidance.scene import scene_of
from torchgco.guidance.search import Search, segment_gaps, squares_from_segments

from tests.reference.roadmap import cheapest_cost, point_along, segment_gap, way_length
from torchgco import InputError, compose
from torchgco.native.roadmap import Graph, NativeSearch, library_for


def flat(points, rows):
    """Every metre costs the same."""
    return torch.ones_like(points[..., 0])


def scene(centers, distances, start=(-1.0, 0.0), goal=(1.0, 0.0), toll=flat) -> Scene:
    o, R = torch.as_tensor(centers, dtype=torch.float64), torch.as_tensor(distances, dtype=torch.float64)
    ends = (torch.tensor(end, dtype=torch.float64).expand(o.shape[0], -1) for end in (start, goal))
    return Scene(*ends, o, R, toll)


def random_scene(d: int, B: int = 5, M: int = 12, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    start, goal = (-1.0,) + (0.0,) * (d - 1), (1.0,) + (0.1,) * (d - 1)
    o, R = rng.uniform(-0.7, 0.7, (B, M, d)), rng.uniform(0.1, 0.2, (B, M))
    R[1, ::2] = FAR
    return scene(o, R, start, goal)


def ring(open_at: int | None = None) -> Scene:
    """Discs that touch each other all around the goal, or all but one."""
    angle = np.arange(10) * 0.2 * np.pi
    o = np.stack((1.0 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)), axis=-1)
    R = np.full(10, 0.17)
    if open_at is not None:
        R[open_at] = FAR
    return scene(o[None], R[None])


@pytest.mark.parametrize("d", [2, 3])
def test_ways_are_free_and_lead_from_start_to_goal(d: int) -> None:
    s = random_scene(d)
    ways, found = Roadmap().ways(s, 3)
    assert bool(found.all())
    for i in range(3):
        way = ways[:, i]
        assert torch.equal(way[:, 0], s.start) and torch.equal(way[:, -1], s.goal)
        for b in range(s.start.shape[0]):
            for a, c in pairwise(way[b].numpy()):
                assert segment_gap(a, c, s.centers[b].numpy(), s.distances[b].numpy(), 201) > -1e-9


def test_further_ways_are_others() -> None:
    """Around a disc on the other side; the first is the same however many follow, and lengths grow."""
    s = scene([[[0.0, 0.1]]], [[0.4]])
    ways, _ = Roadmap().ways(s, 2)
    assert torch.equal(ways[:, :1], Roadmap().ways(s)[0])
    assert float(ways[0, 0, :, 1].min()) < -0.3 and float(ways[0, 1, :, 1].max()) > 0.4
    assert way_length(ways[0, 0].numpy()) < way_length(ways[0, 1].numpy())


def test_where_there_is_one_way_only_it_comes_again() -> None:
    ways, found = Roadmap().ways(ring(open_at=3), 2)
    middle = torch.tensor([1.0 + 0.5 * np.cos(0.6 * np.pi), 0.5 * np.sin(0.6 * np.pi)])
    path = points_along(ways[:, 1], torch.linspace(0, 3, 400, dtype=torch.float64)[None])
    assert bool(found) and float((path[0] - middle).square().sum(-1).sqrt().min()) < 0.17


def test_the_way_around_one_disc_is_a_taut_string() -> None:
    R = 0.4
    ways, found = Roadmap().ways(scene([[[0.0, 0.0]]], [[R]]))
    tangents, arc = 2 * np.sqrt(1 - R**2), R * (np.pi - 2 * np.arccos(R))
    assert bool(found) and tangents + arc < way_length(ways[0, 0].numpy()) < 1.05 * (tangents + arc)


def test_a_free_line_is_straight() -> None:
    ways, _ = Roadmap().ways(scene([[[0.0, 0.9]]], [[0.2]]))
    assert way_length(ways[0, 0].numpy()) == pytest.approx(2.0, abs=1e-9)


def test_no_way_into_a_closed_ring_and_one_through_its_gap() -> None:
    assert not bool(Roadmap().ways(ring())[1])
    for gap in (0, 3, 5):
        ways, found = Roadmap().ways(ring(open_at=gap))
        way = ways[:, 0]
        middle = torch.tensor([1.0 + 0.5 * np.cos(0.2 * np.pi * gap), 0.5 * np.sin(0.2 * np.pi * gap)])
        assert bool(found)
        path = points_along(way, torch.linspace(0, way_length(way[0].numpy()), 400, dtype=torch.float64)[None])
        assert float((path[0] - middle).square().sum(-1).sqrt().min()) < 0.17


def test_a_gap_that_is_closed_by_little_is_open_with_slack() -> None:
    """Ten discs around the goal that overlap by 10 % of their radius."""
    closed = ring()
    assert not bool(Roadmap(slack=0.02).ways(closed)[1].any())
    ways, found = Roadmap(slack=0.12).ways(closed)
    assert bool(found.all())
    assert float(segment_gaps(ways[:, 0, :-1], ways[:, 0, 1:], closed.centers, closed.distances).min()) > -0.12 * 0.17


def test_a_way_goes_where_a_metre_is_cheap() -> None:
    o, R = [[[0.0, 0.0]]], [[0.4]]
    for side in (1.0, -1.0):
        ways, _ = Roadmap().ways(scene(o, R, toll=lambda p, rows, side=side: 1.0 + (side * p[..., 1] > 0)))
        across = ways[0, 0, :, 1]
        assert float(across.min()) < 0 if side > 0 else float(across.max()) > 0


@pytest.mark.parametrize("native", [True, False])
def test_no_way_on_the_graph_is_cheaper(native: bool) -> None:
    """Relaxing all edges at once finds what Dijkstra finds, on the very same graph."""
    s, margin = random_scene(2, B=3, seed=4), 0.15
    rng = np.random.default_rng(1)
    points = torch.cat((s.start[:, None], s.goal[:, None], torch.as_tensor(rng.uniform(-1, 1, (3, 50, 2)))), dim=1)
    near = torch.as_tensor(rng.integers(0, 52, (3, 52, 8)))
    price = torch.as_tensor(rng.uniform(0.5, 2.0, (3, 52)))
    search = Search(s.centers, s.distances, margin)
    graph = Graph(points, near, search._lengths(points, near))
    if native:
        search = NativeSearch(library_for(points), s.centers, s.distances, margin)
    way, _, found = search.cheapest(graph, price)
    for b in range(3):
        p, o, R = points[b].numpy(), s.centers[b].numpy(), s.distances[b].numpy()
        edges = {}
        for i in range(52):
            edges[i] = {}
            for j in near[b, i].tolist():
                gap = segment_gap(p[i], p[j], o, R)
                if gap > 0:
                    length = np.linalg.norm(p[j] - p[i]) + 1e-6 * np.linalg.norm(p[1] - p[0])
                    dear = 1 + np.clip((margin * R.max() - gap) / (margin * R.max()), 0, 1)
                    edges[i][j] = length * dear * 0.5 * float(price[b, i] + price[b, j])
        best = cheapest_cost(edges, 0, 1)
        assert bool(found[b]) == np.isfinite(best)
        if np.isfinite(best):
            stops = [int(np.abs(p - corner).sum(-1).argmin()) for corner in way[b].numpy()]
            paid = sum(edges[i][j] for i, j in pairwise(stops) if i != j)
            assert paid == pytest.approx(best, rel=1e-6)


def test_gaps_of_segments_and_points_along_a_way() -> None:
    rng = np.random.default_rng(2)
    a, b, o = (rng.uniform(-1, 1, (2, 6, 3)) for _ in range(3))
    b[0, 0] = a[0, 0]
    R = rng.uniform(0.1, 0.3, (2, 6))
    gaps = segment_gaps(*(torch.as_tensor(v) for v in (a, b, o, R)))
    way, lengths = torch.as_tensor(a), torch.linspace(0, 9, 40, dtype=torch.float64).expand(2, -1)
    along = points_along(way, lengths)
    for i in range(2):
        for e in range(6):
            assert float(gaps[i, e]) == pytest.approx(segment_gap(a[i, e], b[i, e], o[i], R[i]), abs=1e-3)
        for k in range(40):
            np.testing.assert_allclose(along[i, k], point_along(a[i], float(lengths[i, k])), atol=1e-9)
    np.testing.assert_allclose(halton(4, 2), [[1 / 2, 1 / 3], [1 / 4, 2 / 3], [3 / 4, 1 / 9], [1 / 8, 4 / 9]])


def test_distances_from_a_way() -> None:
    rng = np.random.default_rng(5)
    way, points = rng.uniform(-1, 1, (2, 5, 2)), rng.uniform(-1, 1, (2, 7, 2))
    way_ = torch.as_tensor(way)
    apart = squares_from_segments(torch.as_tensor(points), way_[:, :-1], way_[:, 1:]).amin(1).sqrt()
    for b in range(2):
        along = np.concatenate([a + np.linspace(0, 1, 2001)[:, None] * (c - a) for a, c in pairwise(way[b])])
        nearest = np.linalg.norm(points[b, :, None] - along, axis=-1).min(-1)
        np.testing.assert_allclose(apart[b], nearest, atol=1e-3)


@pytest.mark.parametrize(
    "change",
    [dict(nodes=3), dict(spread=12), dict(neighbours=2), dict(hubs=1), dict(margin=1.0), dict(novelty=0.1)],
)
def test_every_option_is_read(change: dict) -> None:
    s, base = random_scene(2, M=20, seed=6), Roadmap(nodes=60, spread=30)
    assert not torch.equal(base.ways(s, 3)[0], replace(base, **change).ways(s, 3)[0])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(nodes=0), "roadmap.nodes"), (dict(spread=0), "roadmap.spread"), (dict(neighbours=0), "roadmap.neigh"),
        (dict(hubs=0), "roadmap.hubs"), (dict(hubs=65), "roadmap.hubs"), (dict(margin=0.0), "roadmap.margin"),
        (dict(novelty=-1.0), "roadmap.novelty"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        Roadmap(**change)


def test_the_default_roadmap_finds_the_holes_of_the_walls() -> None:
    """Around a wall of 12 m by 6 m it is over 26 m from start to goal, through the holes at most 25."""
    setup = compose(["scenario=walls", "seed=5"])
    problem = setup.task(setup.layouts(8)).problem
    found = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m)))
    ways, arrives = setup.solver.guidance.detour.roadmap.ways(found, 1)
    lengths = [way_length(way) for way in ways[:, 0].numpy()]
    assert arrives.all() and max(lengths) < 25.0
