"""The general benchmark: families that can be drawn, starts, the judge, and whole tables."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks.families import general, general_exact, general_peers
from benchmarks.families.general_problems import FAMILIES
from benchmarks.families.general_starts import STARTS, digest, judged, starts
from benchmarks.families.general_tables import FAMILY_HEAD, SET_HEAD, better, references_of, within, worse
from benchmarks.lib.kept import append, rows_of
from tests.slow import mostly


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", mostly(FAMILIES, "springs30_long", *list(FAMILIES)[1::2]))
def test_a_family_is_drawn_by_its_seed(name: str) -> None:
    family = FAMILIES[name]
    drawn, same, other = (family.drawn(seed) for seed in (7, 7, 8))
    one = drawn.problem
    assert one.B == family.B and drawn.end.shape == one.x0.shape
    assert torch.equal(one.x0, same.problem.x0) and torch.equal(drawn.end, same.end)
    X, U = (torch.full((one.B, one.N + k, size), 0.1, dtype=torch.float64) for k, size in ((1, one.n), (0, one.m)))
    rows = [[part.value(X, U) for part in p.constraints] for p in (one, same.problem, other.problem)]
    assert all(map(torch.equal, rows[0], rows[1]))
    moves = [[p.x0, p.dynamics.step(p.x0, U[:, 0])] for p in (one, other.problem)]
    assert not all(map(torch.equal, [*moves[0], *rows[0]], [*moves[1], *rows[2]]))


def test_there_are_four_sets() -> None:
    counts = [sum(family.B for family in FAMILIES.values() if family.set == number) for number in (1, 2, 3, 4)]
    assert counts == [80, 104, 160, 20]


def test_the_judge_rolls_controls_out() -> None:
    problem = FAMILIES["time_optimal_di"].problem(1)
    U = torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)
    U[..., 0] = 2.0
    counted = judged(problem, U)
    t = 60 * 0.042
    # The end is further from 0 than the control from its bound, and its place further than its speed 2 t.
    assert torch.allclose(counted["violation"], problem.x0[:, 0] + 0.5 * 2.0 * t**2, rtol=1e-12)
    assert torch.allclose(counted["cost"], torch.full_like(counted["cost"], t * (1 + 4e-5)), rtol=1e-12)


def test_the_nine_starts_begin_at_the_start_and_lead_on() -> None:
    drawn = FAMILIES["u_trap"].drawn(2)
    found = dict(starts(drawn, 2))
    assert tuple(found) == STARTS
    for X, U in found.values():
        assert torch.equal(X[:, 0], drawn.problem.x0) and torch.isfinite(X).all() and (U.abs() <= 2).all()
    for name in ("line", "left", "right"):
        assert torch.allclose(found[name][0][:, -1], drawn.end)
    (left, _), (right, _), (line, _) = (found[name] for name in ("left", "right", "line"))
    assert torch.allclose(0.5 * (left + right), line) and bool((left[:, 40, 1] > line[:, 40, 1] + 0.5).all())


@pytest.mark.slow
def test_a_table_without_peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(general, "OUTPUTS", tmp_path)
    names = ["bryson_denham", "time_optimal_di"]
    text = general.table(["gco", "hold"], [3], names, 0, 30, 0, peers=tmp_path / "none.csv")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    counts = {(row[0], row[1]): row[2:5] for row in cells if len(row) == len(SET_HEAD)}
    assert counts["all", "gco"][0] == "16" and counts["all", "gco"][2].startswith("16 of 16")
    assert counts["all", "hold"][2].startswith("0 of 16")
    assert len([row for row in cells if row[0] in names and len(row) == len(FAMILY_HEAD)]) == 4
    assert len(list(tmp_path.iterdir())) == 4


def test_peers_are_those_of_the_problems_as_they_are_drawn(tmp_path: Path) -> None:
    file, family = tmp_path / "peers.csv", FAMILIES["bryson_denham"]
    digests = digest(family.problem(0))
    base = {"family": family.name, "seed": 0, "violation": 1e-9, "rolled": 1e-9, "seconds": 0.5, "iterations": 9}
    rows = [
        ("ipopt", "rest", "SOLVED", 2.0), ("ipopt", "held", "SOLVED", 1.0), ("ipopt", "line", "TIME_LIMIT", 0.1),
        ("ipopt", "left", "LEFT_OUT", float("nan")), ("fatrop", "rest", "SOLVED", 2.0),
    ]  # fmt: skip
    for peer, start, status, cost in rows:
        own = {"peer": peer, "start": start, "status": status, "cost": cost}
        append(file, general_peers.COLUMNS, base | own | {"instance": 0, "digest": digests[0]})
        append(file, general_peers.COLUMNS, base | own | {"instance": 1, "digest": "changed"})
    known = general_peers.known_of(family.name, 0, digests, file)
    assert set(known.instance) == {0} and len(known) == 5
    (found,) = references_of(known).to_dict("records")
    assert (found["best"], found["rest"], found["fatrop"], found["best_starts"]) == (1.0, 2.0, 2.0, 3)
    own = {"family": family.name, "instance": 0, "solver": "a", "seconds": 1.0, "alone": 1.0, "best": 1.0, "rest": 2.0}
    flights = pd.DataFrame([own | {"cost": cost, "violation": v} for cost, v in ((1.005, 1e-4), (1.5, 1e-9), (0.5, 1))])
    assert within(flights, "best", 0.01).tolist() == [True, False, False]
    assert better(flights).tolist() == [False, True, False] and not worse(flights).any()
    assert worse(flights.assign(rest=1.0)).tolist() == [True, True, False]


def test_kept_peers_are_of_known_families() -> None:
    rows = rows_of(general_peers.FILE, general_peers.COLUMNS)
    assert set(rows.family) <= set(FAMILIES) and set(rows.start) <= set(STARTS)
    assert not rows.duplicated(["family", "seed", "instance", "digest", "peer", "start"]).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["parking_lot", "time_optimal_car"])
def test_what_is_solved_exactly_is_stationary_by_the_certificate(name: str) -> None:
    """Searches kept results to a looser tolerance (1e-5), and rollouts amplified rounding (1e-7)."""
    rows = general_exact.flown(FAMILIES[name], 0, 1)
    assert bool((rows.kkt <= general_exact.WANTED).all()) and bool((rows.violation <= general_exact.WANTED).all())
