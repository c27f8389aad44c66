"""Trajectories and missions: two kinds of trials that may share a table, each with statistics and texts of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import (
    EFFORT,
    MAKESPAN,
    OUTCOMES,
    PAPER_OUTCOME,
    TASK,
    are_missions,
    group_columns,
    grouped,
    numbers_of,
    rate_columns,
    summarise,
    task_columns,
)
from torchgco.experiments.statistics.tables import (
    PAIR_CELLS,
    RATES_TEXT,
    Kind,
    cost_ratio,
    csv_text,
    format_frame,
    number,
    rate,
)
from torchgco.missions.outcome import Outcome

# Medians over the missions that reached the goal, and means over all.
MEDIANS = (
    "flight_time", "energy", "clearance", "planner_seconds_median", "planner_seconds_p99", "tracker_seconds_median",
)  # fmt: skip
MEANS = ("missed_deadlines", "shifted_plans")
MISSIONS_AT_ONCE = "missions_at_once"


def summarise_missions(trials: pd.DataFrame) -> pd.DataFrame:
    """One row per (scenario, model, swept variables, solver): the columns of `summarise`, and of missions.

    Columns:
        <outcome>_count, _n, _rate, _low, _high: for collision, timeout and diverged as for reached: the four are
            disjoint.
        <column>: for flight_time, energy, clearance, planner_seconds_median, planner_seconds_p99 and
            tracker_seconds_median: the median over the missions that reached the goal.
        missed_deadlines, shifted_plans: means over all missions; of deadlines NaN where missions were planned together.
        missions_at_once: most missions that were planned as one batch, which all times are divided by.

    Raises:
        InputError: as `summarise`.
    """
    summary = summarise(trials)
    rows = [_of_missions(trials.iloc[index]) for index in grouped(trials, group_columns(trials))]
    return pd.concat([summary, pd.DataFrame(rows)], axis=1)


def _of_missions(group: pd.DataFrame) -> dict[str, object]:
    row: dict[str, object] = {}
    for outcome in Outcome:
        if outcome is not Outcome.REACHED:
            row |= rate_columns(outcome.name.lower(), (group["outcome"] == outcome.name).to_numpy(dtype=float))
    reached = group[group["outcome"] == Outcome.REACHED.name]
    row |= {name: pd.Series(numbers_of(reached[name])).median() for name in MEDIANS}
    row |= {name: float(numbers_of(group[name]).mean()) for name in MEANS}
    if (at_once := int(group["batch_size"].max())) > 1:
        row["missed_deadlines"] = np.nan  # the divided times of a batch don't decide them
    return row | {MISSIONS_AT_ONCE: at_once}


def mission_lines(trials: pd.DataFrame) -> str:
    """A line per mission."""
    lines = []
    for row in trials.itertuples():
        times = (
            f"planner {1000 * row.planner_seconds_median:.0f} ms (99 %: {1000 * row.planner_seconds_p99:.0f} ms) and "
            f"tracker {1000 * row.tracker_seconds_median:.0f} ms"
        )
        if row.outer_iterations == 0:
            times = "no plan made"
        elif row.batch_size > 1:
            times += f" per mission of a batch of {row.batch_size}"
        else:
            ending = "" if row.missed_deadlines == 1 else "s"
            times += f" per control period, {row.missed_deadlines} missed deadline{ending} of {row.outer_iterations}"
        lines.append(
            f"{row.scenario} {row.layout}, {row.solver}: {row.outcome} after {row.flight_time:.2f} s, clearance "
            f"{row.clearance:.3f} m, {_gates(row)}{times}. {Outcome[str(row.outcome)].sentence}"
        )
    return "\n".join(lines)


def _gates(row: Any) -> str:
    """How a race went; nothing of missions without gates."""
    passed = getattr(row, "gates_passed", np.nan)
    if not np.isfinite(passed):
        return ""
    return f"{passed:.0f} gates passed, at most {row.gate_distance:.3f} m from their middles, "


PAPER_SOLVER = "gco_paper"  # whose tables have the paper's notion of feasible, too
KIND = "kind"  # first column of summary.csv and paired.csv


# Head, form and columns of the summary.
TRAJECTORY_EFFORT = (
    ("n", "{:d}", "n"), ("invalid", "{:d}", "invalid"),
    ("violation", "{:.2g}", "violation_median"), ("cost reached", "{:.1f}", "cost_median_reached"),
    ("cost all", "{:.1f}", "cost_median"), ("cost ratio", "{:.3f} ({:.3f})", "cost_ratio_median", "cost_ratio_p90"),
    ("iter.", "{:.0f} ({:.0f})", "iterations_median", "iterations_p90"),
    ("outer", "{:.3g} ({:.3g})", "outer_iterations_median", "outer_iterations_p90"),
    ("guided", "{:.3g} ({:.3g})", "guided_median", "guided_p90"),
    ("seconds", "{:.2g} ({:.2g})", "seconds_median", "seconds_p90"),
)  # fmt: skip
MISSION_EFFORT = (
    ("flight time", "{:.2f} s", "flight_time"), ("clearance", "{:.3f} m", "clearance"),
    ("energy", "{:.0f} J", "energy"), ("at once", "{:.0f}", MISSIONS_AT_ONCE),
    ("planner", "{:.4f} s", "planner_seconds_median"), ("99 %", "{:.4f} s", "planner_seconds_p99"),
    ("tracker", "{:.4f} s", "tracker_seconds_median"), ("missed", "{:.1f}", "missed_deadlines"),
    ("kept plans", "{:.1f}", "shifted_plans"),
)  # fmt: skip
EFFORT_TEXT = "effort: median (90 % quantile); costs: where the goal was reached, everywhere, over the best known one"
DIVIDED = (
    "\nplanner, 99 %, tracker: the time of a batch divided by its missions (at once), which is no latency;\n"
    "deadlines are missed only by missions that fly alone"
)


TRAJECTORIES = Kind(
    "trajectory",
    summarise,
    rates={name: rate(name) for name in OUTCOMES},
    effort={head: number(form, *names) for head, form, *names in TRAJECTORY_EFFORT},
    paper=("n", "cost ratio", "iter.", "seconds"),
    compared={**PAIR_CELLS, "cost ratio": cost_ratio},
    statuses=True,
    more_effort=lambda task: (
        {MAKESPAN: number("{:.2f} ({:.2f}) s", f"{MAKESPAN}_median", f"{MAKESPAN}_p90")}
        if f"{MAKESPAN}_median" in task and task[f"{MAKESPAN}_median"].notna().any()
        else {}
    ),
    more_rates=lambda task: {PAPER_OUTCOME: rate(PAPER_OUTCOME)} if (task["solver"] == PAPER_SOLVER).any() else {},
    notes=f"{RATES_TEXT}\n{EFFORT_TEXT}",
)
MISSIONS = Kind(
    "mission",
    summarise_missions,
    of="missions in ",
    rates={"n": number("{:d}", "n"), **{name: rate(name.lower()) for name in Outcome.__members__}},
    effort={head: number(form, name) for head, form, name in MISSION_EFFORT},
    paper=[head for head, *_ in MISSION_EFFORT],
    compared=PAIR_CELLS,
    notes=RATES_TEXT,
    effort_note=lambda task: DIVIDED if (task[MISSIONS_AT_ONCE] > 1).any() else "",
)


@dataclass(frozen=True)
class Part:
    """The trials of one kind with their statistics.

    Args:
        summary: as its kind summarises.
        paired: see `compare`; of missions by `reached` alone.
    """

    kind: Kind
    trials: pd.DataFrame
    summary: pd.DataFrame
    paired: pd.DataFrame


def parts_of(trials: pd.DataFrame) -> list[Part]:
    """The kinds in a table of trials, each without the swept variables of the other.

    Raises:
        InputError: as `summarise`.
    """
    missions = are_missions(trials)
    if trials.empty or not missions.any():
        return [Part(TRAJECTORIES, trials, summarise(trials), compare(trials))]
    flown, single = _own(trials[missions]), _own(trials[~missions])
    pairs = compare(flown)
    parts = [Part(MISSIONS, flown, summarise_missions(flown), pairs[pairs["outcome"] == "reached"])]
    return [Part(TRAJECTORIES, single, summarise(single), compare(single)), *parts] if len(single) else parts


def _own(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows without swept variables that they don't have."""
    swept = task_columns(rows)[len(TASK) :]
    return rows.drop(columns=[name for name in swept if rows[name].isna().all()]).reset_index(drop=True)


