"""Plan, safe plan, path sought and sensed map of missions on the page, in a headless Chromium."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.view.browser import Tab
from tests.view.scenes import DT, SOLVERS, N, document, sensed, trajectories
from tests.view.test_browser import alike, pixels, place
from tests.view.test_packing import part
from torchgco.view.page import page
from torchgco.view.sensed import corners

PURPLE = (106, 76, 147)
SEEN = "torchgcoView.flights.all[0].parts.seen"
PARTS = ("plan", "safe", "sought", "sensed")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(page(document(2, mission=True)))
    return path


@pytest.fixture(scope="module")
def opened(chromium: Callable[[], Tab]) -> Tab:
    tab = chromium()
    tab.size(900, 600)
    return tab


@pytest.fixture
def tab(opened: Tab, file: Path) -> Iterator[Tab]:
    opened.errors.clear()
    opened.open(file)
    opened.click("#view-above")
    yield opened
    assert opened.errors == []


def kept(state: np.ndarray) -> np.ndarray:
    """The states that the page has: the vehicle flies between 0 and 1.2 m; of lower cells one gets occupied."""
    found = np.zeros_like(state)
    found[:, :, 2:], found[5, 6, 1] = state[:, :, 2:], state[5, 6, 1]
    return found


def at(tab: Tab, k: int) -> None:
    tab.evaluate(f"torchgcoView.setTime({k * DT + 1e-6})")


def test_the_map_is_kept_as_it_was_seen(file: Path) -> None:
    (flight, other) = part(file.read_text(), "part-0")["flights"]
    held, log = flight["sensed"], sensed().seen
    assert "sensed" not in other and held["shape"] == list(log.shape) and held["resolution"] == 1.0
    assert len(held["counts"]) == len(log.changes)
    state, first, size = np.zeros(log.shape, np.uint8), 0, int(np.prod(log.shape))
    for k, count in enumerate(held["counts"]):
        changes = held["changes"][first : first + count]
        state.reshape(-1)[changes % size] = changes // size
        first += count
        np.testing.assert_array_equal(state, kept(log.state(k)))
    path = held["paths"][held["corners"][:3].sum() :][: held["corners"][3]]
    np.testing.assert_allclose(path, sensed().sought[3][[0, 2]], atol=2e-3)  # the middle one is no corner
    assert held["safe"] == [1, 0] * (N // 2) + [1]


def test_corners_are_where_a_path_turns() -> None:
    path = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 1, 0], [5, 2, 0], [5, 2, 1]])
    np.testing.assert_array_equal(corners(path), path[[0, 2, 4, 5]])
    assert corners(path[:2]).shape == (2, 3) and corners(np.array([[0.0, 0], [1, 0], [0, 0]])).shape == (3, 2)


def test_the_map_goes_with_the_time_in_both_directions(tab: Tab) -> None:
    log = sensed().seen
    for k in (0, 12, 25, 35, 11, 2, N):
        at(tab, k)
        state = kept(log.state(k))
        assert tab.evaluate(f"Array.from({SEEN}.state)") == state.reshape(-1).tolist(), k
        assert tab.evaluate(f"{SEEN}.boxes.boxes.length") == int((state == 2).sum())
        level = int(float(trajectories()[SOLVERS[0]][0, k, 2]) + 2)
        data = np.array(tab.evaluate(f"Array.from({SEEN}.texture.image.data)")).reshape(8, 10, 4)
        np.testing.assert_array_equal(data[..., 3] > 0, (state[:, :, level] == 1).T)
    center = tab.evaluate(f"({SEEN}.show(12), Array.from({SEEN}.boxes.geometry.attributes.middle.array.slice(0, 3)))")
    np.testing.assert_allclose(center, [4.5, 2.5, -0.5])


def test_occupied_cells_are_filled_once(tab: Tab) -> None:
    rng, shape = np.random.default_rng(0), sensed().seen.shape
    for share in (0.1, 0.5, 1.0):
        cells = rng.random(shape) < share
        numbers = rng.permutation(np.flatnonzero(cells)).tolist()
        boxes = tab.evaluate(f"({SEEN}.boxes.fill(new Set({numbers})), {SEEN}.boxes.boxes)")
        filled = np.zeros(shape, dtype=int)
        for low, high in boxes:
            filled[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] += 1
        np.testing.assert_array_equal(filled, cells)
    assert len(boxes) == 1
    half = np.array(tab.evaluate(f"Array.from({SEEN}.boxes.geometry.attributes.sides.array.slice(0, 3))"))
    np.testing.assert_allclose(2 * half, shape)


def test_the_map_is_seen_and_can_be_hidden(tab: Tab) -> None:
    at(tab, 12)
    spots = [place(tab, [x, y, 1.5]) for x, y in ((0.5, 0.7), (0.5, 2.5))]  # on a free cell, and on an unknown one
    free, unknown = (np.s_[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3] for x, y in spots)
    shown = pixels(tab)
    assert alike(shown, PURPLE).sum() > 60
    tab.click("#sensed")
    hidden = pixels(tab)
    changed = np.abs(hidden - shown).max(axis=-1)
    assert alike(hidden, PURPLE).sum() < 20 and changed[free].min() > 10 > changed[unknown].max()
    at(tab, 35)
    tab.click("#sensed")
    assert alike(pixels(tab), PURPLE).sum() < 20  # the cell has become free


def test_each_part_has_a_switch(tab: Tab) -> None:
    at(tab, 12)
    before = pixels(tab)
    for name in PARTS:
        assert tab.evaluate(f"document.getElementById('{name}').labels[0].innerText.length") > 3
        tab.click(f"#{name}")
        without = pixels(tab)
        assert (np.abs(without - before).max(axis=-1) > 12).sum() > 25, name
        tab.click(f"#{name}")
        assert (np.abs(pixels(tab) - before).max(axis=-1) > 12).sum() < 10, name


def test_the_plan_is_that_of_the_period_and_its_sweep_only_where_it_is_safe(tab: Tab) -> None:
    path = trajectories()[SOLVERS[0]][0].numpy()
    for k in (12, 13):
        at(tab, k)
        attribute = "torchgcoView.flights.all[0].parts.plan.children[0].geometry.attributes.position"
        points = np.array(tab.evaluate(f"Array.from({attribute}.array)")).reshape(-1, 3)
        np.testing.assert_allclose(points, path[k] + np.linspace([0, 0, 0], [0, 2, 0], 9), atol=3e-3)
        safe = tab.evaluate("torchgcoView.flights.all[0].parts.safe.ball.visible")
        assert safe is (k % 2 == 0)
