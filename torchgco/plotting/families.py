"""Solvers over families of layouts: the performance profile, scores, ranks, and who is better how often."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator, PercentFormatter

from torchgco.plotting.style import DASHES, INK, legend, panels, solver_colours, solver_handles, tidy

SIZE = (4.2, 3.2)  # of a panel, inches
TICKS = (1.0, 1.01, 1.1, 2.0, 10.0)  # ratios that are marked
LEAST_EXCESS = 5e-4  # at which a ratio of 1 stands on the axis of excesses
NUMBERS = {"interquartile_mean": "interquartile mean of least / own", "mean_rank": "mean rank"}


def families_figure(table: pd.DataFrame, measure: str) -> Figure:
    """A panel each for the profile, the interquartile mean of scores, the mean rank and the pairs of solvers.

    Args:
        table: as `experiments.statistics.families.over_families` returns it; intervals are bands and whiskers.
        measure: what was compared, for the axes.
    """
    colours = solver_colours(table.loc[table["statistic"] == "mean_rank", "solver"])
    figure, axes = panels(4, 2, SIZE)
    _profile(axes[0], table[(table["statistic"] == "profile") & np.isfinite(table["at"])], colours, measure)
    for ax, (name, label) in zip(axes[1:], NUMBERS.items(), strict=False):
        rows = table[table["statistic"] == name]
        _points(ax, rows, rows["solver"].tolist(), [colours[name] for name in rows["solver"]])
        ax.set_xlabel(label)
    pairs = table[table["statistic"] == "improvement"]
    names = [f"{row['solver']} - {row['other']}" for _, row in pairs.iterrows()]
    _points(axes[3], pairs, names, [INK] * len(pairs))
    axes[3].axvline(0.5, color=INK, linestyle="--", linewidth=1.2)
    axes[3].set(xlim=(-0.02, 1.02), xlabel="share of layouts on which the first is better")
    legend(figure, solver_handles(colours))
    return figure


def _profile(ax: Axes, rows: pd.DataFrame, colours: dict[str, str], measure: str) -> None:
    for name, colour in colours.items():
        line = rows[rows["solver"] == name].sort_values("at")
        at = line["at"].to_numpy() - 1.0 + LEAST_EXCESS
        ax.fill_between(at, line["low"], line["high"], color=colour, alpha=0.15, linewidth=0, step="post")
        ax.plot(at, line["value"], color=colour, linestyle=DASHES[colour], drawstyle="steps-post", linewidth=1.6)
    ax.set_xscale("log")
    ax.set_xticks([tick - 1.0 + LEAST_EXCESS for tick in TICKS])
    ax.xaxis.set_major_formatter(FuncFormatter(lambda place, _: f"{place + 1.0 - LEAST_EXCESS:.4g}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set(ylim=(-0.02, 1.02), xlabel=f"at most so many times the least {measure}", ylabel="share of layouts")
    ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    tidy(ax)


def _points(ax: Axes, rows: pd.DataFrame, names: list[str], colours: list[str]) -> None:
    """A value with its interval on a line for each row, the first at the top."""
    for i, (row, colour) in enumerate(zip(rows.to_dict("records"), colours, strict=True)):
        low, high = (row["value"] if pd.isna(row[end]) else row[end] for end in ("low", "high"))
        ax.hlines(i, low, high, color=colour, linewidth=1.6)
        ax.plot(row["value"], i, "o", color=colour, markersize=4)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    tidy(ax, grid="x")
