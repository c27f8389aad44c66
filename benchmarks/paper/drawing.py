"""What the figures of paper.md show beside a trajectory: spheres, guide regions, sampled trajectories and their legend.

Every function draws into given axes, as those of `torchgco.plotting.trajectory` do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.obstacles.base import ADMITTED
from torchgco.plotting import trajectory
from torchgco.plotting.bodies import ABOVE, Plane
from torchgco.plotting.style import INK, PALETTE
from torchgco.plotting.trajectory import EDGE, STONE

PLAN, SAMPLE, REGION = PALETTE[2], "#8CC8EA", "#BFE5D3"
COMMON = ("knot", "infeasible", "obstacle", "inflated", "start", "goal")  # entries of the package's own legends


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


def draw_samples(ax: Axes, samples: np.ndarray, plane: Plane = ABOVE) -> None:
    """Thin blue lines: sampled trajectories (S, N+1, d)."""
    lines = LineCollection(list(samples[..., plane]), colors=SAMPLE, linewidths=0.4, zorder=1)
    ax.add_collection(lines, autolim=False)


def draw_plan(ax: Axes, positions: np.ndarray, plane: Plane = ABOVE, width: float = 1.4) -> None:
    """A green line: what the samples were averaged to, or another proposal (N+1, d)."""
    ax.plot(*positions[:, plane].T, color=PLAN, linewidth=width, zorder=2)


def draw_region(ax: Axes, centers: np.ndarray, radii: np.ndarray) -> None:
    """Guide regions: balls at the guided knots, those with a finite radius.

    centers (N+1, d) and radii (N+1,), m
    """
    guided = np.isfinite(radii)
    look = {"facecolor": REGION, "edgecolor": PLAN, "linewidth": 0.4}
    _discs(ax, centers[guided][:, ABOVE], radii[guided], zorder=2, **look)


def draw_pulls(ax: Axes, knots: np.ndarray, centers: np.ndarray, plane: Plane = ABOVE) -> None:
    """Bent arrows from guided knots (K, d) to the centres (K, d) of their regions."""
    look = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.9, "mutation_scale": 9, "shrinkA": 2, "shrinkB": 0}
    for tail, head in zip(knots[:, plane], centers[:, plane], strict=True):
        bend = {"connectionstyle": "arc3,rad=-0.35"}
        ax.annotate("", xy=tuple(head), xytext=tuple(tail), arrowprops={**look, **bend}, zorder=6)


def handles(*names: str, **labels: str) -> list[Artist]:
    """Entries of a legend, as `trajectory.handles`, also plan, samples, region and pull."""
    known: dict[str, Artist] = dict(zip(COMMON, trajectory.handles(*COMMON), strict=True)) | {
        "plan": Line2D([], [], color=PLAN, linewidth=1.4, label="MPPI's result"),
        "samples": Line2D([], [], color=SAMPLE, linewidth=0.8, label="MPPI's samples"),
        "region": Patch(facecolor=REGION, edgecolor=PLAN, label="guide region"),
        "pull": Line2D([], [], color=INK, marker=r"$\rightarrow$", markersize=10, label="pull", linestyle="none"),
    }
    for name, label in labels.items():
        known[name].set_label(label)
    return [known[name] for name in names]


def _discs(ax: Axes, centers: np.ndarray, radii: np.ndarray, **look: Any) -> None:
    circles = [Circle((x, y), radius) for (x, y), radius in zip(centers, radii, strict=True)]
    ax.add_collection(PatchCollection(circles, **look), autolim=False)
