"""The leaderboard in a headless Chromium: sorted by a click, filtered by words, and deaf to what entries say."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.families.board import BOARD
from tests.referee.boards import HOSTILE, SHAPES, board, enter
from tests.view.browser import Tab
from tests.view.test_browser import check_quiet, check_readable
from torchgco.experiments.referee.board import leaderboard

ROWS = "[...document.querySelectorAll('section')[0].querySelectorAll('tbody tr')].filter((row) => !row.hidden)"

COUNTED = "document.querySelector('.count')?.textContent"  # by the page's own script


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = board(tmp_path_factory.mktemp("a board"))
    enter(folder, "rest", "planar_trap", "walls", name="Rest")
    enter(folder, "moved", "walls", name="Moved", U=np.full(SHAPES["walls"], 0.1), seeds="0 to 9")
    enter(folder, "evil", "walls", name=HOSTILE, hardware=HOSTILE, link="https://example.org")
    return leaderboard(folder).html


def test_rows_are_sorted_and_filtered(chromium: Callable[[], Tab], html: str, tmp_path: Path) -> None:
    tab, file = chromium(), tmp_path / "board.html"
    file.write_text(html)
    tab.size(1000, 700)
    tab.open(file, ready=COUNTED)
    entries = lambda: tab.evaluate(f"{ROWS}.map((row) => row.cells[1].textContent)")
    assert len(entries()) == 4
    for _ in range(2):
        tab.click("th:nth-child(2) button")
    assert entries()[:2] == ["Rest", "Rest"] and entries()[-1] == HOSTILE
    assert tab.evaluate("document.querySelector('th:nth-child(2)').ariaSort") == "descending"
    tab.click("section input")
    for letter in "moved":
        tab.press(letter)
    assert entries() == ["Moved"] and tab.evaluate("document.querySelector('.count').textContent") == "1 of 4 rows"
    assert tab.evaluate("document.title") == "Leaderboard", "no script of an entry ran"
    for dark in (False, True):  # a phone
        tab.dark(dark)
        tab.size(360, 640)
        assert tab.evaluate("document.documentElement.scrollWidth") <= 360
        check_readable(tab)
    tab.evaluate("(() => { const field = document.querySelector('input'); field.value = ''; "
                 "field.dispatchEvent(new Event('input')); "
                 "document.querySelector('.room').scrollLeft = 600; })()")  # fmt: skip
    entry = tab.evaluate("(() => { const r = document.querySelector('td:nth-child(2)').getBoundingClientRect(); "
                         "return [r.left, r.height, document.querySelector('.room').scrollLeft]; })()")  # fmt: skip
    assert 0 <= entry[0] < 360 and entry[2] > 0, "whose row it is stays in sight"
    assert entry[1] < 200, "long texts make rows wide, not tall"
    check_quiet(tab)


def test_the_first_entries_are_shown(chromium: Callable[[], Tab]) -> None:
    tab = chromium()
    tab.size(1200, 800)
    tab.open(BOARD / "board.html", ready=COUNTED)
    assert tab.evaluate(f"{ROWS}.length") == len((BOARD / "board.csv").read_text().splitlines()) - 1
    tab.click("th:nth-child(3) button")
    assert tab.evaluate("document.querySelector('th:nth-child(3)').ariaSort") == "ascending"
    check_quiet(tab)


def test_nothing_runs_even_where_a_text_were_not_escaped(
    chromium: Callable[[], Tab], html: str, tmp_path: Path
) -> None:
    """The page's own policy forbids it."""
    tab, file = chromium(), tmp_path / "board.html"
    file.write_text(html.replace("<h1>", f"{HOSTILE}<h1>"))
    tab.open(file, ready=COUNTED)
    assert tab.evaluate("document.title") == "Leaderboard"
    assert tab.evaluate(f"document.body.textContent.includes({json.dumps('seen')})")
    assert tab.evaluate("document.querySelector('.count').textContent") == "4 of 4 rows"
