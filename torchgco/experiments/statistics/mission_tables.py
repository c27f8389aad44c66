"""Statistics of missions as text, and a line for each where few fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from torchgco.experiments.statistics.mission_statistics import MISSIONS_AT_ONCE
from torchgco.experiments.statistics.statistics import TASK
from torchgco.experiments.statistics.tables import (
    RATES_TEXT,
    aligned,
    cells,
    headers,
    paired_lines,
    printed_pairs,
    rate,
    swept_of,
)
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
    blocks = []
    for (scenario, model), task in summary.groupby(TASK, sort=False, dropna=False):
        seeds = ", ".join(dict.fromkeys(seed for held in task["seed"] for seed in held.split()))
        swept = swept_of(task)
        blocks += [f"missions in {scenario} ({model}), seed {seeds}", _outcomes(task, swept), _effort(task, swept)]
        if (task[MISSIONS_AT_ONCE] > 1).any():
            blocks[-1] += f"\n{DIVIDED}"
        rows = paired[(paired["scenario"] == scenario) & (paired["model"] == model)]
        if (rows["n"] > 0).any():
            blocks.append(paired_lines(rows, swept, costs=False))
    return "\n\n".join([*blocks, RATES_TEXT])


def printed_missions(summary: pd.DataFrame, paired: pd.DataFrame) -> list[pd.DataFrame]:
    """The tables that a paper prints: outcomes and effort, and comparisons where there are any."""
    swept, rows = swept_of(summary), []
    for _, row in summary.iterrows():
        rows.append([row["scenario"], row["model"], *cells(row, swept), row["solver"], row["n"]])
        rows[-1] += [*(rate(row, name.lower()) for name in Outcome.__members__), *_measured(row)]
    heads = [*TASK, *headers(swept), "solver", "n", *Outcome.__members__, *(head for head, *_ in MISSION_EFFORT)]
    return [pd.DataFrame(rows, columns=heads), *_printed_pairs(paired)]


def _printed_pairs(paired: pd.DataFrame) -> list[pd.DataFrame]:
    return [printed_pairs(paired).iloc[:, :-1]] if (paired["n"] > 0).any() else []  # without the ratio of costs


def _outcomes(task: pd.DataFrame, swept: Sequence[str]) -> str:
    rows = [[*headers(swept), "solver", "n", *Outcome.__members__]]
    for _, row in task.iterrows():
        shares = [rate(row, name.lower()) for name in Outcome.__members__]
        rows.append([*cells(row, swept), row["solver"], str(row["n"]), *shares])
    return aligned(rows, len(swept) + 1)


def _effort(task: pd.DataFrame, swept: Sequence[str]) -> str:
    rows = [[*headers(swept), "solver", *(head for head, *_ in MISSION_EFFORT)]]
    rows += [[*cells(row, swept), row["solver"], *_measured(row)] for _, row in task.iterrows()]
    return aligned(rows, len(swept) + 1)


def _measured(row: pd.Series) -> list[str]:
    """The cells of MISSION_EFFORT; of a batch no deadlines, which its divided times don't decide."""
    unknown = {name for _, name, _ in MISSION_EFFORT if pd.isna(row[name])}
    unknown |= {"missed_deadlines"} if row[MISSIONS_AT_ONCE] > 1 else set()
    return ["-" if name in unknown else form.format(row[name]) for _, name, form in MISSION_EFFORT]
