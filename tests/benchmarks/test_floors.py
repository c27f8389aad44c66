"""The benchmark of floor plans: its rows, its intervals, and real maps from a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.families.floors import HEAD, MAPS, PEER, flown_plans, main, median, row_of


@pytest.mark.slow
def test_plans_are_flown_and_counted(capsys, tmp_path: Path) -> None:
    Image.fromarray(np.full((100, 200), 255, np.uint8)).save(tmp_path / "kr_maze1.png")
    words = ["--layouts", "2", "--solvers", PEER, "hold", "--maps", str(tmp_path)]
    assert main([*words, "--picture", str(tmp_path / "floors.png")]) == 0
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines() if line.startswith("| seed")]
    assert [row[:3] for row in rows] == [
        [f"seed {seed}, {what}", f"`{name}`", "2"]
        for seed, what in ((61, "chosen on"), (62, "reported on"))
        for name in (PEER, "hold")
    ]
    by_name = dict(zip(HEAD, rows[0], strict=True)), dict(zip(HEAD, rows[1], strict=True))
    assert by_name[0]["reached"].startswith("2 of 2") and by_name[0]["not reached"] == "-"
    assert by_name[1]["reached"].startswith("0 of 2") and by_name[1]["not reached"] == "0, 1"
    assert "| kr_maze1 | 0.25 |" in out and "berlin |" not in out, "what isn't there is left out"
    with Image.open(tmp_path / "floors.png") as picture:
        assert picture.size[0] > 1000


def test_a_row_compares_where_both_reached() -> None:
    peer = pd.DataFrame(
        {"plan": range(4), "solver": PEER, "cost": 10.0, "reached": [True, True, True, False], "seconds": 0.1}
    )
    own = peer.assign(solver="gco", cost=[9.0, 11.0, 12.0, 5.0], reached=[True, True, False, True], seconds=0.5)
    cells = dict(zip(HEAD, row_of("plans", pd.concat([own, peer]), "gco"), strict=True))
    assert str(cells[HEAD[4]]).startswith("1.000 [") and cells[HEAD[5]] == "1 of 2", "of 0.9 and 1.1"
    assert str(cells[HEAD[6]]).startswith("5 [") and cells["not reached"] == "2"


@pytest.mark.parametrize("n", [9, 30, 48])
def test_the_interval_holds_the_median_as_often_as_it_says(n: int) -> None:
    rng, held = np.random.default_rng(n), 0
    for _ in range(2000):
        ends = median(pd.Series(rng.exponential(size=n)), ".9f").split("[")[1][:-1].split(", ")
        held += float(ends[0]) <= np.log(2.0) <= float(ends[1])
    assert held / 2000 > 0.94
    assert median(pd.Series([], dtype=float), ".3f") == "-"


@pytest.mark.slow
def test_flights_are_of_the_plans_that_the_seed_draws() -> None:
    flights = pd.DataFrame(flown_plans(61, 1, [PEER]))
    again = pd.DataFrame(flown_plans(61, 1, [PEER]))
    assert flights["cost"].tolist() == again["cost"].tolist() and flights["stages"].tolist() == again["stages"].tolist()
    assert all(one.source.count(",") == 1 for one in MAPS), "repository with commit, licence"
