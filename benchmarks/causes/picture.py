"""What failures.md and results/shortfalls.md show: the causes, counted, and one layout for each, seen from above."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from torch import Tensor

from benchmarks.lib.page import markdown
from torchgco.plotting.style import FAINT, INK, PALETTE, legend, panels, save, tidy

PATH, PLAN = PALETTE[0], PALETTE[1]


@dataclass(frozen=True)
class Example:
    """One layout and what came of it; lengths in metres."""

    family: str
    layout: int
    centers: Tensor  # (M, d)
    inflated_radii: Tensor  # (M,) r_obs + r_veh
    path: Tensor  # (N+1, d): of the returned trajectory
    plan: Tensor | None  # (N+1, d): another trajectory; None: there is none
    goal: Tensor  # (d,)
    boxes: tuple[np.ndarray, ...] = ()  # (P, 2) each: outlines from above, inflated


def table(trials: pd.DataFrame, causes: dict[str, str], missed: str) -> str:
    """Markdown: one row per cause that was met, with its count in every family; `missed` names the sum."""
    families = list(dict.fromkeys(trials.family))
    counts = pd.crosstab(trials.cause, trials.family).reindex(index=list(causes), columns=families, fill_value=0)
    rows = [[name, meaning, *counts.loc[name]] for name, meaning in causes.items() if counts.loc[name].any()]
    flown = trials.groupby("family").cause
    sums = [f"{flown.get_group(f).notna().sum()} of {flown.get_group(f).size}" for f in families]
    return markdown(["cause", "what it means", *families], [*rows, [f"**{missed}**", "", *sums]])


def _frame(ax: Axes, example: Example) -> None:
    """Set limits around start, goal and spheres, or among boxes around the trajectories; what leaves them is cut."""
    ends = torch.stack((example.path[0, :2], example.goal[:2]))
    if example.boxes:
        half = 0.5 * float((ends[1] - ends[0]).norm())
        flown = torch.cat((example.path, example.path if example.plan is None else example.plan))[:, :2]
        inside = torch.maximum(torch.minimum(flown, ends.amax(0) + half), ends.amin(0) - half)
        points = torch.cat((ends, inside))
    else:
        here = example.inflated_radii > 0
        reach = example.inflated_radii[here].unsqueeze(-1)
        centers = example.centers[here, :2]
        points = torch.cat((centers - reach, centers + reach, ends))
    low, high = points.amin(0), points.amax(0)
    room = 0.12 * float((high - low).max())
    ax.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room))
    ax.set_aspect("equal")
    ax.set(xlabel="x [m]", ylabel="y [m]")


def picture(examples: dict[str, Example], file: Path, plan: str = "last sampled plan") -> Path:
    """Draw one panel per cause and save the figure; returns the file. `plan` says what the other trajectory is."""
    figure, axes = panels(len(examples), 2, (4.2, 2.2))
    for ax, (cause, example) in zip(axes, examples.items(), strict=True):
        for center, distance in zip(example.centers, example.inflated_radii, strict=True):
            if distance > 0:
                ax.add_patch(Circle(center[:2].tolist(), float(distance), facecolor="#E4DFD4", edgecolor=FAINT, lw=0.5))
        for outline in example.boxes:
            ax.add_patch(Polygon(outline, facecolor="#E4DFD4", edgecolor=FAINT, lw=0.5, alpha=0.6))
        if example.plan is not None:
            ax.plot(*example.plan[:, :2].T, color=PLAN, linewidth=1.2)
        ax.plot(*example.path[:, :2].T, color=PATH, linewidth=1.5)
        ax.plot(*example.goal[:2], marker="*", color=INK, markersize=8, linestyle="")
        _frame(ax, example)
        tidy(ax, f"{cause}: {example.family}, {example.layout}", grid=None)
    handles = [
        Line2D([], [], color=PATH, label="trajectory returned"),
        Line2D([], [], color=PLAN, label=plan),
        Line2D([], [], color=INK, marker="*", linestyle="", label="goal"),
    ]
    legend(figure, handles)
    save(figure, file)
    return file
