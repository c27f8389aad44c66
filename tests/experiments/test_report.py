from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.plotting.straight import ways
from tests.trials import flights, manifest, missions, trials
from torchgco.base.errors import InputError
from torchgco.experiments.reports.finished import _told
from torchgco.experiments.reports.report import main, write_report
from torchgco.experiments.results.kinds import TRAJECTORIES, format_report, joined, parts_of, summarise_missions
from torchgco.experiments.results.merge import merge
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import plain, summarise
from torchgco.plotting.ways import Way
from torchgco.scenarios.layouts import Layouts

HITS = [i < 30 for i in range(32)]


def study(folder: Path, *rows: dict[str, Any], **configuration: Any) -> Path:
    """A study's folder with a table of trials, and with a configuration if one is given."""
    folder.mkdir(parents=True, exist_ok=True)
    trials(*rows).to_parquet(folder / "trials.parquet", index=False)
    if configuration:
        (folder / "study.json").write_bytes(manifest(**configuration))
    return folder


def table(*rows: dict[str, Any]) -> str:
    frame = trials(*rows)
    return TRAJECTORIES.text(summarise(frame), compare(frame))


def test_rates_are_written_with_counts_and_interval() -> None:
    assert "30/32 94 % [80, 98]" in table(*flights("gco", HITS))


def test_columns_are_aligned() -> None:
    text = table(*flights("gco", HITS), *flights("a_long_name", [False] * 32, cost=1e7))
    blocks = [block.splitlines() for block in text.split("\n\n")]
    assert [len(block) for block in blocks] == [1, 3, 3, 3, 4, 2]
    assert "95 % Wilson" in blocks[-1][0] and "90 % quantile" in blocks[-1][1]
    for block in blocks[:-1]:
        assert len({len(line) for line in block}) == 1


def test_undefined_values_are_a_dash() -> None:
    text = table({"success": pd.NA, "reached": False, "iterations": np.nan})
    rates, effort = text.split("\n\n")[1:3]
    assert rates.split()[-1] == "-"
    assert effort.split("\n")[1].split().count("-") == 3, "cost and cost ratio of those that reached, and iterations"


def test_the_first_solver_is_the_one_compared_with_the_others() -> None:
    text = table(*flights("gco", HITS), *flights("al_ilqr", [False] * 32))
    line = next(line for line in text.splitlines() if "reached" in line and "gco - al_ilqr" in line)
    assert line.split()[3:] == ["reached", "32", "0", "30", "0", "2", "+94", "points", "1.9e-09", "0", "-"]


def test_each_task_has_its_own_tables() -> None:
    text = table(*flights("gco", [True]), *flights("gco", [False], scenario="trap", model="planar", seed=5))
    assert "forest (quadrotor), seed 0" in text and "trap (planar), seed 5" in text
    assert text.count("1/1 100 %") == 3 and text.count("0/1 0 %") == 3


def test_a_report_writes_summary_and_figures(tmp_path: Path) -> None:
    folder = study(tmp_path, *flights("gco", HITS), *flights("al_ilqr", HITS[::-1]))
    text = write_report(folder)
    summary = pd.read_csv(folder / "summary.csv")
    assert summary["solver"].tolist() == ["gco", "al_ilqr"]
    assert summary["reached_count"].tolist() == [30, 30]
    assert sorted(path.stem for path in folder.glob("figures/*.png")) == ["clearance", "rates", "violation"]
    assert "gco - al_ilqr" in text


@pytest.fixture
def flown(tmp_path: Path) -> Path:
    folder = study(tmp_path, *flights("gco", [True, False]))
    start, goal = np.zeros(6), np.ones(6)
    Layouts(np.full((2, 1, 2), 0.5), np.full((2, 1), 0.1), start=start, goal=goal).save(folder / "layouts.npz")
    np.savez(folder / "solutions.npz", U=np.zeros((1, 2, 3, 2)), solver=np.array(["gco"]))
    return folder


