"""How clearances and violations are spread over the layouts of a study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from torchgco.plotting.style import INK, legend, panels, solver_colours, tasks_of, tidy

FLOOR = 1e-12
TOLERANCE = 1e-3  # violations up to this count as none, metres for lengths
SIZE = (5.2, 3.2)  # of a panel, inches
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")  # matplotlib's own formulas take long to load


def clearance_histogram(trials: pd.DataFrame) -> Figure:
    """Layouts by clearance along the trajectory (m), solvers side by side, a panel per (scenario, model).

    trials  with columns scenario, model, solver, clearance

    Left of the line at 0 the trajectory cuts an obstacle. Clearances that aren't finite are counted below the axis.
    """
    tasks = list(tasks_of(trials))
    figure, axes = panels(len(tasks), 2, SIZE)
    for ax, (title, task) in zip(axes, tasks, strict=True):
        clearance = _by_solver(task, "clearance")
        finite = np.concatenate([_finite(values) for values in clearance.values()])
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        # Round edges, 0 among them wherever both signs occur: no bin holds both collisions and clear trajectories.
        edges = MaxNLocator(nbins=16).tick_values(low, high)
        _bars(ax, clearance, edges, "clearance [m]", mark=0.0)
        tidy(ax, title)
    _legend(figure, trials, "surface (0.95 of both radii)")
    return figure


def violation_histogram(trials: pd.DataFrame) -> Figure:
    """Layouts by their largest violation, a bin per decade, otherwise as `clearance_histogram`.

    trials  with columns scenario, model, solver, violation

    Violations below 1e-12, zero included, are counted in the bin that begins there. Success requires
    a violation left of the line at 1e-3.
    """
    tasks = list(tasks_of(trials))
    figure, axes = panels(len(tasks), 2, SIZE)
    for ax, (title, task) in zip(axes, tasks, strict=True):
        decades = {name: np.log10(values.clip(FLOOR)) for name, values in _by_solver(task, "violation").items()}
        finite = np.concatenate([_finite(values) for values in decades.values()])
        top = max(np.floor(finite.max(initial=0.0)) + 1, np.log10(TOLERANCE) + 1)
        edges = np.arange(np.log10(FLOOR), top + 1).tolist()
        # A linear axis of exponents: side by side on a logarithmic one, bars would differ in width.
        _bars(ax, decades, edges, "violation [m, or the input's unit]", mark=np.log10(TOLERANCE))
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.xaxis.set_major_formatter(FuncFormatter(_power))
        tidy(ax, title)
    _legend(figure, trials, "tolerance")
    return figure


def _power(exponent: float, _: object) -> str:
    text = f"10{f'{exponent:.0f}'.translate(RAISED)}"
    return f"≤ {text}" if exponent <= np.log10(FLOOR) else text


def _by_solver(task: pd.DataFrame, column: str) -> dict[str, np.ndarray]:
    groups = task.groupby("solver", sort=False, observed=True)[column]
    return {str(solver): values.to_numpy(dtype=float, na_value=np.nan) for solver, values in groups}


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _bars(ax: Axes, values: dict[str, np.ndarray], edges: Sequence[float], label: str, mark: float) -> None:
    colours = solver_colours(values)
    data = [_finite(held) for held in values.values()]
    ax.hist(data, bins=list(edges), color=[colours[name] for name in values], alpha=0.85, rwidth=0.9)
    ax.axvline(mark, color=INK, linestyle="--", linewidth=1.2)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_ylabel("layouts")
    lost = {name: int((~np.isfinite(held)).sum()) for name, held in values.items()}
    missing = ", ".join(f"{name} {count}" for name, count in lost.items() if count)
    ax.set_xlabel(f"{label}\nnot finite, hence not shown: {missing}" if missing else label)


def _legend(figure: Figure, trials: pd.DataFrame, mark: str) -> None:
    colours = solver_colours(trials["solver"].unique())
    handles: list = [Patch(color=colour, label=solver) for solver, colour in colours.items()]
    legend(figure, [*handles, Line2D([], [], color=INK, linestyle="--", linewidth=1.2, label=mark)])
