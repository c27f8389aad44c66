"""How often each solver attains each outcome."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from torchgco.plotting.style import INK, SMALL, legend, panels, solver_colours, tasks_of, tidy

OUTCOMES = ("feasible", "reached", "success")


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
        width = 0.8 / len(task)
        for i, (_, row) in enumerate(task.iterrows()):
            for j, name in enumerate(OUTCOMES):
                _bar(ax, j + (i - (len(task) - 1) / 2) * width, 0.9 * width, row, name, colours[row["solver"]])
        ax.set_xticks(range(len(OUTCOMES)), OUTCOMES)
        ax.set_xlim(-0.5, len(OUTCOMES) - 0.5)
        ax.set_ylim(0, 1.12)
        ax.set_yticks([0, 0.25, 0.5, 0.75, 1])
        ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
        ax.set_ylabel("layouts, 95 % interval")
        if task["n"].nunique() > 1:
            counts = ", ".join(f"{row['solver']} {row['n']}" for _, row in task.iterrows())
            ax.set_xlabel(f"different numbers of layouts: {counts}", fontsize=SMALL)
        tidy(ax, title)
    legend(figure, [Patch(color=colour, label=solver) for solver, colour in colours.items()])
    return figure


def _bar(ax: Axes, x: float, width: float, row: pd.Series, name: str, colour: str) -> None:
    n, count = row[f"{name}_n"], row[f"{name}_count"]
    if not n:
        ax.text(x, 0.02, "not defined", rotation=90, ha="center", va="bottom", fontsize=SMALL, color=colour)
        return
    rate, low, high = (row[f"{name}_{part}"] for part in ("rate", "low", "high"))
    ax.bar(x, rate, width, color=colour, alpha=0.85)
    # Rounding can put an end of the interval slightly inside the rate at 0 and at 1.
    spread = [[max(rate - low, 0)], [max(high - rate, 0)]]
    ax.errorbar(x, rate, spread, color=INK, capsize=3, linewidth=1.2)
    ax.text(x, max(high, rate) + 0.015, f"{count}/{n}", ha="center", va="bottom", fontsize=SMALL, color=INK)
