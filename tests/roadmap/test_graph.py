"""The roadmap's search returns the paths of a plain one in PyTorch, also where several cost the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference.graph_search import TorchSearch, searched_by_torch
from tests.search.scenes import NONE, inflated
from tests.slow import mostly
from torchgco.base.tree import cast, take
from torchgco.kernels import EagerWarning
from torchgco.obstacles.base import Solids
from torchgco.roadmap import cheapest, native_maps
from torchgco.roadmap.cheapest import HOPS, Graph, GraphSearch, library_for
from torchgco.roadmap.geometry import Inflated, Scene
from torchgco.roadmap.roadmap import Roadmap, halton

B = 3


def uneven(points: Tensor, rows: slice) -> Tensor:
    """A metre costs more to the right and farther out."""
    return 0.1 + (points[..., 0] + 1.0).square() + 0.3 * points[..., 1].abs()


def flat(points: Tensor, rows: slice) -> Tensor:
    return torch.ones_like(points[..., 0])


def scene(centers, distances, start, goal, price=uneven) -> Scene:
    """B problems with the same start and goal, among shared spheres (M, d) or their own (B, M, d)."""
    o, R = (torch.as_tensor(np.asarray(v, dtype=float)) for v in (centers, distances))
    ends = (torch.tensor(end, dtype=torch.float64).expand(B, -1) for end in (start, goal))
    return Scene(*ends, inflated(o.expand(B, *o.shape[-2:]), R.expand(B, R.shape[-1])), price)


def drawn(d: int, M: int, seed: int) -> Scene:
    """Spheres of several sizes, some of them absent."""
    rng = np.random.default_rng(seed)
    R = rng.uniform(0.02, 0.7, (B, M)) * M ** (-1 / d)
    R[rng.uniform(size=R.shape) < 0.2] = NONE
    start, goal = (-1.0,) + (0.0,) * (d - 1), (1.0, *rng.uniform(-0.3, 0.3, d - 1))
    return scene(rng.uniform(-0.8, 0.8, (B, M, d)), R, start, goal)


def lattice(d: int) -> Scene:
    """Spheres of one size on a grid, start and goal on its diagonal: every path has a mirror image of equal cost."""
    axis = np.linspace(-0.6, 0.6, 4)
    o = np.stack(np.meshgrid(*[axis] * d), axis=-1).reshape(-1, d)
    return scene(o, np.full(len(o), 0.15), (-1.0,) * d, (1.0,) * d, flat)


def ring() -> Scene:
    angle = np.arange(10) * 0.2 * np.pi
    o = np.stack((1.0 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)), axis=-1)
    return scene(o, np.full(10, 0.17), (-1.0, 0.0), (1.0, 0.0))


SCENES = {
    **{f"drawn {d}-D, {M} spheres": drawn(d, M, M) for d in (2, 3) for M in (1, 2, 3, 5, 12, 100)},
    "lattice": lattice(2),
    "lattice in space": lattice(3),
    "no spheres": scene([[0.0, 0.0]] * 3, [NONE] * 3, (-1.0, 0.0), (1.0, 0.0)),
    "no spheres in space": scene([[0.0, 0.0, 0.0]], [NONE], (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)),
    "one before many places": scene([[0.0, 0.0]] + [[9.0, 9.0]] * 40, [0.3] + [NONE] * 40, (-1.0, 0.0), (1.0, 0.0)),
    "in the middle": scene([[0.0, 0.0]], [0.4], (-1.0, 0.0), (1.0, 0.0), flat),
    "in the middle of a diagonal": scene([[0.0, 0.0]], [0.4], (-1.0, -1.0), (1.0, 1.0), flat),
    "in the middle of space": scene([[0.0, 0.0, 0.0]], [0.4], (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), flat),
    "straight up": scene([[0.0, 0.0, 0.0]], [0.4], (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), flat),
    "touched": scene([[0.0, 0.4], [0.5, -0.3]], [0.4, 0.3], (-1.0, 0.0), (1.0, 0.0), flat),
    "touching each other": scene([[0.0, 0.25], [0.0, -0.25]], [0.25, 0.25], (-1.0, 0.0), (1.0, 0.0), flat),
    "one in another": scene([[0.0, 0.0]] * 3 + [[0.1, 0.0]], [0.3, 0.3, 0.2, 0.1], (-1.0, 0.0), (1.0, 0.0), flat),
    "goal at start": scene([[0.5, 0.0]], [0.2], (0.0, 0.0), (0.0, 0.0)),
    "goal at start in space": scene([[0.5, 0.0, 0.0], [0.0, 0.4, 0.0]], [0.2, 0.1], (0.0,) * 3, (0.0,) * 3),
    "goal at start, no spheres": scene([[0.5, 0.0]], [NONE], (0.0, 0.0), (0.0, 0.0)),
    "start inside": scene([[-1.0, 0.1], [0.0, 0.0]], [0.3, 0.3], (-1.0, 0.0), (1.0, 0.0)),
    "no path": ring(),
}


def both(roadmap: Roadmap, s: Scene, count: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    first = roadmap.paths(s, count)
    with searched_by_torch():
        return first, roadmap.paths(s, count)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", mostly(SCENES, *(f"drawn {d}-D, {M} spheres" for d in (2, 3) for M in (2, 5, 12))))
@pytest.mark.parametrize("size", mostly(["usual", "small"], "small"))
def test_both_return_the_same_paths(name: str, size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    roadmap = Roadmap(max_overlap=0.02)
    if size == "small":
        roadmap = Roadmap(num_halton=12)
        for constant, value in {"NODES": 9, "NEIGHBOURS": 3, "HALTON_NEIGHBOURS": 5, "MARGIN": 1.0}.items():
            monkeypatch.setattr(f"torchgco.roadmap.roadmap.{constant}", value)
    (paths, found), (expected, expected_found) = both(roadmap, SCENES[name], 4)
    assert torch.equal(found, expected_found)
    torch.testing.assert_close(paths, expected, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_no_path_is_the_straight_line() -> None:
    s = SCENES["no path"]
    for paths, found in both(Roadmap(), s, 2):
        assert not bool(found.any())
        assert torch.equal(paths[:, :, 0], s.start.unsqueeze(1).expand(-1, 2, -1))
        assert torch.equal(paths[:, :, 1:], s.goal[:, None, None].expand(-1, 2, HOPS, -1))


@pytest.mark.parametrize("name", [name for name in SCENES if name.startswith("drawn") or "lattice" in name])
def test_both_make_the_same_graph(name: str) -> None:
    """Compared as matrices of lengths, because the order of a point's edges may differ.

    Midway between two spheres lie two points at one place, up to the rounding of a square root: which of them is nearer
    may differ too, so that an edge to one counts as an edge to the other.
    """
    s = SCENES[name]
    d, made = s.start.shape[1], []
    for search in searches(s.obstacles, 0.15):
        graph = search.graph(s.start, s.goal, halton(20, d), 30, 5, 4)
        lengths = torch.full((B, graph.points.shape[1], graph.points.shape[1]), torch.inf, dtype=torch.float64)
        places = ((graph.points.unsqueeze(2) - graph.points.unsqueeze(1)).abs().amax(-1) < 1e-12).to(torch.uint8)
        ends = places.argmax(-1).gather(1, graph.ends.long().clamp(min=0).flatten(1)).view(graph.ends.shape)
        made.append((graph.points, lengths.scatter_reduce(2, ends, graph.lengths, "amin")))
    torch.testing.assert_close(made[0], made[1], rtol=1e-12, atol=1e-12)


def searches(obstacles: Inflated, margin: float) -> tuple[GraphSearch, TorchSearch]:
    made = library_for(obstacles.spheres.centers.shape[-1])
    assert made is not None
    return GraphSearch(made, obstacles, margin), TorchSearch(obstacles, margin)


def chain(points: int) -> Graph:
    """Start, goal, and points between them in a row, each joined to the next, the last to the goal."""
    p = torch.zeros(1, points, 2, dtype=torch.float64)
    p[0, 1, 0] = points - 1.0
    p[0, 2:, 0] = torch.arange(1, points - 1)
    ends = torch.arange(1, points + 1).clamp(max=points - 1).view(1, -1, 1)
    ends[0, 0], ends[0, 1], ends[0, -1] = min(2, points - 1), 1, 1
    return Graph(p, ends, torch.ones(1, points, 1, dtype=torch.float64))


def no_spheres() -> Inflated:
    return inflated([[[0.0, 0.0]]], [[NONE]])


@pytest.mark.parametrize("edges", [1, 2, HOPS - 1, HOPS, HOPS + 1, HOPS + 2])
def test_a_path_has_at_most_hops_edges(edges: int) -> None:
    graph = chain(edges + 1)
    for search in searches(no_spheres(), 0.15):
        path, string, arrives = search.cheapest(graph, torch.ones(1, edges + 1, dtype=torch.float64))
        assert bool(arrives) == (edges <= HOPS)
        corners = min(edges, HOPS) if edges <= HOPS else 1
        assert path[0, : corners + 1, 0].tolist() == torch.linspace(0, edges, corners + 1).tolist()
        assert torch.equal(string[0, :2], path[0, [0, -1]]) and torch.equal(string[0, 3::2], path[0, 1:-1])
        assert torch.equal(string[0, 2::2], 0.5 * (path[0, 1:] + path[0, :-1]))


def test_of_equally_cheap_paths_the_first_is_taken() -> None:
    """Three paths, the first two equal but for rounding; the last is cheaper by rounding (1e-14) or by more (1e-10)."""
    points = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -1.0], [1.0, 2.0]]], dtype=torch.float64)
    ends = torch.tensor([[[2, 3, 4], [1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 1, 1]]])
    for least, taken in ((1.0 - 1e-14, 2), (1.0 - 1e-10, 4)):
        lengths = torch.ones(1, 5, 3, dtype=torch.float64)
        lengths[0, 0] = torch.tensor([1.0, 1.0 - 1e-15, least], dtype=torch.float64)
        for search in searches(no_spheres(), 0.15):
            path, _, arrives = search.cheapest(Graph(points, ends, lengths), torch.ones(1, 5, dtype=torch.float64))
            assert bool(arrives) and torch.equal(path[0, 1], points[0, taken])


def test_a_nan_price_closes_its_edges() -> None:
    price = torch.ones(1, 5, dtype=torch.float64)
    price[0, 3] = torch.nan
    for search in searches(no_spheres(), 0.15):
        assert not bool(search.cheapest(chain(5), price)[2])


@pytest.mark.slow
def test_a_problem_has_the_same_bits_in_every_batch() -> None:
    parts = [drawn(3, 12, seed) for seed in range(27)]
    ends = (torch.cat([getattr(part, name) for part in parts]) for name in ("start", "goal"))
    columns = zip(*(vars(part.obstacles.spheres).values() for part in parts), strict=True)
    s = Scene(*ends, Inflated(Solids(*map(torch.cat, columns))), uneven)
    whole, found = Roadmap().paths(s, 3)
    assert len(whole) > cheapest.SEARCHES_AT_ONCE
    for rows in (torch.arange(1), torch.tensor([70]), torch.arange(81).flip(0)):
        part = Scene(s.start[rows], s.goal[rows], take(s.obstacles, rows), uneven)
        paths, arrives = Roadmap().paths(part, 3)
        assert torch.equal(paths, whole[rows]) and torch.equal(arrives, found[rows])


def test_no_problems_have_no_paths() -> None:
    s = SCENES["in the middle"]
    none = slice(0, 0)
    for paths, found in both(Roadmap(), Scene(s.start[none], s.goal[none], take(s.obstacles, none), flat), 2):
        assert paths.shape == (0, 2, HOPS + 1, 2) and found.shape == (0,)


def test_scenes_in_single_precision_are_searched_in_double_precision() -> None:
    s = SCENES["in the middle"]
    single = Scene(s.start.float(), s.goal.float(), Inflated(*cast(s.obstacles, torch.float32)), flat)
    paths, found = Roadmap().paths(single)
    assert paths.dtype == torch.float32 and bool(found.all())
    torch.testing.assert_close(paths, Roadmap().paths(s)[0].float(), rtol=0, atol=1e-6)


def test_without_a_library_there_is_no_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    s = SCENES["in the middle"]
    with monkeypatch.context() as patch:
        patch.setenv("TORCHGCO_CC", "none")
        paths, found = Roadmap().paths(s, 2)
    assert not bool(found.any()) and torch.equal(paths[:, :, 1:], s.goal[:, None, None].expand(-1, 2, HOPS, -1))
    (tmp_path / "cheapest.c").write_text("not C code")
    native_maps._library.cache_clear()
    with monkeypatch.context() as patch, pytest.warns(EagerWarning, match=r"no \w+ are sought"):
        patch.setattr(native_maps, "C", tmp_path)
        assert not bool(Roadmap().paths(s)[1].any())
    native_maps._library.cache_clear()
    assert bool(Roadmap().paths(s)[1].all())
