"""How often each solver attains each outcome, and how this and costs depend on a variable that a sweep has changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter, NullLocator, PercentFormatter

from torchgco.plotting.style import DASHES, INK, SMALL, legend, panels, solver_colours, solver_handles, tasks_of, tidy

OUTCOMES = ("feasible", "reached", "success")
SWEEP_PANEL = (3.4, 2.8)  # of a panel, inches
DECADES = 50.0  # ratio of the largest to the smallest value from which the axis is logarithmic
TICKS = 8  # values that are all marked on the axis
GROUP_LETTERS = 18  # of the name of a bar group
FAILED_OUTCOMES = ("collision", "timeout", "diverged")  # of missions that don't reach the goal
EFFORT_AXES = (
    ("flight_time", "flight_time", "median flight time, reached [s]"),
    ("cost_ratio_median", "cost_ratio_p90", "cost / best, median to 90 %"),
    ("cost_median_reached", "cost_median_reached", "median cost, reached"),
)
WORDS = {
    "scenario.num_obstacles": "number of obstacles", "mission.disturbance.wind": "wind [N]",
    "mission.disturbance.gust": "gusts, standard deviation [N]", "mission.latency": "latency [control periods]",
    "mission.planner.margin": "margin [m]", "plant.mass_error": "relative error of the mass",
    "plant.thrust_error": "relative error of the thrust", "plant.drag": "drag [N s/m]",
}  # fmt: skip


def rates_figure(summary: pd.DataFrame) -> Figure:
    """Rates of feasible, reached and success with Wilson intervals, a panel per (scenario, model).

    Args:
        summary: as `experiments.statistics.summarise` returns it.

    The label above a bar counts the trials that attained the outcome, of all where it is defined. An outcome that is
    defined nowhere has no bar. Solvers that flew different numbers of trials, hence different layouts, are marked.
    """
    tasks = list(tasks_of(summary))
    colours = solver_colours(summary["solver"])
    widest = max(len(task) for _, task in tasks)
    figure, axes = panels(len(tasks), 2, (max(5.2, 1.4 + widest), 3.4))
    for ax, (title, task) in zip(axes, tasks, strict=True):
        for i, row in enumerate(task.to_dict("records")):
            x, colour, side = np.arange(len(OUTCOMES)), colours[row["solver"]], (i, len(task))
            low, rate, high = np.transpose([_interval(row, name) for name in OUTCOMES])
            _bars(ax, x, low, rate, high, colour, side)
            for center, name, top in zip(_beside(x, side)[0], OUTCOMES, high, strict=True):
                look: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": SMALL}
                if row[f"{name}_n"]:
                    ax.text(center, top + 0.015, f"{row[f'{name}_count']}/{row[f'{name}_n']}", color=INK, **look)
                else:
                    ax.text(center, 0.02, "not defined", rotation=90, color=colour, **look)
        ax.set_xticks(range(len(OUTCOMES)), OUTCOMES)
        ax.set_xlim(-0.5, len(OUTCOMES) - 0.5)
        _as_rate(ax, "layouts", 0, 1.12)
        if task["n"].nunique() > 1:
            counts = ", ".join(f"{row['solver']} {row['n']}" for _, row in task.iterrows())
            ax.set_xlabel(f"different numbers of layouts: {counts}", fontsize=SMALL)
        tidy(ax, title)
    legend(figure, [Patch(color=colour, label=solver) for solver, colour in colours.items()])
    return figure


def sweep_figure(summary: pd.DataFrame, variable: str) -> Figure:
    """Rates with 95 % Wilson intervals and costs against one swept variable: a panel per outcome, a line per solver.

    Args:
        summary: as `experiments.statistics.summarise` or `summarise_missions` returns it, with a column `variable`.
        variable: a column of numbers gives lines with bands, any other column groups of bars.

    Every task, which are the values of the other swept variables too, has its row of panels. What has no value
    anywhere has no panel: an outcome that is defined nowhere, of missions one that never occurs, a cost. The cost is
    the median ratio to the best known cost, with a whisker or band up to the 90 % quantile; where no best cost is
    known, the median cost; of missions it is the median flight time; all over the trials that reached the goal.
    """
    rows = summary[summary[variable].notna()]
    tasks = list(tasks_of(rows.rename(columns={variable: "value"})))
    shown = _shown(rows)
    known = (columns for columns in EFFORT_AXES if columns[0] in rows.columns and rows[columns[0]].notna().any())
    effort = next(known, None)  # columns of the last panel, its middle and its upper end, and its label
    width = len(shown) + (effort is not None)
    figure, axes = panels(len(tasks) * width, width, SWEEP_PANEL)
    numeric = pd.api.types.is_numeric_dtype(rows[variable])
    draw, locate = (_line, _numbers) if numeric else (_bars, _categories)
    colours = solver_colours(rows["solver"])
    for i, (title, task) in enumerate(tasks):
        row = axes[i * width : (i + 1) * width]
        values = locate(row, task["value"])
        for j, (solver, group) in enumerate(task.groupby("solver", sort=False)):
            x = group["value"].map(values).to_numpy(dtype=float)
            order = np.argsort(x)
            group, x = group.iloc[order], x[order]
            side = (j, task["solver"].nunique())
            for ax, name in zip(row, shown, strict=False):
                draw(ax, x, *_interval(group, name), colours[solver], side)
            if effort is not None:
                middle, high = (group[name].to_numpy(dtype=float) for name in effort[:2])
                (_line if numeric else _points)(row[-1], x, middle, middle, high, colours[solver], side)
                row[-1].set_ylabel(effort[2])
                row[-1].ticklabel_format(axis="y", useOffset=False)  # ratios as they are, not what they exceed 1 by
        for ax, name in zip(row, shown, strict=False):
            _as_rate(ax, name)
        for ax in row:
            ax.set_xlabel(WORDS.get(variable, variable.split(".")[-1].replace("_", " ")))
            tidy(ax, title if ax is row[0] else "")
    patches = [Patch(color=colour, label=solver) for solver, colour in colours.items()]
    legend(figure, solver_handles(colours, marker="o") if numeric else patches)
    return figure


def _shown(rows: pd.DataFrame) -> list[str]:
    """The outcomes that have panels."""
    if f"{FAILED_OUTCOMES[0]}_n" not in rows.columns:
        return [name for name in OUTCOMES if rows[f"{name}_n"].sum() > 0]
    return ["reached", *(name for name in FAILED_OUTCOMES if rows[f"{name}_count"].sum() > 0)]


def _interval(values: Mapping[str, Any] | pd.DataFrame, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The low end, the rate and the high end of an outcome, of a row or in the rows of a summary."""
    low, rate, high = (np.asarray(values[f"{name}_{suffix}"], dtype=float) for suffix in ("low", "rate", "high"))
    # Rounding can put an end of the interval slightly inside the rate at 0 and at 1.
    return np.minimum(low, rate), rate, np.maximum(high, rate)