@pytest.mark.slow
def test_trajectories_are_made_from_the_controls_and_drawn(flown: Path) -> None:
    seen = {}

    def roll_out(solutions: Any, count: int) -> dict[str, list[Way]]:
        seen.update(controls=solutions["U"].shape)
        return {"gco": ways(np.zeros((2, 4, 6)))}

    text = write_report(flown, roll_out, printed="one")
    assert seen == {"controls": (1, 2, 3, 2)}
    drawn = {path.name for path in (flown / "figures").iterdir()}
    assert {"layouts.png", "study.png", "study.pdf"} <= drawn
    assert "1/2 50 %" in text and "|" not in text


def test_a_folder_without_trials_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"trials\.parquet"):
        write_report(tmp_path)


def test_merging_joins_studies_that_differ_in_seed(tmp_path: Path) -> None:
    study(tmp_path / "a", *flights("gco", HITS))
    study(tmp_path / "deep" / "b", *flights("gco", HITS, seed=1))
    merged = merge([tmp_path])
    assert len(merged) == 64 and set(merged["solver"]) == {"gco"}
    assert list(merged.columns) == list(trials({}).columns)


def test_a_table_found_twice_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = study(tmp_path / "a", *flights("gco", HITS))
    monkeypatch.chdir(tmp_path)
    merged = merge([tmp_path, folder, "a"])
    assert len(merged) == 32 and merged.attrs["repeated"] == 0


def test_the_same_result_in_two_runs_counts_once_with_its_first_time(tmp_path: Path) -> None:
    study(tmp_path / "a", *flights("gco", HITS, seconds=1.0))
    study(tmp_path / "b", *flights("gco", HITS, seconds=2.0))
    merged = merge([tmp_path])
    assert len(merged) == 32 and set(merged["seconds"]) == {1.0}
    assert merged.attrs["repeated"] == 32


def test_different_results_under_one_name_are_refused(tmp_path: Path) -> None:
    study(tmp_path / "a", *flights("gco", HITS))
    study(tmp_path / "b", *flights("gco", HITS, cost=7.0))
    with pytest.raises(InputError) as error:
        merge([tmp_path])
    message = str(error.value)
    assert "cost" in message and "layout 0" in message and "solver gco" in message
    assert str(tmp_path / "a") in message and str(tmp_path / "b") in message


def test_a_table_that_names_no_layouts_is_refused(tmp_path: Path) -> None:
    table = pd.read_parquet(study(tmp_path / "a", *flights("gco", HITS)) / "trials.parquet")
    table.drop(columns="layout_digest").to_parquet(tmp_path / "a" / "trials.parquet")
    with pytest.raises(InputError, match="without layout_digest"):
        merge([tmp_path])


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    study(tmp_path / "a", *flights("gco", HITS))
    with pytest.raises(InputError, match="nowhere"):
        merge([tmp_path / "a", tmp_path / "nowhere"])


def test_folders_without_trials_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"trials\.parquet"):
        merge([tmp_path])


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "trials.parquet").write_bytes(b"not a table")
    with pytest.raises(InputError, match="readable parquet"):
        merge([tmp_path])


@pytest.mark.slow
def test_the_command_prints_and_writes_the_merged_report(tmp_path: Path, capsys) -> None:
    study(tmp_path / "a", *flights("gco", HITS))
    study(tmp_path / "b", *flights("gco", HITS, seed=1))
    assert main([str(tmp_path)]) == 0
    first = capsys.readouterr().out
    assert "60/64 94 %" in first
    written = {path.name for path in (tmp_path / "report").rglob("*") if path.is_file()}
    assert written == {"trials.parquet", "summary.csv", "rates.png", "clearance.png", "violation.png"}
    assert main([str(tmp_path)]) == 0, "the report of the first call lies below the folder of the second"
    assert capsys.readouterr().out == first


