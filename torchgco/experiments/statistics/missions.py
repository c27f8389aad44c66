"""Outcomes of missions with their intervals, what the missions took, and a line for each where few fly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from torchgco.experiments.statistics.statistics import group_columns, grouped, numbers_of, rate_columns, summarise
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
