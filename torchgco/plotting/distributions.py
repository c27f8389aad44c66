"""How clearances and violations are spread over the layouts of a study."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from torchgco.obstacles.base import ADMITTED
from torchgco.plotting.style import DASHES, INK, legend, panels, solver_colours, solver_handles, tasks_of, tidy

LOWEST = 1e-12
SIZE = (5.2, 3.2)  # of a panel, inches
SPACE = 0.04  # share of the axis left free at both ends
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")  # matplotlib's own formulas take long to load


def is_spread(trials: pd.DataFrame, column: str) -> bool:
    """Whether a solver has two finite values in a task: of fewer, no distribution can be drawn."""
    return any(_drawable(task, column) for _, task in tasks_of(trials))


def clearance_figure(trials: pd.DataFrame) -> Figure:
    """Share of the layouts with at most a given clearance along the trajectory (m): a step line per solver.

    Args:
        trials: with columns scenario, model, solver, clearance, two finite ones of a solver in a task at least.

    Every (scenario, model) with such clearances has a panel. Left of the line at 0 trajectories cut an obstacle: the
    height there is the share of collisions. Clearances that aren't finite are counted below the axis; a line ends
    below 100 % where there are some.
    """
    figure, shown = _panels(trials, "clearance", "surface (0.95 of both radii)")
    for ax, values in shown:
        _steps(ax, values, "clearance [m]", mark=0.0)
    return figure


def violation_figure(trials: pd.DataFrame) -> Figure:
    """Share of the layouts with at most a given violation, on a logarithmic axis, otherwise as `clearance_figure`.

    Args:
        trials: with columns scenario, model, solver, violation.

    Violations below 1e-12, zero included, are drawn there. Success requires a violation left of the line at 1e-3.
    """
    figure, shown = _panels(trials, "violation", "tolerance")
    for ax, values in shown:
        decades = {name: np.log10(sample.clip(LOWEST)) for name, sample in values.items()}
        # A linear axis of exponents: its lower end stands for all below.
        _steps(ax, decades, "violation [m, or the input's unit]", mark=np.log10(ADMITTED))
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.xaxis.set_major_formatter(FuncFormatter(_power))
    return figure


def _panels(trials: pd.DataFrame, column: str, mark: str) -> tuple[Figure, list[tuple[Axes, dict[str, np.ndarray]]]]:
    """A figure, and for each task its axes and the column's values by solver; `mark` names the dashed line."""
    tasks = [(title, task) for title, task in tasks_of(trials) if _drawable(task, column)]
    figure, axes = panels(len(tasks), 2, SIZE)
    for ax, (title, _) in zip(axes, tasks, strict=True):
        tidy(ax, title)
    colours = solver_colours(trials["solver"].unique())
    bound = Line2D([], [], color=INK, linestyle="--", linewidth=1.2, label=mark)
    legend(figure, [*solver_handles(colours, linewidth=1.6), bound])
    return figure, [(ax, _by_solver(task, column)) for ax, (_, task) in zip(axes, tasks, strict=True)]


def _power(exponent: float, _: object) -> str:
    text = f"10{f'{exponent:.0f}'.translate(RAISED)}"
    return f"≤ {text}" if exponent <= np.log10(LOWEST) else text


def _drawable(task: pd.DataFrame, column: str) -> bool:
    return any(len(_finite(values)) > 1 for values in _by_solver(task, column).values())


def _by_solver(task: pd.DataFrame, column: str) -> dict[str, np.ndarray]:
    groups = task.groupby("solver", sort=False, observed=True)[column]
    return {str(solver): values.to_numpy(dtype=float, na_value=np.nan) for solver, values in groups}


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _steps(ax: Axes, values: dict[str, np.ndarray], label: str, mark: float) -> None:
    """The share of each solver's values up to a value, over all values from the left to the right end of the axis."""
    colours = solver_colours(values)
    finite = np.concatenate([mark + np.zeros(1), *(_finite(sample) for sample in values.values())])
    space = SPACE * (float(np.ptp(finite)) or 1.0)
    ends = finite.min() - space, finite.max() + space
    for name, sample in values.items():
        x = np.sort(_finite(sample))
        share = np.arange(len(x) + 1) / len(sample)
        x, share = np.concatenate((ends[:1], x, ends[1:])), np.append(share, share[-1])
        look: dict[str, Any] = {"color": colours[name], "linestyle": DASHES[colours[name]], "linewidth": 1.6}
        ax.plot(x, share, drawstyle="steps-post", **look)
    ax.axvline(mark, color=INK, linestyle="--", linewidth=1.2)
    ax.set(xlim=ends, ylim=(-0.02, 1.02), ylabel="share of the layouts up to here")
    ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    lost = {name: int((~np.isfinite(sample)).sum()) for name, sample in values.items()}
    missing = ", ".join(f"{name} {count}" for name, count in lost.items() if count)
    ax.set_xlabel(f"{label}\nnot finite, hence not shown: {missing}" if missing else label)
