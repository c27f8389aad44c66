"""Statistics of missions as text, and a line for each where few fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from torchgco.experiments.statistics.mission_statistics import MISSIONS_AT_ONCE
from torchgco.experiments.statistics.tables import RATES_TEXT, per_solver, per_task, printed_pairs, printed_rows, rate
from torchgco.missions.outcome import Outcome

# Header, column of the summary, and how the numbers are written.
MISSION_EFFORT = (
    ("flight time", "flight_time", "{:.2f} s"), ("clearance", "clearance", "{:.3f} m"),
    ("energy", "energy", "{:.0f} J"),
    ("at once", MISSIONS_AT_ONCE, "{:.0f}"), ("planner", "planner_seconds_median", "{:.4f} s"),
    ("99 %", "planner_seconds_p99", "{:.4f} s"), ("tracker", "tracker_seconds_median", "{:.4f} s"),
    ("missed", "missed_deadlines", "{:.1f}"), ("kept plans", "shifted_plans", "{:.1f}"),
)  # fmt: skip
DIVIDED = (
    "planner, 99 %, tracker: the time of a batch divided by its missions (at once), which is no latency;\n"
    "deadlines are missed only by missions that fly alone"
)


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


def format_missions(summary: pd.DataFrame, paired: pd.DataFrame) -> str:
    """The report for a terminal: outcomes, what the missions took, and comparisons of each task.

    Outcomes are counts with the share of all missions and its 95 % Wilson interval; they are disjoint. Effort is the
    median over the missions that reached the goal; missed deadlines and kept plans are means over all missions.
    """
    blocks = per_task(summary, paired, "missions in ", (_outcomes, _effort), costs=False)
    return "\n\n".join([*blocks, RATES_TEXT])


def printed_missions(summary: pd.DataFrame, paired: pd.DataFrame) -> list[pd.DataFrame]:
    """The tables that a paper prints: outcomes and effort, and comparisons where there are any."""
    heads = ["n", *Outcome.__members__, *(head for head, *_ in MISSION_EFFORT)]
    rows = printed_rows(summary, heads, lambda row: [row["n"], *_shares(row), *_measured(row)])
    pairs = [printed_pairs(paired).iloc[:, :-1]] if (paired["n"] > 0).any() else []  # without the ratio of costs
    return [rows, *pairs]


def _outcomes(task: pd.DataFrame, swept: Sequence[str]) -> str:
    heads = ("n", *Outcome.__members__)
    return per_solver(task, swept, heads, lambda row: [str(row["n"]), *_shares(row)])


def _shares(row: pd.Series) -> list[str]:
    return [rate(row, name.lower()) for name in Outcome.__members__]


def _effort(task: pd.DataFrame, swept: Sequence[str]) -> str:
    lines = per_solver(task, swept, [head for head, *_ in MISSION_EFFORT], _measured)
    return f"{lines}\n{DIVIDED}" if (task[MISSIONS_AT_ONCE] > 1).any() else lines


def _measured(row: pd.Series) -> list[str]:
    """The cells of MISSION_EFFORT; of a batch no deadlines, which its divided times don't decide."""
    unknown = {name for _, name, _ in MISSION_EFFORT if pd.isna(row[name])}
    unknown |= {"missed_deadlines"} if row[MISSIONS_AT_ONCE] > 1 else set()
    return ["-" if name in unknown else form.format(row[name]) for _, name, form in MISSION_EFFORT]
