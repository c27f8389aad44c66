"""Panels of equal scales, with a title and a legend above them.

They are placed by hand: the automatic layouts of matplotlib leave gaps around axes of equal scales.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchgco.plotting.bodies import Plane
from torchgco.plotting.style import INK, TEXT, TITLE, NotebookFigure, legend_columns, tidy

GRID_WIDTH = 12.4  # inches, of a figure with columns enough; the others leave room
TITLED, GRID_LEFT, GRID_RIGHT, GRID_FOOT, GRID_GAP = 0.3, 0.6, 0.15, 0.3, 0.2


def grid(
    boxes: list[np.ndarray], count: int, columns: int, planes: Sequence[Plane]
) -> tuple[Figure, list[tuple[Axes, ...]]]:
    """A figure, and the axes of each of `count` maps, one for each plane.

    Args:
        boxes: lower and upper corners (2, d), m, of the maps in each row.
    """
    spans = [(box[1] - box[0]) for box in boxes]
    fewest = max(columns, 2)
    width = (GRID_WIDTH - GRID_LEFT - GRID_RIGHT - (fewest - 1) * GRID_GAP) / fewest
    wide = GRID_LEFT + columns * (width + GRID_GAP) - GRID_GAP + GRID_RIGHT
    heights = [[width * span[plane[1]] / span[0] for plane in planes] for span in spans]
    high = sum(TITLED + sum(row) + GRID_GAP * len(planes) for row in heights) + GRID_FOOT
    figure = NotebookFigure(figsize=(wide, high))
    axes, top = [], high
    for row, box in enumerate(boxes):
        top -= TITLED
        lowest = top - sum(heights[row]) - GRID_GAP * (len(planes) - 1)
        for i in range(row * columns, min((row + 1) * columns, count)):
            left, upper, panels = GRID_LEFT + (i - row * columns) * (width + GRID_GAP), top, []
            for plane, height in zip(planes, heights[row], strict=True):
                rect = (left / wide, (upper - height) / high, width / wide, height / high)
                panels.append(_axes(figure, rect, box, plane, i == row * columns))
                upper -= height + GRID_GAP
            if i + columns >= count:  # the lowest of its column
                panels[-1].tick_params(labelbottom=True)
                panels[-1].set_xlabel("x [m]")
            axes.append(tuple(panels))
        top = lowest - GRID_GAP
    return figure, axes


def _axes(figure: Figure, rect: tuple[float, float, float, float], box: np.ndarray, plane: Plane, first: bool) -> Axes:
    """Axes of equal scales; the labels of y are at the first of a row."""
    ax = figure.add_axes(rect)
    ax.set(xlim=box[:, 0], ylim=box[:, plane[1]], aspect="equal")
    ax.locator_params(axis="y", nbins=5)
    ax.set_ylabel(f"{'xyz'[plane[1]]} [m]" if first else "")
    tidy(ax, grid=None)
    ax.tick_params(labelbottom=False, labelleft=first)
    return ax


def put_head(figure: Figure, title: str, handles: list[Artist]) -> None:
    """Put title and legend above the panels, in inches that the figure grows by."""
    columns = legend_columns(handles, figure.get_figwidth())
    before = figure.get_figheight()
    height = before + 0.4 + 0.19 * ceil(len(handles) / columns)
    for ax in figure.axes:
        x, y, wide, high = ax.get_position(original=True).bounds
        ax.set_position((x, y * before / height, wide, high * before / height))
    figure.set_figheight(height)
    figure.text(0.5, 1.0 - 0.08 / height, title, fontsize=TITLE + 1, color=INK, ha="center", va="top")
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0 - 0.25 / height)}
    figure.legend(handles=handles, ncols=columns, fontsize=TEXT, frameon=False, **where)
