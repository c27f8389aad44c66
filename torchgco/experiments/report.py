"""Reports on finished studies: a table, `summary.csv` and figures.

`torchgco-report DIR [DIR ...]` merges every `trials.parquet` below the folders and reports on all of them
together.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from math import isnan
from pathlib import Path

import numpy as np
import pandas as pd

from torchgco.errors import InputError
from torchgco.experiments.files import write
from torchgco.experiments.merge import OLDER, REPEATED, merge
from torchgco.experiments.records import TRIALS
from torchgco.experiments.runs import is_merged, read_trials
from torchgco.experiments.statistics import OUTCOMES, TASK, paired_table, summarise, task_columns
from torchgco.plotting.distributions import clearance_histogram, violation_histogram
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.rates import rates_figure
from torchgco.plotting.style import save
from torchgco.scenarios.layouts import Layouts

__all__ = ["compare", "format_table", "main", "merge", "write_report"]

Arrays = Mapping[str, np.ndarray]
# X (L, N+1, n) by solver, or a function that makes them from the arrays in layouts.npz and in solutions.npz.
Trajectories = Arrays | Callable[[Arrays, Arrays], Arrays]


def compare(trials: pd.DataFrame) -> pd.DataFrame:
    """For each task the solver that comes first, the one under study, against every other.

    Where it flew in several variants ("gco [...]"), each of them is compared with all that follow. Columns as
    `paired_table` has them; no rows for a task that one solver flew.
    """
    tables = []
    for _, task in trials.groupby(task_columns(trials), sort=False, dropna=False):
        names = task["solver"].unique().tolist()
        for i, name in enumerate(names):
            if _bare(name) == _bare(names[0]):
                tables.append(paired_table(task[task["solver"].isin(names[i:])], name))
    # Empty tables would take part in the choice of the columns' types, of which pandas 2 warns.
    return pd.concat([table for table in tables if len(table)] or tables, ignore_index=True)


def _bare(solver: str) -> str:
    """A solver's name without the label that a merge gave it."""
    return solver.split(" [")[0]


def write_report(folder: str | os.PathLike[str], trajectories: Trajectories | None = None) -> str:
    """Write `summary.csv` and `figures/*.png` next to the `trials.parquet` in a folder, and return the table.

    trajectories  states for the picture of the layouts, which needs `layouts.npz` too: X (L, N+1, n) by
                  solver, in the order of that file; or a function of (layouts, solutions), the arrays of the two
                  files, that returns this (`solutions` is empty without `solutions.npz`). None: no such
                  picture.

    Raises InputError if the table is missing, unreadable or empty, and where the trajectories don't fit the
    layouts.
    """
    folder = Path(folder)
    trials = read_trials(folder / TRIALS)
    summary = summarise(trials)
    write(folder / "summary.csv", lambda file: summary.to_csv(file, index=False))
    figures = {
        "rates": rates_figure(summary),
        "clearance": clearance_histogram(trials),
        "violation": violation_histogram(trials),
    }
    if trajectories is not None:
        layouts = Layouts.load(folder / "layouts.npz").arrays()
        if callable(trajectories):
            trajectories = trajectories(layouts, _solutions(folder / "solutions.npz"))
        figures["layouts"] = layout_grid(layouts, trajectories, trials)
    for name, figure in figures.items():
        write(folder / "figures" / f"{name}.png", lambda file, figure=figure: save(figure, file))
    text = format_table(summary, compare(trials))
    if repeated := trials.attrs.get(REPEATED, 0):
        text += f"\n\n{repeated} rows left out: another run has the same flight, and each counts once"
    if older := trials.attrs.get(OLDER, []):
        text += f"\n\nof an older version, distinguished by configuration and results alone: {', '.join(older)}"
    return text


def _solutions(path: Path) -> Arrays:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as held:
        return dict(held)


def format_table(summary: pd.DataFrame, paired: pd.DataFrame) -> str:
    """The report for a terminal, some 100 columns wide: rates, effort and comparisons of each task.

    summary, paired  as `summarise` and `paired_table` return them; `paired` may have no rows

    A rate reads "30/32 94 % [80, 98]": attained of defined, and the 95 % Wilson interval. "-" stands for an
    undefined value. Costs are medians, over the trials that reached the goal and over all that are finite.
    """
    blocks = []
    for (scenario, model), task in summary.groupby(TASK, sort=False, dropna=False):
        seeds = ", ".join(dict.fromkeys(seed for held in task["seed"] for seed in held.split()))
        blocks.append(f"{scenario} ({model}), seed {seeds}")
        swept = [name for name in task_columns(task)[len(TASK) :] if task[name].notna().any()]
        blocks += [_rates(task, swept), _effort(task, swept)]
        rows = paired[(paired["scenario"] == scenario) & (paired["model"] == model)]
        if len(rows):
            blocks.append(_paired(rows, swept))
    return "\n\n".join(blocks)