def joined(parts: Sequence[Part]) -> dict[str, pd.DataFrame]:
    """The tables "summary" and "paired" of all parts, with the kind in the first column."""
    return {name: _stacked([(part.kind.name, getattr(part, name)) for part in parts]) for name in ("summary", "paired")}


def write_tables(folder: Path, parts: Sequence[Part]) -> None:
    """Write summary.csv, and paired.csv where solvers are compared."""
    for name, table in joined(parts).items():
        if name == "summary" or len(table):
            write(folder / f"{name}.csv", lambda file, table=table: file.write(csv_text(table).encode()))


def _stacked(tables: Sequence[tuple[str, pd.DataFrame]]) -> pd.DataFrame:
    frames = []
    for kind, table in tables:
        # Columns that the other kind lacks would turn counts into floats.
        counts = [name for name in table.columns if pd.api.types.is_integer_dtype(table[name])] if tables[1:] else []
        frames.append(table.astype(dict.fromkeys(counts, "Int64")))
        frames[-1].insert(0, KIND, kind)
    filled = [table for table in frames if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else frames[0]


def format_report(parts: Sequence[Part], form: str) -> str:
    """The statistics of all kinds of trials, in one of `tables.OUTPUTS`.

    Formats:
        csv: the summary with all its columns.
        json: all columns of both tables, under "summary" and "paired"; null where a number is undefined.
        markdown, latex: the columns that a paper prints, of both tables, for each kind; in LaTeX at most as wide as a
            line, above a legend.
        table: as `Kind.text`.
    """
    if form == "table":
        return "\n\n".join(part.kind.text(part.summary, part.paired) for part in parts)
    if form in ("csv", "json"):
        tables = joined(parts)
        if form == "csv":
            return format_frame(tables["summary"], form)
        return json.dumps({name: json.loads(format_frame(table, form)) for name, table in tables.items()}, indent=1)
    texts = []
    for part in parts:
        tables = [format_frame(table, form) for table in part.kind.printed(part.summary, part.paired)]
        texts += [FITTED.replace("TABLE", table) for table in tables] if form == "latex" else tables
        legend = "; ".join(part.kind.notes.splitlines()).replace("%", r"\%")
        texts += [rf"{{\footnotesize {legend}\par}}"] if form == "latex" else []
    return "\n\n".join(texts)


# Of a table in LaTeX: by graphicx, as wide as it is or as a line, whichever is less.
FITTED = r"\noindent\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%" + "\nTABLE}"
QUANTILES = [f"{name}_{suffix}" for name in ("cost_ratio", *EFFORT) for suffix in ("median", "p90")]
OF_TRAJECTORIES = (
    *(f"{name}_rate" for name in (*OUTCOMES, PAPER_OUTCOME)), "cost_median_reached", "cost_median", "violation_median",
    *QUANTILES,
)  # fmt: skip
OF_MISSIONS = (*(f"{outcome.name.lower()}_rate" for outcome in Outcome), *MEDIANS, *MEANS)


def check_objective(name: object, missions: bool) -> None:
    """Check that a study has a number of this name for its solver: a column of the summary.

    Raises:
        InputError: it has none.
    """
    names = OF_MISSIONS if missions else OF_TRAJECTORIES
    if name not in names:
        near = get_close_matches(str(name), names, n=1)
        expected = f"a number of the summary, such as {', '.join(near or names[:2])}"
        raise InputError("study.objective", expected, name)


def objective_of(trials: pd.DataFrame, name: str, solver: str) -> float:
    """The number of a solver in a study's trials.

    Raises:
        InputError: it isn't defined for these trials, as success is without a best cost.
    """
    value = float(parts_of(trials)[0].summary.set_index("solver")[name][solver])
    if value != value:
        raise InputError("study.objective", "a number that these trials define", f"{name}, which is undefined")
    return value