def _as_rate(ax: Axes, name: str, low: float = -0.02, high: float = 1.02) -> None:
    ax.set_ylim(low, high)
    ax.set_yticks([0, 0.25, 0.5, 0.75, 1])
    ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    ax.set_ylabel(f"{name}, 95 % interval")


def _numbers(row: list[Axes], values: pd.Series) -> dict[object, float]:
    """Set the axes for the numbers of a column; returns the place of each."""
    numbers = sorted(float(value) for value in values.unique())
    for ax in row:
        if numbers[0] > 0 and numbers[-1] / numbers[0] >= DECADES:
            ax.set_xscale("log")
        if len(numbers) <= TICKS:
            ax.set_xticks(numbers, [f"{value:g}" for value in numbers])
            ax.xaxis.set_minor_locator(NullLocator())
            ax.xaxis.set_minor_formatter(NullFormatter())
    return {value: float(value) for value in values.unique()}


def _categories(row: list[Axes], values: pd.Series) -> dict[object, float]:
    """Name the groups of bars on the axes; returns the middle of each group."""
    labels = [str(value) for value in values.unique()]
    names = [name if len(name) <= GROUP_LETTERS else f"...{name[-GROUP_LETTERS:]}" for name in labels]
    turned = {"rotation": 20, "ha": "right"} if sum(map(len, names)) > 30 else {}
    for ax in row:
        ax.set_xticks(range(len(labels)), names, fontsize=SMALL, **turned)
        ax.set_xlim(-0.5, len(labels) - 0.5)
    return {value: float(i) for i, value in enumerate(values.unique())}


def _line(ax: Axes, x, low, middle, high, colour: str, side: tuple[int, int]) -> None:
    ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.vlines(x, low, high, color=colour, alpha=0.5, linewidth=1)  # a band needs two values
    ax.plot(x, middle, color=colour, linestyle=DASHES[colour], marker="o", markersize=4, linewidth=1.6)


def _bars(ax: Axes, x, low, middle, high, colour: str, side: tuple[int, int]) -> None:
    x, width = _beside(x, side)
    known = np.isfinite(middle)
    x, low, middle, high = x[known], low[known], middle[known], high[known]
    ax.bar(x, middle, 0.9 * width, color=colour, alpha=0.85)
    ax.errorbar(x, middle, [middle - low, high - middle], fmt="none", color=INK, capsize=3, linewidth=1.2)


def _points(ax: Axes, x, low, middle, high, colour: str, side: tuple[int, int]) -> None:
    """In place of bars where 0 isn't on the axis."""
    x, _ = _beside(x, side)
    ax.errorbar(x, middle, [middle - low, high - middle], fmt="o", color=colour, capsize=3, linewidth=1.2)


def _beside(x: np.ndarray, side: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Places of one of several solvers side by side in their groups, and the width of each."""
    i, count = side
    width = 0.8 / count
    return x + (i - (count - 1) / 2) * width, width
