"""Statistics over families of layouts, against slow and obvious maths."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import friedmanchisquare

from tests.experiments.commands import problem_line
from tests.trials import missions, trials
from torchgco.base.errors import InputError
from torchgco.experiments.reports.report import main
from torchgco.experiments.statistics.families import families_text, over_families
from torchgco.plotting.families import families_figure

NAMES = ("gco", "al_ilqr", "hold", "mppi")


def drawn(seed: int, solvers: int, counts: tuple[int, ...], sign: float = 1.0) -> pd.DataFrame:
    """Flights of some solvers in families of so many layouts: ties, losses of every kind, rows in any order."""
    rng, rows = np.random.default_rng(seed), []
    for family, count in enumerate(counts):
        for i in range(count):
            for name in NAMES[:solvers]:
                status = str(
                    rng.choice(["CONVERGED", "CONVERGED", "FEASIBLE", "INFEASIBLE", "ABSENT", "INVALID_START"])
                )
                lost = status not in ("CONVERGED", "FEASIBLE")
                cost = float("nan") if status == "ABSENT" else sign * float(rng.integers(10, 14))
                given = {"scenario": f"f{family}", "layout": i, "solver": name, "status": status, "cost": cost}
                rows.append(given | {"feasible": not lost, "reached": not lost, "success": None, "best_cost": np.nan})
    return trials(*(rows[k] for k in rng.permutation(len(rows))))


def slow(table: pd.DataFrame, names: list[str]) -> dict[str, list[list[float]]]:
    """Ratios of each family by layout and solver, one flight after the other."""
    families: dict[str, list[list[float]]] = {}
    for (family, _), rows in table.groupby(["scenario", "layout"]):
        costs = [rows[rows["solver"] == name].iloc[0] for name in names]
        costs = [float(row["cost"]) if row["reached"] else float("inf") for row in costs]
        least = min(costs)
        ratios = [round(1 + (c - least) / abs(least), 3) if c < float("inf") else float("inf") for c in costs]
        families.setdefault(str(family), []).append(ratios)
    return families


def value(found: pd.DataFrame, statistic: str, solver: str, other: str = "", at: float | None = None) -> float:
    rows = found[(found["statistic"] == statistic) & (found["solver"] == solver) & (found["other"] == other)]
    return float((rows if at is None else rows[rows["at"] == at])["value"].item())


@pytest.mark.parametrize("seed, solvers, counts, sign", [
    (0, 2, (7, 3), 1.0), (1, 3, (4, 9, 2), 1.0), (2, 4, (12,), -1.0), (3, 3, (1, 6), -1.0),
])  # fmt: skip
def test_every_number_is_that_of_a_loop_over_flights(seed: int, solvers: int, counts, sign: float) -> None:
    table = drawn(seed, solvers, counts, sign)
    names = [str(name) for name in table["solver"].unique()]
    families, found = slow(table, names), over_families(table)
    assert (found["families"] == len(counts)).all() and (found["layouts"] == sum(counts)).all()
    for s, name in enumerate(names):
        for at in (1.0, 1.1, float("inf")):
            shares = [np.mean([row[s] <= at and row[s] < np.inf for row in rows]) for rows in families.values()]
            assert value(found, "profile", name, at=at) == pytest.approx(np.mean(shares))
        ranks = [np.mean([sum(r < row[s] for r in row) + 0.5 * sum(r == row[s] for r in row) + 0.5 for row in rows])
                 for rows in families.values()]  # fmt: skip
        assert value(found, "mean_rank", name) == pytest.approx(np.mean(ranks))
        scores = sorted(1 / row[s] for rows in families.values() for row in rows)
        cut = len(scores) // 4
        assert value(found, "interquartile_mean", name) == pytest.approx(np.mean(scores[cut : len(scores) - cut]))
        for o in range(s + 1, solvers):
            wins = [
                np.mean([(row[s] < row[o]) + 0.5 * (row[s] == row[o]) for row in rows]) for rows in families.values()
            ]
            assert value(found, "improvement", name, names[o]) == pytest.approx(np.mean(wins))
    if solvers > 2:
        every = np.array([row for rows in families.values() for row in rows])
        test, row = friedmanchisquare(*every.T), found[found["statistic"] == "friedman"].iloc[0]
        assert row["p_value"] == pytest.approx(test.pvalue)
        assert row["value"] == pytest.approx(test.statistic / (len(every) * (solvers - 1))) and 0 <= row["value"] <= 1


def test_the_order_of_rows_and_the_names_of_families_change_nothing_but_the_seed_does() -> None:
    table = drawn(4, 2, (20, 8))
    ordered = table.sort_values(["solver", "scenario", "layout"], ascending=[False, True, True])
    keys = ["statistic", "solver", "at"]
    one, two = (
        over_families(rows).sort_values(keys) for rows in (ordered, ordered.assign(scenario="g" + table["scenario"]))
    )
    pd.testing.assert_frame_equal(one, two)
    assert not np.array_equal(one["low"], over_families(ordered, seed=1).sort_values(keys)["low"], equal_nan=True)


def test_intervals_are_those_of_a_bootstrap_within_each_family() -> None:
    table = drawn(5, 2, (30, 10))
    names = [str(name) for name in table["solver"].unique()]
    families, found = [np.array(rows) for rows in slow(table, names).values()], over_families(table)
    rng = np.random.default_rng(9)
    samples = []
    for _ in range(4000):
        again = [rows[rng.integers(0, len(rows), len(rows))] for rows in families]
        samples.append(np.mean([np.isfinite(rows[:, 0]).mean() for rows in again]))
    row = found[(found["statistic"] == "profile") & (found["solver"] == names[0]) & (found["at"] == np.inf)].iloc[0]
    np.testing.assert_allclose(row[["low", "high"]].astype(float), np.quantile(samples, [0.025, 0.975]), atol=0.02)


def test_a_family_of_one_layout_has_no_interval() -> None:
    found = over_families(drawn(6, 2, (1, 5)))
    assert found["low"].isna().all() and found["value"].notna().all()


def test_what_no_solver_reached_is_a_loss_for_all_and_equal_solvers_tie() -> None:
    rows = [{"solver": name, "layout": i, "reached": i > 0, "cost": 5.0 + 1e-5 * k, "best_cost": np.nan}
            for k, name in enumerate(NAMES[:3]) for i in range(4)]  # fmt: skip
    found = over_families(trials(*rows))
    assert value(found, "improvement", "gco", "hold") == 0.5 and value(found, "mean_rank", "hold") == 2.0
    assert [value(found, "profile", "gco", at=at) for at in (1.0, np.inf)] == [0.75, 0.75]
    assert found[found["statistic"] == "friedman"][["value", "p_value"]].to_numpy().tolist() == [[0.0, 1.0]]


def test_a_lower_best_cost_counts_and_other_columns_have_none() -> None:
    rows = [{"solver": name, "layout": i, "cost": 10.0, "best_cost": 8.0, "seconds": 1.0 + k}
            for k, name in enumerate(NAMES[:2]) for i in range(3)]  # fmt: skip
    found, seconds = (over_families(trials(*rows), measure) for measure in ("cost", "seconds"))
    assert value(found, "profile", "gco", at=1.01) == 0.0 and value(found, "profile", "gco", at=np.inf) == 1.0
    assert value(found, "interquartile_mean", "gco") == pytest.approx(0.8)
    assert value(seconds, "profile", "gco", at=1.0) == 1.0 and value(seconds, "interquartile_mean", "al_ilqr") == 0.5


def test_missions_are_compared_by_their_time() -> None:
    table = trials(*missions("gco", "RRC"), *missions("al_ilqr", "RCR", flight_time=5.0))
    assert value(over_families(table, "flight_time"), "profile", "gco", at=np.inf) == pytest.approx(2 / 3)


@pytest.mark.parametrize("change, measure, words", [
    (lambda t: t[t["solver"] == "gco"], "cost", "two solvers or more, got gco alone"),
    (lambda t: t[~((t["solver"] == "hold") & (t["layout"] == 2))], "cost", "layouts of every solver in f0 (quad"),
    (lambda t: t[~((t["solver"] == "hold") & (t["scenario"] == "f1"))], "cost", "hold 0"),
    (lambda t: pd.concat([t, t.iloc[:1]]), "cost", "one row of"),
    (lambda t: t, "nothing", "a column of numbers"),
    (lambda t: t, "status", "a column of numbers"),
    (lambda t: t.assign(iterations=np.nan), "iterations", "a number in iterations of every trial"),
    (lambda t: t.assign(outcome=["REACHED", *[None] * (len(t) - 1)]), "cost", "trajectories or missions"),
    (lambda t: t.iloc[:0], "cost", "at least one row"),
])  # fmt: skip
def test_what_cannot_be_compared_is_refused_in_a_line(change, measure: str, words: str) -> None:
    table = drawn(7, 3, (4, 3)).sort_values(["scenario", "layout"], kind="stable")
    with pytest.raises(InputError) as raised:
        over_families(change(table), measure)
    assert words in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.slow
def test_the_report_writes_table_and_figure(tmp_path: Path, capsys) -> None:
    (tmp_path / "run").mkdir()
    drawn(8, 3, (6, 5)).to_parquet(tmp_path / "run" / "trials.parquet", index=False)
    assert main([str(tmp_path), "--families", "cost", "--pdf"]) == 0
    text = capsys.readouterr().out
    assert "cost over 2 families, 11 layouts" in text and "Friedman p" in text and "gco" in text
    assert (tmp_path / "report" / "figures" / "families.pdf").read_bytes()[:4] == b"%PDF"
    table = pd.read_csv(tmp_path / "report" / "families.csv")
    assert len(json.loads(families_text(table, "cost", "json"))) == len(table)
    assert all("mean rank" in families_text(table, "cost", form) for form in ("markdown", "latex"))
    assert main([str(tmp_path), "--families", "cost", "--long"]) == 2
    assert "not allowed with" in problem_line(capsys.readouterr().err)


def test_the_figure_has_a_line_per_solver_and_a_point_per_pair() -> None:
    axes = families_figure(over_families(drawn(9, 4, (5,))), "cost").axes
    assert [len(ax.lines) for ax in axes] == [4, 4, 4, 6 + 1]
