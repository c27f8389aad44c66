"""Paths between spheres: free, short, found where there is one, and the cheapest of their graph."""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.reference.graph_search import TorchSearch, squares_from_segments
from tests.reference.roadmap import cheapest_cost, path_length, point_along, segment_gap
from tests.search.scenes import NONE, inflated
from tests.slow import mostly
from torchgco import InputError, compose
from torchgco.roadmap.cheapest import Graph, GraphSearch, library_for
from torchgco.roadmap.geometry import Scene, points_along, scene_of
from torchgco.roadmap.roadmap import HALTON_NEIGHBOURS, Roadmap, halton


def flat(points, rows):
    """Every metre costs the same."""
    return torch.ones_like(points[..., 0])


def segment_gaps(a: torch.Tensor, b: torch.Tensor, centers: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
    """Smallest distance (B, E) of the segments a to b (B, E, d) from spheres."""
    return (squares_from_segments(centers, a, b).sqrt() - radii.unsqueeze(1)).amin(-1)


def scene(centers, distances, start=(-1.0, 0.0), goal=(1.0, 0.0), price=flat) -> Scene:
    o, R = torch.as_tensor(centers, dtype=torch.float64), torch.as_tensor(distances, dtype=torch.float64)
    ends = (torch.tensor(end, dtype=torch.float64).expand(o.shape[0], -1) for end in (start, goal))
    return Scene(*ends, inflated(o, R), price)


def present(s: Scene, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres and radii of the spheres of problem b."""
    spheres = s.obstacles.spheres
    here = ~spheres.absent[b]
    return spheres.centers[b, here].numpy(), spheres.radii[b, here].numpy()


def random_scene(d: int, B: int = 5, M: int = 12, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    start, goal = (-1.0,) + (0.0,) * (d - 1), (1.0,) + (0.1,) * (d - 1)
    o, R = rng.uniform(-0.7, 0.7, (B, M, d)), rng.uniform(0.1, 0.2, (B, M))
    R[1, ::2] = NONE
    return scene(o, R, start, goal)


def ring(open_at: int | None = None) -> Scene:
    """Ten overlapping discs in a ring around the goal; the disc `open_at` is absent."""
    angle = np.arange(10) * 0.2 * np.pi
    o = np.stack((1.0 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)), axis=-1)
    R = np.full(10, 0.17)
    if open_at is not None:
        R[open_at] = NONE
    return scene(o[None], R[None])


@pytest.mark.parametrize("d", [2, 3])
def test_paths_are_free_and_lead_from_start_to_goal(d: int) -> None:
    s = random_scene(d)
    paths, found = Roadmap().paths(s, 3)
    assert bool(found.all())
    for i in range(3):
        path = paths[:, i]
        assert torch.equal(path[:, 0], s.start) and torch.equal(path[:, -1], s.goal)
        for b in range(s.start.shape[0]):
            for a, c in pairwise(path[b].numpy()):
                assert segment_gap(a, c, *present(s, b), 201) > -1e-9


def test_further_paths_differ() -> None:
    """The second path passes the disc on its other side and is longer; the first does not depend on their number."""
    s = scene([[[0.0, 0.1]]], [[0.4]])
    paths, _ = Roadmap().paths(s, 2)
    assert torch.equal(paths[:, :1], Roadmap().paths(s)[0])
    assert float(paths[0, 0, :, 1].min()) < -0.3 and float(paths[0, 1, :, 1].max()) > 0.4
    assert path_length(paths[0, 0].numpy()) < path_length(paths[0, 1].numpy())


def test_a_single_path_is_returned_again() -> None:
    paths, found = Roadmap().paths(ring(open_at=3), 2)
    middle = torch.tensor([1.0 + 0.5 * np.cos(0.6 * np.pi), 0.5 * np.sin(0.6 * np.pi)])
    path = points_along(paths[:, 1], torch.linspace(0, 3, 400, dtype=torch.float64)[None])
    assert bool(found) and float((path[0] - middle).square().sum(-1).sqrt().min()) < 0.17


def test_the_path_around_one_disc_is_nearly_shortest() -> None:
    R = 0.4
    paths, found = Roadmap().paths(scene([[[0.0, 0.0]]], [[R]]))
    tangents, arc = 2 * np.sqrt(1 - R**2), R * (np.pi - 2 * np.arccos(R))
    assert bool(found) and tangents + arc < path_length(paths[0, 0].numpy()) < 1.05 * (tangents + arc)


def test_a_free_line_is_straight() -> None:
    paths, _ = Roadmap().paths(scene([[[0.0, 0.9]]], [[0.2]]))
    assert path_length(paths[0, 0].numpy()) == pytest.approx(2.0, abs=1e-9)


def test_no_path_into_a_closed_ring_and_one_through_its_gap() -> None:
    assert not bool(Roadmap().paths(ring())[1])
    for gap in (0, 3, 5):
        paths, found = Roadmap().paths(ring(open_at=gap))
        path = paths[:, 0]
        middle = torch.tensor([1.0 + 0.5 * np.cos(0.2 * np.pi * gap), 0.5 * np.sin(0.2 * np.pi * gap)])
        assert bool(found)
        path = points_along(path, torch.linspace(0, path_length(path[0].numpy()), 400, dtype=torch.float64)[None])
        assert float((path[0] - middle).square().sum(-1).sqrt().min()) < 0.17


def test_the_way_past_a_long_row_of_discs_is_found() -> None:
    """A wall of more discs than the graph has points around obstacles; one end is near, the other far."""
    centers = np.stack((np.zeros(170), np.linspace(-20.0, 4.0, 170)), axis=-1)
    paths, found = Roadmap().paths(scene(centers[None], np.full((1, 170), 0.5)))
    assert bool(found)
    assert 2.0 * np.hypot(1.0, 4.5) < path_length(paths[0, 0].numpy()) < 11.0


def test_a_narrowly_closed_gap_is_open_with_max_overlap() -> None:
    """Ten discs around the goal that overlap by 10 % of their radius."""
    closed = ring()
    assert not bool(Roadmap(max_overlap=0.02).paths(closed)[1].any())
    paths, found = Roadmap(max_overlap=0.12).paths(closed)
    assert bool(found.all())
    gaps = segment_gaps(paths[:, 0, :-1], paths[:, 0, 1:], closed.obstacles.spheres.centers, closed.obstacles.sizes)
    assert float(gaps.min()) > -0.12 * 0.17


def test_a_path_goes_where_a_metre_is_cheap() -> None:
    o, R = [[[0.0, 0.0]]], [[0.4]]
    for side in (1.0, -1.0):
        paths, _ = Roadmap().paths(scene(o, R, price=lambda p, rows, side=side: 1.0 + (side * p[..., 1] > 0)))
        across = paths[0, 0, :, 1]
        assert float(across.min()) < 0 if side > 0 else float(across.max()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("native", mostly([True, False], False))
def test_no_path_on_the_graph_is_cheaper(native: bool) -> None:
    """The search finds a path of the same cost as Dijkstra on the same graph."""
    s, margin = random_scene(2, B=3, seed=4), 0.15
    rng = np.random.default_rng(1)
    points = torch.cat((s.start[:, None], s.goal[:, None], torch.as_tensor(rng.uniform(-1, 1, (3, 50, 2)))), dim=1)
    near = torch.as_tensor(rng.integers(0, 52, (3, 52, 8)))
    price = torch.as_tensor(rng.uniform(0.5, 2.0, (3, 52)))
    search = TorchSearch(s.obstacles, margin)
    graph = Graph(points, near, search._lengths(points, near))
    if native:
        search = GraphSearch(library_for(2), s.obstacles, margin)
    path, _, found = search.cheapest(graph, price)
    for b in range(3):
        p, (o, R) = points[b].numpy(), present(s, b)
        edges = {}
        for i in range(52):
            edges[i] = {}
            for j in near[b, i].tolist():
                gap = segment_gap(p[i], p[j], o, R)
                if gap > 0:
                    length = np.linalg.norm(p[j] - p[i]) + 1e-6 * np.linalg.norm(p[1] - p[0])
                    factor = 1 + np.clip((margin * R.max() - gap) / (margin * R.max()), 0, 1)
                    edges[i][j] = length * factor * 0.5 * float(price[b, i] + price[b, j])
        best = cheapest_cost(edges, 0, 1)
        assert bool(found[b]) == np.isfinite(best)
        if np.isfinite(best):
            stops = [int(np.abs(p - corner).sum(-1).argmin()) for corner in path[b].numpy()]
            paid = sum(edges[i][j] for i, j in pairwise(stops) if i != j)
            assert paid == pytest.approx(best, rel=1e-6)


def test_gaps_of_segments_and_points_along_a_path() -> None:
    rng = np.random.default_rng(2)
    a, b, o = (rng.uniform(-1, 1, (2, 6, 3)) for _ in range(3))
    b[0, 0] = a[0, 0]
    R = rng.uniform(0.1, 0.3, (2, 6))
    gaps = segment_gaps(*(torch.as_tensor(v) for v in (a, b, o, R)))
    path, lengths = torch.as_tensor(a), torch.linspace(0, 9, 40, dtype=torch.float64).expand(2, -1)
    along = points_along(path, lengths)
    for i in range(2):
        for e in range(6):
            assert float(gaps[i, e]) == pytest.approx(segment_gap(a[i, e], b[i, e], o[i], R[i]), abs=1e-3)
        for k in range(40):
            np.testing.assert_allclose(along[i, k], point_along(a[i], float(lengths[i, k])), atol=1e-9)
    np.testing.assert_allclose(halton(4, 2), [[1 / 2, 1 / 3], [1 / 4, 2 / 3], [3 / 4, 1 / 9], [1 / 8, 4 / 9]])


def test_distances_from_a_path() -> None:
    rng = np.random.default_rng(5)
    path, points = rng.uniform(-1, 1, (2, 5, 2)), rng.uniform(-1, 1, (2, 7, 2))
    path_ = torch.as_tensor(path)
    apart = squares_from_segments(torch.as_tensor(points), path_[:, :-1], path_[:, 1:]).amin(1).sqrt()
    for b in range(2):
        along = np.concatenate([a + np.linspace(0, 1, 2001)[:, None] * (c - a) for a, c in pairwise(path[b])])
        nearest = np.linalg.norm(points[b, :, None] - along, axis=-1).min(-1)
        np.testing.assert_allclose(apart[b], nearest, atol=1e-3)


# One other value for every option and every constant of the graph.
CHANGES = dict(num_halton=12, max_overlap=0.3)
CONSTANTS = dict(NODES=3, NEIGHBOURS=2, HALTON_NEIGHBOURS=1, MARGIN=1.0, DIVERSITY=0.1)


@pytest.mark.parametrize("name", CHANGES)
def test_every_option_is_read(name: str) -> None:
    s, base = random_scene(2, M=20, seed=6), Roadmap(num_halton=30)
    other = replace(base, **{name: CHANGES[name]})
    assert not torch.equal(base.paths(s, 3)[0], other.paths(s, 3)[0])


def test_no_option_is_forgotten_above() -> None:
    assert {f.name for f in fields(Roadmap)} == set(CHANGES)


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_constant_is_read(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    s, roadmap = random_scene(2, M=20, seed=6), Roadmap(num_halton=30)
    monkeypatch.setattr("torchgco.roadmap.roadmap.NODES", 60)
    usual = roadmap.paths(s, 3)[0]
    monkeypatch.setattr(f"torchgco.roadmap.roadmap.{name}", CONSTANTS[name])
    assert not torch.equal(usual, roadmap.paths(s, 3)[0])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(num_halton=HALTON_NEIGHBOURS - 1), "roadmap.num_halton"),
        (dict(max_overlap=-0.01), "roadmap.max_overlap"), (dict(max_overlap=1.0), "roadmap.max_overlap"),
        (dict(max_overlap=float("nan")), "roadmap.max_overlap"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        Roadmap(**change)


def test_as_many_halton_points_as_a_point_has_edges_to_are_enough() -> None:
    assert bool(Roadmap(num_halton=HALTON_NEIGHBOURS).paths(random_scene(3))[1].all())


def test_the_default_roadmap_finds_the_holes_of_the_walls() -> None:
    """Paths through the holes are shorter than 25 m, those around a wall of 12 m by 6 m longer than 26 m."""
    setup = compose(["scenario=walls", "seed=5"])
    problem = setup.task(setup.layouts(8)).problem
    found = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m)))
    paths, arrives = setup.solver.passes.paths.roadmap.paths(found, 1)
    lengths = [path_length(path) for path in paths[:, 0].numpy()]
    assert arrives.all() and max(lengths) < 25.0


def test_a_way_through_several_doors_is_found() -> None:
    """The nearest points of each door's points are all next to the same wall: the second search joins more."""
    setup = compose(["scenario=mazes", "scenario.loose=0", "study.layouts=8", "solver=gco"])
    problem = setup.task(setup.layouts()).problem
    found = scene_of(problem, problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m)))
    paths, arrives = setup.solver.passes.paths.roadmap.paths(found, 1)
    lengths = [path_length(path) for path in paths[:, 0].numpy()]
    assert arrives.all() and max(lengths) < 40.0  # around the walls: over 55
