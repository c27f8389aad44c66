"""A trajectory among obstacles, coloured from near to far future, with guide regions and sampled trajectories.

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
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.obstacles.base import ADMITTED
from torchgco.plotting.bodies import ABOVE as ABOVE
from torchgco.plotting.bodies import SIDE as SIDE
from torchgco.plotting.bodies import Plane as Plane
from torchgco.plotting.style import EDGE as EDGE
from torchgco.plotting.style import INK, PALETTE, SMALL, TEXT

# Cool to warm without the green of the plan and the red of the crosses.
NEAR_TO_FAR = LinearSegmentedColormap.from_list("near_to_far", ["#1B4F9C", "#6A51A3", "#C2608F", "#EE8F3C", "#FBC02D"])
STONE = "#DDD8CD"
LIMIT, GUIDED = "#C62828", "#C9E0F4"
CROSS, PLAN, SAMPLE, REGION = "#D00000", PALETTE[2], "#8CC8EA", "#BFE5D3"


def inside(positions: np.ndarray, centers: np.ndarray, radii: np.ndarray, tolerance: float = ADMITTED) -> np.ndarray:
    """Which knots (N+1,) lie deeper than `tolerance`, m, in a sphere; absent spheres have a nan or zero radius.

    centers (M, d), or (N+1, M, d) where they move, and radii (M,), the vehicle's radius included.
    """
    depth = radii - np.linalg.norm(positions[:, None] - centers, axis=-1)
    return ((depth > tolerance) & (radii > 0)).any(axis=-1)


def draw_obstacles(
    ax: Axes, centers: np.ndarray, radii: np.ndarray, margin: float = 0.0, plane: Plane = ABOVE, opacity: float = 1.0
) -> None:
    """Spheres filled at their own radius and outlined at `margin` (the vehicle's radius) from it; absent ones left out.

    centers (M, d), radii (M,), m
    """
    here = np.isfinite(radii) & (radii > 0) & np.isfinite(centers).all(axis=-1)
    seen, own = centers[here][:, plane], radii[here]
    _discs(ax, seen, own, facecolor=STONE, edgecolor=EDGE, linewidth=0.5, alpha=opacity, zorder=0)
    if margin > 0:
        _discs(ax, seen, own + margin, facecolor="none", edgecolor=EDGE, linewidth=0.7, linestyle="--", zorder=0)


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


def draw_samples(ax: Axes, samples: np.ndarray, plane: Plane = ABOVE) -> None:
    """Thin blue lines: sampled trajectories (S, N+1, d)."""
    lines = LineCollection(list(samples[..., plane]), colors=SAMPLE, linewidths=0.4, zorder=1)
    ax.add_collection(lines, autolim=False)


def draw_plan(ax: Axes, positions: np.ndarray, plane: Plane = ABOVE, width: float = 1.4) -> None:
    """A green line: what the samples were averaged to, or another proposal (N+1, d)."""
    ax.plot(*positions[:, plane].T, color=PLAN, linewidth=width, zorder=2)


def draw_region(ax: Axes, centers: np.ndarray, radii: np.ndarray, plane: Plane = ABOVE) -> None:
    """Guide regions: balls at the guided knots, those with a finite radius.

    centers (N+1, d) and radii (N+1,), m
    """
    guided = np.isfinite(radii)
    look = {"facecolor": REGION, "edgecolor": PLAN, "linewidth": 0.4}
    _discs(ax, centers[guided][:, plane], radii[guided], zorder=2, **look)


def draw_pulls(ax: Axes, knots: np.ndarray, centers: np.ndarray, plane: Plane = ABOVE) -> None:
    """Bent arrows from guided knots (K, d) to the centres (K, d) of their regions."""
    look = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.9, "mutation_scale": 9, "shrinkA": 2, "shrinkB": 0}
    for tail, head in zip(knots[:, plane], centers[:, plane], strict=True):
        bend = {"connectionstyle": "arc3,rad=-0.35"}
        ax.annotate("", xy=tuple(head), xytext=tuple(tail), arrowprops={**look, **bend}, zorder=6)


def draw_ends(ax: Axes, start: np.ndarray, goal: np.ndarray, goal_radius: float = np.nan, plane: Plane = ABOVE) -> None:
    """Start and goal (d,), and the goal's radius where it is given."""
    ax.plot(*start[list(plane)], color=INK, marker="s", markersize=5, linestyle="none", zorder=5)
    ax.plot(*goal[list(plane)], color=INK, marker="*", markersize=9, linestyle="none", zorder=5)
    if np.isfinite(goal_radius):
        _discs(ax, goal[None, list(plane)], np.array([goal_radius]), facecolor="none", edgecolor=INK, linestyle=":")


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
    """Entries of a legend: any of knot, infeasible, plan, samples, region, pull, obstacle, inflated, start and goal.

    Args:
        names: in the order of the legend.
        labels: other words for some of them, by name.
    """
    point: dict[str, Any] = {"linestyle": "none"}
    known: dict[str, Artist] = {
        "knot": Line2D([], [], color=NEAR_TO_FAR(0.5), marker="o", markersize=4, label="trajectory", **point),
        "infeasible": Line2D([], [], color=CROSS, marker="x", markersize=5, label="infeasible knot", **point),
        "plan": Line2D([], [], color=PLAN, linewidth=1.4, label="MPPI's result"),
        "samples": Line2D([], [], color=SAMPLE, linewidth=0.8, label="MPPI's samples"),
        "region": Patch(facecolor=REGION, edgecolor=PLAN, label="guide region"),
        "pull": Line2D([], [], color=INK, marker=r"$\rightarrow$", markersize=10, label="pull", **point),
        "obstacle": Patch(facecolor=STONE, edgecolor=EDGE, label="obstacle"),
        "inflated": Line2D([], [], color=EDGE, linestyle="--", linewidth=0.9, label="plus vehicle"),
        "start": Line2D([], [], color=INK, marker="s", markersize=5, label="start", **point),
        "goal": Line2D([], [], color=INK, marker="*", markersize=9, label="goal", **point),
    }
    for name, label in labels.items():
        known[name].set_label(label)
    return [known[name] for name in names]


def _discs(ax: Axes, centers: np.ndarray, radii: np.ndarray, **look: Any) -> None:
    circles = [Circle((x, y), radius) for (x, y), radius in zip(centers, radii, strict=True)]
    ax.add_collection(PatchCollection(circles, **look), autolim=False)