def _headers(swept: Sequence[str]) -> list[str]:
    """Swept variables as column heads: without the group of the key; of missions the last part alone."""
    short = (name.removeprefix("scenario.").removeprefix("model.vehicle.") for name in swept)
    return [name.split(".")[-1] if name.startswith(("mission.", "plant.")) else name for name in short]


def _cells(row: pd.Series, swept: Sequence[str]) -> list[str]:
    return ["-" if pd.isna(row[name]) else str(row[name]) for name in swept]


def _rates(task: pd.DataFrame, swept: Sequence[str]) -> str:
    rows = [
        [*_cells(row, swept), row["solver"], *(_rate(row, name) for name in OUTCOMES)] for _, row in task.iterrows()
    ]
    return aligned([[*_headers(swept), "solver", *OUTCOMES], *rows], len(swept) + 1)


def _rate(row: pd.Series, name: str) -> str:
    if not row[f"{name}_n"]:
        return "-"
    rate, low, high = (100 * row[f"{name}_{part}"] for part in ("rate", "low", "high"))
    return f"{row[f'{name}_count']}/{row[f'{name}_n']} {rate:.0f} % [{low:.0f}, {high:.0f}]"


# Header in the terminal, column of the summary, and how its numbers are written.
EFFORT = (
    ("n", "n", "d"),
    ("invalid", "invalid", "d"),
    ("viol. ok", "violation_ok", ".0%"),
    ("violation", "violation_median", ".2g"),
    ("cost reached", "cost_median_reached", ".1f"),
    ("cost all", "cost_median", ".1f"),
    ("iter.", "iterations_mean", ".1f"),
    ("outer", "outer_iterations_median", ".3g"),
    ("guided", "guided_mean", ".1f"),
    ("seconds", "seconds_mean", ".3g"),
)


def _effort(task: pd.DataFrame, swept: Sequence[str]) -> str:
    rows = [[*_headers(swept), "solver", *(header for header, _, _ in EFFORT)]]
    for _, row in task.iterrows():
        cells = ["-" if isnan(row[name]) else f"{row[name]:{form}}" for _, name, form in EFFORT]
        rows.append([*_cells(row, swept), row["solver"], *cells])
    return aligned(rows, len(swept) + 1)


COUNTS = {"n": "n", "both": "both", "only_a": "first", "only_b": "second", "neither": "neither"}
PAIRED = ("paired", "outcome", *COUNTS.values(), "difference", "McNemar p", "left out")


def _paired(rows: pd.DataFrame, swept: Sequence[str]) -> str:
    lines: list[Sequence[str]] = [[*_headers(swept), *PAIRED]]
    for _, row in rows.iterrows():
        difference = f"{100 * row.difference:+.0f} points" if row.n else "-"
        p_value = f"{row.p_value:.2g}" if row.n else "-"
        pair, left_out = f"{row.solver_a} - {row.solver_b}", row.undefined + row.unmatched
        counts = [str(row[name]) for name in COUNTS]
        lines.append([*_cells(row, swept), pair, row.outcome, *counts, difference, p_value, str(left_out)])
    return aligned(lines, len(swept) + 1)


def aligned(rows: Sequence[Sequence[str]], left: int) -> str:
    """Rows as lines of columns: the first `left` flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = list(zip(row, widths, strict=True))
        names = [cell.ljust(width) for cell, width in cells[:left]]
        lines.append("  ".join([*names, *(cell.rjust(width) for cell, width in cells[left:])]))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-report`: merge, print and write. Returns the exit code, 2 for malformed input."""
    parser = argparse.ArgumentParser(prog="torchgco-report", description="One report on many studies.")
    parser.add_argument("folders", nargs="+", metavar="DIR", type=Path, help="a study, or a folder of studies")
    parser.add_argument("--output", metavar="DIR", type=Path, help="default: 'report' in the first DIR")
    options = parser.parse_args(arguments)
    output = options.output or options.folders[0] / "report"
    try:
        merged = merge(options.folders)
        if (output / TRIALS).exists() and not is_merged(read_trials(output / TRIALS)):
            raise InputError("--output", "a folder without the results of a study, which are kept", output)
        write(output / TRIALS, lambda file: merged.to_parquet(file, index=False))
        print(write_report(output))
        print(f"\nwritten to {output}")
    except InputError as error:
        print(f"torchgco-report: {error}", file=sys.stderr)
        return 2
    return 0
