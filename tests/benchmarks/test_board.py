"""The first entries of the leaderboard."""

from __future__ import annotations

from html import escape

import numpy as np
import pandas as pd
import pytest

from benchmarks.families.board import BOARD, METHODS, table
from tests.slow import mostly
from torchgco.experiments.referee.board import Scene, leaderboard
from torchgco.experiments.referee.entries import Entry, entries_of, layouts_of

COUNTS = ["layouts", "entry", "n", "reached_count", "success_count", "feasible_count"]
PAIRS = [(name, entry) for name in ("planar_trap", "walls") for entry in METHODS]


def test_its_page_and_table_have_all_entries_on_all_layouts() -> None:
    entries = [Entry.read(folder) for folder in entries_of(BOARD)]
    names = [path.stem for path in layouts_of(BOARD)]
    assert {entry.id for entry in entries} >= set(METHODS) and len(names) == 5
    board, html = pd.read_csv(BOARD / "board.csv"), (BOARD / "board.html").read_text()
    assert len(board) == sum(len(entry.files(names)) for entry in entries)
    assert html.count("<tr><td>") == len(board) + len(entries)
    for entry in entries:
        assert f"<td>{escape(entry.name)}</td>" in html and entry.method and "at " in entry.version
    lines = table(BOARD / "board.csv").splitlines()
    assert len(lines) == len(board) + 2 and lines[2].startswith("| forest30 | ")


@pytest.mark.parametrize(("name", "entry"), mostly(PAIRS, *PAIRS[1:], several=True))
def test_its_numbers_are_those_of_the_controls(name: str, entry: str) -> None:
    board = pd.read_csv(BOARD / "board.csv").set_index(["layouts", "entry"])
    scene = Scene.read(BOARD / "layouts" / f"{name}.npz")
    trials = scene.judged(scene.controls(BOARD / "entries" / entry / f"{name}.npz"))
    assert trials["reached"].sum() == board.loc[(name, entry), "reached_count"]
    np.testing.assert_allclose(trials["seconds"].median(), board.loc[(name, entry), "seconds_median"], rtol=1e-6)


@pytest.mark.slow
def test_the_leaderboard_is_that_of_its_entries() -> None:
    made = leaderboard(BOARD)
    assert not made.refused
    pd.testing.assert_frame_equal(made.table[COUNTS], pd.read_csv(BOARD / "board.csv")[COUNTS], check_dtype=False)
