"""A study in one figure, at the size at which a paper prints it: layouts, rates and costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import PercentFormatter

from torchgco.base.errors import InputError
from torchgco.obstacles.base import Obstacles
from torchgco.plotting.bodies import ABOVE
from torchgco.plotting.layouts import draw_layout, ends, ends_shown, flights_of, views
from torchgco.plotting.maps import map_handles
from torchgco.plotting.rates import OUTCOMES
from torchgco.plotting.scene import Arrays, Scene, scene_of
from torchgco.plotting.style import DASHES, INK, TEXT, legend_columns, solver_colours, solver_handles, tidy
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.plotting.ways import Ways

Columns = Literal["one", "two"]
COSTLIEST = 2.0  # times the best known cost, where the axis of costs ends


@dataclass(frozen=True)
class Print:
    """How large a figure is on paper.

    Args:
        width: inches.
        font: of all text, points.
        maps: layouts side by side; there are two rows.
        charts: beside each other.
        thin: widths of lines and sizes of marks as a share of those on a screen.
    """

    width: float
    font: float
    maps: int
    charts: int
    thin: float


# One column, and the width of the page, of papers of the IEEE in two columns.
PRINTS: dict[Columns, Print] = {"one": Print(3.5, 7.0, 2, 1, 0.55), "two": Print(7.16, 8.0, 3, 2, 0.65)}
LEFT, RIGHT, GAP, LEAD, FOOT, CHART = 0.46, 0.06, 0.14, 0.17, 0.34, 1.25  # inches
STUDY_MARGIN = 0.55  # inches at the left of a chart, whose labels are wider than those of maps


def study_figure(
    layouts: Arrays,
    trajectories: Ways,
    trials: pd.DataFrame,
    summary: pd.DataFrame,
    columns: Columns = "two",
    body: VehicleBody | None = None,
    position: slice | None = None,
    obstacles: Sequence[Sequence[Obstacles]] | None = None,
) -> Figure:
    """Maps of the first layouts, from above; rates with Wilson intervals; shares of layouts up to a cost.

    Args:
        layouts, trajectories, trials: of one scenario and model, as for `layouts.layout_grid`; with costs, too.
        summary: as `experiments.statistics.summarise` returns it.
        columns: of a paper in two columns that the figure spans.
        body, position, obstacles: as for `layouts.layout_grid`.

    A layout counts for the costs of a solver where it was reached; a line ends at the share of these.

    Raises:
        InputError: another number of columns, several tasks, or arguments that don't fit.
    """
    if columns not in PRINTS:
        raise InputError("columns", "one or two", columns)
    if len(summary[["scenario", "model"]].drop_duplicates()) != 1:
        raise InputError("summary", "one scenario and model", summary[["scenario", "model"]].drop_duplicates().values)
    form, scene = PRINTS[columns], scene_of(layouts, body, position, obstacles)
    count = min(len(layouts["radii"]), 2 * form.maps)
    flights = flights_of(scene, {name: ways[:count] for name, ways in trajectories.items()}, trials)
    boxes = views(scene, flights, count, min(form.maps, count))
    handles = _handles(summary, form, scene, ends(scene, flights, boxes, min(form.maps, count)))
    figure, maps, charts = _frame(boxes, count, form, handles)
    for i, ax in enumerate(maps):
        draw_layout({ABOVE: ax}, scene, i, flights)
        ax.set_title(f"layout {scene.ids[i]}", loc="left", color=INK, pad=2)
    _rates(charts[0], summary)
    _costs(charts[1], trials)
    _shrink(figure, form)
    return figure


def _frame(
    boxes: list[np.ndarray], count: int, form: Print, handles: list[Artist]
) -> tuple[Figure, list[Axes], list[Axes]]:
    """The figure with its legend, and the axes of maps and charts, placed in inches: maps have equal scales."""
    across = min(form.maps, count)
    wide = (form.width - LEFT - RIGHT - (across - 1) * GAP) / across
    highs = [wide * float(np.ptp(box[:, 1]) / np.ptp(box[:, 0])) for box in boxes]
    columns = legend_columns(handles, form.width * TEXT / form.font)
    top = 0.06 + 1.6 / 72.0 * form.font * ceil(len(handles) / columns)
    stacked = ceil(2 / form.charts)
    high = top + sum(highs) + LEAD * len(boxes) + FOOT + stacked * (CHART + LEAD + FOOT)
    figure = Figure(figsize=(form.width, high))
    y, maps, charts = high - top, [], []
    for row, (box, tall) in enumerate(zip(boxes, highs, strict=True)):
        y -= LEAD + tall
        for i in range(row * across, min((row + 1) * across, count)):
            x = LEFT + (i - row * across) * (wide + GAP)
            ax = figure.add_axes((x / form.width, y / high, wide / form.width, tall / high))
            ax.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
            tidy(ax, grid=None)
            ax.locator_params(nbins=4)
            lowest = i + across >= count
            ax.tick_params(labelleft=i == row * across, labelbottom=lowest)
            ax.set(ylabel="y [m]" if i == row * across else "", xlabel="x [m]" if lowest else "")
            maps.append(ax)
    y -= FOOT
    wide = form.width / form.charts - STUDY_MARGIN - RIGHT
    for k in range(2):
        row, column = divmod(k, form.charts)
        x, low = column * form.width / form.charts + STUDY_MARGIN, y - LEAD - CHART - row * (LEAD + CHART + FOOT)
        charts.append(figure.add_axes((x / form.width, low / high, wide / form.width, CHART / high)))
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0), "borderpad": 0.2}
    figure.legend(handles=handles, ncols=columns, frameon=False, columnspacing=1.2, fontsize=form.font, **where)
    return figure, maps, charts


def _handles(summary: pd.DataFrame, form: Print, scene: Scene, ends: list[Artist]) -> list[Artist]:
    lines = solver_handles(solver_colours(summary["solver"]), linewidth=1.2)
    points = [*ends_shown(scene), Line2D([], [], color=INK, marker="X", linestyle="none", label="contact")]
    for point in points:
        point.set_markersize(9 * form.thin)
    return [*lines, *points, *ends, *map_handles(scene.map)]


def _rates(ax: Axes, summary: pd.DataFrame) -> None:
    """Points with intervals: how many layouts attain each outcome."""
    colours = solver_colours(summary["solver"])
    step = 0.7 / max(1, len(summary))
    for i, row in enumerate(summary.to_dict("records")):
        for j, name in enumerate(OUTCOMES):
            if not row[f"{name}_n"]:
                continue
            x = j + (i - 0.5 * (len(summary) - 1)) * step
            rate, low, high = (float(row[f"{name}_{suffix}"]) for suffix in ("rate", "low", "high"))
            spread = [[max(rate - low, 0.0)], [max(high - rate, 0.0)]]
            look: dict[str, Any] = {"color": colours[str(row["solver"])], "capsize": 2, "elinewidth": 0.9}
            ax.errorbar(x, rate, spread, fmt="o", markersize=6, **look)
    ax.set_xticks(range(len(OUTCOMES)), OUTCOMES)
    ax.set(xlim=(-0.5, len(OUTCOMES) - 0.5), ylim=(-0.03, 1.03), ylabel="layouts")
    ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    counts = sorted({int(n) for n in summary["n"]})
    tidy(ax, f"{' and '.join(map(str, counts))} layouts, 95 % intervals")


def _costs(ax: Axes, trials: pd.DataFrame) -> None:
    """The share of the layouts that each solver reached at up to a cost, as a multiple of the best known one."""
    for name, colour in solver_colours(trials["solver"].unique()).items():
        rows = trials[trials["solver"] == name]
        ratio = (rows["cost"] / rows["best_cost"]).to_numpy(dtype=float, na_value=np.nan)
        known = np.sort(ratio[rows["reached"].to_numpy(dtype=bool) & np.isfinite(ratio) & (ratio > 0)])
        share = np.arange(1, len(known) + 1) / len(rows)
        x = np.concatenate((known[:1].clip(max=1.0) if len(known) else [1.0], known, [COSTLIEST]))
        y = np.concatenate(([0.0], share, share[-1:] if len(share) else [0.0]))
        look: dict[str, Any] = {"color": colour, "linestyle": DASHES[colour], "linewidth": 1.8}
        ax.plot(x, y, drawstyle="steps-post", **look)
    ax.set(xlim=(0.995, COSTLIEST), ylim=(-0.03, 1.03), xlabel="cost over the best known", ylabel="reached at up to")
    ax.set_xscale("log")
    ticks = [1.0, 1.05, 1.2, 1.5, COSTLIEST]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    tidy(ax)


def _shrink(figure: Figure, form: Print) -> None:
    """Text of one size, and lines and marks of a paper's weight."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_fontsize(form.font)
    for ax in figure.axes:
        ax.tick_params(labelsize=form.font - 0.5, width=0.5, length=2, pad=2)
        ax.xaxis.labelpad = ax.yaxis.labelpad = 1
        for spine in ax.spines.values():
            spine.set_linewidth(0.5)
        for shape in (*ax.lines, *ax.patches):
            shape.set_linewidth(form.thin * shape.get_linewidth())
        for line in ax.lines:
            line.set_markersize(form.thin * line.get_markersize())
