"""Trajectories in the plane as a GIF, one picture after the other: how a solver frees a caught trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.drawing import draw_obstacles, inside
from torchgco.plotting import trajectory as draw
from torchgco.plotting.animation import FPS, PALE, write_gif
from torchgco.plotting.style import PALETTE, tidy


@dataclass(frozen=True)
class Picture:
    """One picture of `planar_animation`: trajectories in the plane, m.

    Args:
        title: what is shown.
        trajectories: (P, N+1, 2); a single one has dots from near to far future and crosses, several are thin lines.
        behind: (Q, N+1, 2), pale.
        seconds: how long it is shown.
    """

    title: str
    trajectories: np.ndarray
    behind: np.ndarray | None = None
    seconds: float = 1.0


def planar_animation(
    iterates: Sequence[Picture],
    centers: np.ndarray,
    inflated_radii: np.ndarray,
    ends: tuple[np.ndarray, np.ndarray],
    path: Path,
    vehicle_radius: float = 0.0,
    goal_radius: float = np.nan,
) -> Path:
    """Write a GIF of trajectories in the plane, one picture after the other.

    Args:
        centers, inflated_radii: of circles, (M, 2) and (M,), m.
        ends: start and goal, (2,) each, m.
        vehicle_radius, goal_radius: m.
    """
    shown = np.concatenate([np.reshape(ends, (2, 2)), *(p.trajectories.reshape(-1, 2) for p in iterates)])
    here = np.isfinite(inflated_radii)
    o, r = centers[here], inflated_radii[here, None]
    reach = np.nan_to_num(goal_radius)
    shown = np.concatenate((shown, o - r, o + r, ends[1] + reach * np.array([[-1.0], [1.0]])))
    low, high = shown.min(axis=0) - 0.05, shown.max(axis=0) + 0.05
    figure = Figure(figsize=(5.0, 4.4 * float((high - low)[1] / (high - low)[0]) + 0.8), layout="constrained")
    ax = figure.subplots()

    draw_obstacles(ax, centers, inflated_radii - vehicle_radius, vehicle_radius)
    draw.frame(ax, low.tolist(), high.tolist())
    tidy(ax, "", grid=None)

    def show(i: int) -> str:
        draw.draw_ends(ax, *ends, goal_radius)
        _trajectories(ax, iterates[i], centers, inflated_radii)
        return iterates[i].title

    frames = [i for i, picture in enumerate(iterates) for _ in range(max(1, round(picture.seconds * FPS)))]
    return write_gif([ax], show, frames, path)


def _trajectories(ax: Axes, picture: Picture, centers: np.ndarray, radii: np.ndarray) -> None:
    if picture.behind is not None:
        for path in picture.behind:
            ax.plot(*path.T, color=PALE, linewidth=1.0, zorder=1)
    if len(picture.trajectories) == 1:
        path = picture.trajectories[0]
        infeasible = inside(path, centers, radii)
        draw.draw_trajectory(ax, path, infeasible, every=max(1, len(path) // 100))
        return
    for i, path in enumerate(picture.trajectories):
        ax.plot(*path.T, color=PALETTE[i % len(PALETTE)], linewidth=0.7, zorder=3)
