"""A trajectory with its start and goal, coloured from near to far future.

Every function draws into given axes. Positions are in metres, (N+1, d) along a trajectory; `plane` names the two
coordinates that are shown, (0, 1) from above and (0, 2) from the side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.plotting.bodies import ABOVE as ABOVE
from torchgco.plotting.bodies import SIDE as SIDE
from torchgco.plotting.bodies import Plane as Plane
from torchgco.plotting.style import EDGE as EDGE
from torchgco.plotting.style import INK, SMALL, TEXT

# Cool to warm without the green of the plan and the red of the crosses.
NEAR_TO_FAR = LinearSegmentedColormap.from_list("near_to_far", ["#1B4F9C", "#6A51A3", "#C2608F", "#EE8F3C", "#FBC02D"])
STONE = "#DDD8CD"
LIMIT, GUIDED = "#C62828", "#C9E0F4"
CROSS = "#D00000"


def draw_trajectory(
    ax: Axes,
    positions: np.ndarray,
    infeasible: np.ndarray | None = None,
    plane: Plane = ABOVE,
    every: int = 1,
    cross_every: int = 1,
    size: float = 9.0,
) -> None:
    """Dots, cool at the first knot and warm at the last; red crosses at infeasible knots.

    Args:
        positions: (N+1, d).
        infeasible: (N+1,) bool; None: no crosses.
        every: a dot at every `every`-th knot.
        cross_every: a cross at every `cross_every`-th infeasible knot.
        size: area of a dot, points^2.
    """
    share = np.linspace(0.0, 1.0, len(positions))
    # The line keeps dots together where the vehicle is fast.
    ax.plot(*positions[:, plane].T, color="#9A9A9A", linewidth=0.4, zorder=3)
    seen = slice(None, None, every)
    ax.scatter(
        *positions[seen][:, plane].T, c=share[seen], cmap=NEAR_TO_FAR, vmin=0, vmax=1, s=size, linewidth=0, zorder=4
    )
    if infeasible is not None and infeasible.any():
        look: dict[str, Any] = {"marker": "x", "markersize": 4.5, "markeredgewidth": 0.9, "linestyle": "none"}
        ax.plot(*positions[infeasible][::cross_every, plane].T, color=CROSS, zorder=5, **look)


def draw_ends(ax: Axes, start: np.ndarray, goal: np.ndarray, goal_radius: float = np.nan, plane: Plane = ABOVE) -> None:
    """Start and goal (d,), and the goal's radius where it is given."""
    ax.plot(*start[list(plane)], color=INK, marker="s", markersize=5, linestyle="none", zorder=5)
    ax.plot(*goal[list(plane)], color=INK, marker="*", markersize=9, linestyle="none", zorder=5)
    if np.isfinite(goal_radius):
        ring = Circle((goal[plane[0]], goal[plane[1]]), goal_radius)
        ax.add_collection(PatchCollection([ring], facecolor="none", edgecolor=INK, linestyle=":"), autolim=False)


def frame(ax: Axes, low: Sequence[float], high: Sequence[float], plane: Plane = ABOVE) -> None:
    """Limits (d,), m, of the view and equal scales; names of the axes."""
    first, second = plane
    ax.set(xlim=(low[first], high[first]), ylim=(low[second], high[second]), aspect="equal")
    ax.set(xlabel=f"{'xyz'[first]} [m]", ylabel=f"{'xyz'[second]} [m]")


def time_bar(figure: Figure, axes: Iterable[Axes], horizon: float) -> None:
    """The colours of `draw_trajectory` as times up to `horizon`, s, at the right of some axes."""
    bar = figure.colorbar(
        ScalarMappable(Normalize(0.0, horizon), NEAR_TO_FAR), ax=list(axes), aspect=30, pad=0.02, shrink=0.9
    )
    bar.set_label("time in the plan [s]", fontsize=TEXT, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=INK)


def handles(*names: str, **labels: str) -> list[Artist]:
    """Entries of a legend: any of knot, infeasible, obstacle, inflated, start and goal.

    Args:
        names: in the order of the legend.
        labels: other words for some of them, by name.
    """
    point: dict[str, Any] = {"linestyle": "none"}
    known: dict[str, Artist] = {
        "knot": Line2D([], [], color=NEAR_TO_FAR(0.5), marker="o", markersize=4, label="trajectory", **point),
        "infeasible": Line2D([], [], color=CROSS, marker="x", markersize=5, label="infeasible knot", **point),
        "obstacle": Patch(facecolor=STONE, edgecolor=EDGE, label="obstacle"),
        "inflated": Line2D([], [], color=EDGE, linestyle="--", linewidth=0.9, label="plus vehicle"),
        "start": Line2D([], [], color=INK, marker="s", markersize=5, label="start", **point),
        "goal": Line2D([], [], color=INK, marker="*", markersize=9, label="goal", **point),
    }
    for name, label in labels.items():
        known[name].set_label(label)
    return [known[name] for name in names]
