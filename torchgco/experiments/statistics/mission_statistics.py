"""Outcomes of missions with their intervals, and what the missions took."""

from __future__ import annotations

import pandas as pd

from torchgco.experiments.statistics.statistics import grouped, numbers_of, rate_columns, summarise, task_columns
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
        missed_deadlines, shifted_plans: means over all missions.
        missions_at_once: most missions that were planned as one batch, which all times are divided by.

    Raises:
        InputError: as `summarise`.
    """
    summary = summarise(trials)
    rows = [_of_missions(trials.iloc[place]) for place in grouped(trials, [*task_columns(trials), "solver"])]
    return pd.concat([summary, pd.DataFrame(rows)], axis=1)


def _of_missions(group: pd.DataFrame) -> dict[str, object]:
    row: dict[str, object] = {}
    for outcome in Outcome:
        if outcome is not Outcome.REACHED:
            row |= rate_columns(outcome.name.lower(), (group["outcome"] == outcome.name).to_numpy(dtype=float))
    reached = group[group["outcome"] == Outcome.REACHED.name]
    row |= {name: pd.Series(numbers_of(reached[name])).median() for name in MEDIANS}
    row |= {name: float(numbers_of(group[name]).mean()) for name in MEANS}
    return row | {MISSIONS_AT_ONCE: int(group["batch_size"].max())}
