"""Searches that go on from earlier ones in the same scene, against searches from the beginning."""

from __future__ import annotations

import pytest
import torch

from tests.roadmap.test_roadmap import random_scene
from tests.roadmap.test_trunks import trunks
from tests.slow import mostly
from torchgco.roadmap import roadmap as known_searches
from torchgco.roadmap import roadmap as searches
from torchgco.roadmap.geometry import Scene
from torchgco.roadmap.roadmap import Known, Roadmap

SOME = torch.tensor([0, 2, 3])


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Trunks among which some problems need more points, in groups of three problems."""
    monkeypatch.setattr(searches, "LONG", 1.01)
    monkeypatch.setattr(searches, "MANY_NODES", 160)
    monkeypatch.setattr(searches, "MANY_NEIGHBOURS", 16)
    monkeypatch.setattr("torchgco.roadmap.cheapest.SEARCHES_AT_ONCE", 3)
    return trunks(B=5, K=14)[0]


@pytest.mark.slow
@pytest.mark.parametrize("room", mostly([0, 2**26], 2**26))
def test_further_paths_are_those_of_a_search_from_the_beginning(
    scene: Scene, room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_searches, "BYTES_KEPT", room)
    known, one, other = Known(), Roadmap(), Roadmap(num_halton=96)
    first = one.paths(scene, 2, None, known)
    for rows in (SOME, torch.tensor([4]), torch.arange(5)):
        for roadmap in (one, other):
            whole, found = roadmap.paths(scene, 4)
            again = roadmap.paths(scene, 4, rows, known)
            assert torch.equal(again[0], whole[rows]) and torch.equal(again[1], found[rows])
    assert torch.equal(first[0], one.paths(scene, 4)[0][:, :2])


def test_a_search_that_goes_on_makes_no_graph(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    known, roadmap = Known(), Roadmap()
    made = roadmap.paths(scene, 1, None, known)[0]
    assert {
        course.graph.points.shape[1]
        for group in (0, 3)
        for course in known.courses((roadmap, group), torch.arange(group, min(group + 3, 5))) or ()
    } == {2 + 64 + 128, 2 + 64 + 160}
    monkeypatch.setattr("torchgco.roadmap.cheapest.GraphSearch.graph", None)
    assert torch.equal(roadmap.paths(scene, 3, SOME, known)[0][:, :1], made[SOME])


def test_without_boxes_there_are_no_points_around_them() -> None:
    s = random_scene(3)
    assert Known().beside(0, SOME, s.obstacles, s) is None
    assert torch.equal(Roadmap().paths(s, 2, SOME)[0], Roadmap().paths(s.take(SOME), 2)[0])


def test_two_threads_find_the_paths_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchgco.roadmap.cheapest.GROUP", 2)
    s, threads = trunks(B=5, K=14)[0], torch.get_num_threads()
    alone = Roadmap().paths(s, 3)
    torch.set_num_threads(2)
    try:
        together = Roadmap().paths(s, 3)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))