def test_the_command_writes_into_the_given_folder(tmp_path: Path, capsys) -> None:
    study(tmp_path / "a", *flights("gco", HITS))
    assert main([str(tmp_path / "a"), "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "summary.csv").is_file() and not (tmp_path / "a" / "report").exists()


def test_the_command_never_overwrites_a_study(tmp_path: Path, capsys) -> None:
    folder = study(tmp_path / "a", *flights("gco", HITS))
    before = (folder / "trials.parquet").read_bytes()
    assert main([str(folder), "--output", str(folder)]) == 2
    assert (folder / "trials.parquet").read_bytes() == before


def test_the_command_answers_wrong_input_with_one_line(tmp_path: Path, capsys) -> None:
    assert main([str(tmp_path / "nowhere")]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1 and "nowhere" in captured.err


def test_a_merged_table_is_written_with_text_and_can_be_merged_again(tmp_path: Path) -> None:
    rows = [*flights("gco", [True] * 2), *flights("hold", [False] * 2, device=None)]
    given = pd.read_parquet(study(tmp_path / "a", *rows) / "trials.parquet")
    assert main([str(tmp_path / "a"), "--output", str(tmp_path / "out")]) == 0
    written = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    pd.testing.assert_frame_equal(written, given)
    again = plain(merge([tmp_path / "out"]))
    # Older versions of pandas read a missing text as None, and merge it to NaN.
    same = [table.astype(object).where(table.notna(), None) for table in (again, given)]
    pd.testing.assert_frame_equal(*same)


def test_missions_have_tables_of_their_own_next_to_trajectories() -> None:
    both = trials(*flights("gco", HITS), *missions("gco", "RRRC"), *missions("al_ilqr", "RCTD"))
    single, flown = parts_of(both)
    assert (single.kind.name, flown.kind.name) == ("trajectory", "mission")
    assert len(single.trials) == 32 and len(flown.trials) == 8
    text = format_report([single, flown], "table")
    above, below = text.split("missions in forest (quadrotor), seed 0")
    assert "30/32 94 %" in above and "violation" in above and "FEASIBLE" not in above
    assert "viol. ok" not in below and "cost" not in below and "success" not in below
    outcomes, effort, pairs, legend = below.strip().split("\n\n")
    assert "95 % Wilson" in legend
    assert outcomes.splitlines()[0].split() == ["solver", "n", "REACHED", "COLLISION", "TIMEOUT", "DIVERGED"]
    assert " ".join(outcomes.splitlines()[1].split()).startswith(
        "gco 4 3/4 75 % [30, 95] 1/4 25 % [5, 70] 0/4 0 % [0, 49]"
    )
    assert effort.splitlines()[1].split()[:8] == ["gco", "6.00", "s", "0.050", "m", "501", "J", "4"]
    assert pairs.splitlines()[1].split()[:5] == ["gco", "-", "al_ilqr", "reached", "4"]


def test_the_numbers_of_missions_are_in_the_summary() -> None:
    tables = joined(parts_of(trials(*flights("gco", HITS), *missions("gco", "RRCT"))))
    summary = tables["summary"].set_index("kind")
    assert summary.index.tolist() == ["trajectory", "mission"] and summary["n"].tolist() == [32, 4]
    row = summary.loc["mission"]
    ends = {name: row[f"{name}_count"] for name in ("reached", "collision", "timeout", "diverged")}
    assert ends == {"reached": 2, "collision": 1, "timeout": 1, "diverged": 0}
    assert (row["collision_low"], row["collision_high"]) == pytest.approx((0.0456, 0.6994), abs=1e-4)
    assert row["flight_time"] == 5.5 and row["missions_at_once"] == 4
    assert summary.loc["trajectory", "collision_count"] is pd.NA and summary["collision_count"].dtype == "Int64"


@pytest.mark.parametrize("seed", range(4))
def test_deadlines_are_missed_by_missions_that_fly_alone(seed: int) -> None:
    """Of a batch a period's time is divided by its missions: neither summary nor page says whether it was kept."""
    draws = np.random.default_rng(seed)
    missed, at_once = draws.integers(0, 50, 4).tolist(), int(draws.integers(2, 9))
    for batch in (1, at_once):
        flown = zip(missions("gco", "RRCT"), missed, strict=True)
        rows = [row | {"missed_deadlines": n, "batch_size": batch} for row, n in flown]
        table = trials(*rows)
        told = summarise_missions(table)["missed_deadlines"].to_numpy()
        pages = [dict(_told(row)).get("missed deadlines") for row in table.to_dict("records")]
        np.testing.assert_array_equal(told, [np.mean(missed) if batch == 1 else np.nan])
        assert pages == [str(n) if batch == 1 else None for n in missed]


def test_figures_of_earlier_reports_go(tmp_path: Path) -> None:
    folder = study(tmp_path, *flights("gco", HITS))
    write_report(folder)
    kept = folder / "figures" / "my-rates.png"
    kept.write_bytes(b"")
    (folder / "figures" / "rates-scenario.radius.png").write_bytes(b"")
    write_report(folder, pdf=True)
    names = {path.name for path in (folder / "figures").iterdir()}
    assert "rates.pdf" in names and kept.name in names and not {"rates.png", "rates-scenario.radius.png"} & names
    before = sorted((folder / "figures").iterdir())
    write_report(folder, figures=False)
    assert sorted((folder / "figures").iterdir()) == before


def test_a_table_for_latex_fits_the_line_and_has_a_legend() -> None:
    parts = parts_of(trials({"layout": 0}, {"layout": 1}))
    text, plain_text = (format_report(parts, form) for form in ("latex", "markdown"))
    assert text.count("\\resizebox{") == text.count("\\begin{tabular}") == text.count("\\end{tabular}}") == 1
    assert r"95 \% Wilson interval" in text.split("\\end{tabular}")[-1] and "footnotesize" not in plain_text


@pytest.mark.parametrize("form", ["csv", "json", "markdown", "latex"])
def test_missions_are_in_every_format(form: str) -> None:
    text = format_report(parts_of(trials(*flights("gco", HITS), *missions("gco", "RRCT"))), form)
    assert "COLLISION" in text if form in ("markdown", "latex") else "collision_rate" in text


@pytest.mark.slow
def test_missions_keep_their_columns_next_to_a_study(tmp_path: Path, capsys) -> None:
    """Without keys of missions in the other study, rows were named by their folders."""
    base = {"scenario": {"name": "forest", "num_obstacles": 10}, "model": {"vehicle": {"name": "quadrotor"}}}
    for wind in (0.0, 2.0):
        loop = {"mission": {"disturbance": {"wind": wind}}, "plant": {"mass_error": 0.0}}
        digests = {"layout_digest": f"mission {wind}", "settings_digest": "one", "success": pd.NA}
        study(tmp_path / f"wind{wind}", *missions("gco", "RRC", **digests), **base, **loop)
    digests = {"layout_digest": "single", "settings_digest": "one"}
    study(tmp_path / "single", *flights("gco", HITS, **digests), **base)
    merged = merge([tmp_path])
    assert [name for name in merged.columns if "." in name] == ["mission.disturbance.wind"]
    assert merged.groupby("mission.disturbance.wind", dropna=False).size().to_dict() == {0.0: 3, 2.0: 3, pd.NA: 32}
    assert main([str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "wind  solver" in text and "hydra.run.dir" not in text
    written = {path.name for path in (tmp_path / "report" / "figures").iterdir()}
    single = {"rates.png", "clearance.png", "violation.png"}
    assert written - single == {"outcomes.png", "outcomes-mission.disturbance.wind.png", "missions-clearance.png"}


def test_missions_of_several_planners_have_no_success(tmp_path: Path) -> None:
    more = {"layout_digest": "one", "success": pd.NA, "best_from": None}
    rows = [*missions("gco", "RR", settings_digest="a", **more), *missions("mine", "RR", settings_digest="b", **more)]
    study(tmp_path / "a", *rows)
    merged = merge([tmp_path])
    assert merged["success"].isna().all() and merged["best_from"].isna().all()


def test_a_single_mission_has_no_figure_of_shares_or_distributions(tmp_path: Path, capsys) -> None:
    study(tmp_path / "a", *missions("gco", "R"))
    assert main([str(tmp_path)]) == 0
    assert not (tmp_path / "report" / "figures").exists() and "1/1 100 %" in capsys.readouterr().out


def test_pairs_without_a_trial_are_not_printed_and_whole_numbers_have_no_point() -> None:
    rows = [*flights("gco", HITS), *flights("mine", HITS)]
    summary, pairs = summarise(trials(*rows)), compare(trials(*({**row, "success": pd.NA} for row in rows)))
    pairs.insert(2, "scenario.num_obstacles", 10.0)
    summary.insert(2, "scenario.num_obstacles", 10.0)
    text = TRAJECTORIES.text(summary, pairs)
    paired = text.split("\n\n")[-2]
    assert "reached" in paired and "success" not in paired
    assert "10.0" not in text and paired.splitlines()[1].startswith("10 ")
