"""How the cost of single problems develops, iteration by iteration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from torchgco.base.errors import InputError
from torchgco.plotting.style import INK, legend, panels, tidy
from torchgco.plotting.trajectory import GUIDED, LIMIT

TRACED = ("element", "iteration", "outer", "cost", "guided")
SHOWN = 4
LOGARITHMIC = 50.0  # ratio of the largest to the smallest cost from which the axis is logarithmic


def convergence_figure(trace: pd.DataFrame, elements: Sequence[int] | None = None) -> Figure:
    """Cost per iteration, a panel per problem: lines at multiplier updates, bands where guidance is on.

    Args:
        trace: a row per problem and iteration, with columns element (the problem), iteration, outer (index of the outer
            iteration), cost (J_var) and guided (bool); with a column attempt, attempts follow each other.
        elements: which problems to show; by default the first four.

    A multiplier update is drawn between the iterations before and after it. Raises InputError for a missing
    column, an empty trace and a problem that isn't in it.
    """
    missing = [name for name in TRACED if name not in trace.columns]
    if missing or trace.empty:
        raise InputError("trace", f"rows with columns {', '.join(TRACED)}", f"none of {', '.join(missing) or 'them'}")
    known = trace["element"].unique().tolist()
    shown = known[:SHOWN] if elements is None else list(elements)
    for element in shown:
        if element not in known:
            raise InputError("elements", f"problems of the trace, {known[0]} to {known[-1]}", element)
    figure, axes = panels(len(shown), 2, (5.2, 3.0))
    order = [name for name in ("attempt", "iteration") if name in trace.columns]
    for ax, element in zip(axes, shown, strict=True):
        _panel(ax, trace[trace["element"] == element].sort_values(order))
        tidy(ax, f"problem {element}")
    legend(
        figure,
        [
            Line2D([], [], color=INK, label="cost"),
            Line2D([], [], color=LIMIT, linewidth=1, label="multiplier update"),
            *([Line2D([], [], color=INK, linestyle="--", label="next attempt")] if _restarts(trace) else []),
            Patch(color=GUIDED, label="guidance on"),
        ],
    )
    return figure


def _restarts(trace: pd.DataFrame) -> bool:
    return "attempt" in trace.columns and trace["attempt"].nunique() > 1


def _panel(ax: Axes, rows: pd.DataFrame) -> None:
    iteration = rows["iteration"].to_numpy(dtype=float)
    if _restarts(rows):
        iteration = np.arange(len(rows), dtype=float)
        for change in np.flatnonzero(np.diff(rows["attempt"].to_numpy())):
            ax.axvline(change + 0.5, color=INK, linewidth=0.8, linestyle="--", zorder=1)
    cost = rows["cost"].to_numpy(dtype=float)
    for first, last in _runs(rows["guided"].to_numpy(dtype=bool)):
        ax.axvspan(iteration[first] - 0.5, iteration[last] + 0.5, color=GUIDED, linewidth=0, zorder=0)
    for change in np.flatnonzero(np.diff(rows["outer"].to_numpy())):
        ax.axvline((iteration[change] + iteration[change + 1]) / 2, color=LIMIT, linewidth=0.8, alpha=0.7, zorder=1)
    ax.plot(iteration, cost, color=INK, linewidth=1.6, marker=".", markersize=4, zorder=2)
    finite = cost[np.isfinite(cost)]
    if finite.size and finite.min() > 0 and finite.max() > LOGARITHMIC * finite.min():
        ax.set_yscale("log")
    ax.set_xlim(iteration[0] - 0.5, iteration[-1] + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("iteration")
    ax.set_ylabel("cost")


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]
