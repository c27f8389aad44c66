"""Shared by all figures: a colour per solver, panels, axes, grids of maps, and saving.

Figures are plain `matplotlib.figure.Figure` objects without pyplot, so that no window system and no global
state is touched, and a figure is freed when nothing refers to it.

They are placed by hand: the automatic layouts of matplotlib leave gaps around axes of equal scales.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from itertools import pairwise
from math import ceil
from pathlib import Path
from textwrap import fill
from typing import IO, Any, Literal
from zlib import crc32

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from torchgco.plotting.bodies import Plane

# Okabe and Ito's colours, distinct for colour-blind readers too; their yellow is lost on white paper.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# The presets' colours. Those after the first seven are Paul Tol's.
KNOWN: dict[str, str] = {
    "gco": PALETTE[0], "al_ilqr": PALETTE[1], "gco_paper": PALETTE[3], "fatrop": PALETTE[2], "mppi": PALETTE[4],
    "ilqr": PALETTE[5], "hold": "#7F7F7F", "ipopt": "#882255", "gco_fast": "#44AA99", "interior_point": "#AA4499",
    "gco_exact": "#88CCEE", "gco_max": "#332288", "multistart": "#999933", "fatrop_guided": "#117733",
    "path_pursuit": "#CC6677",
}  # fmt: skip
# Each colour has its dash, so that colours that colour-blind readers may take for each other have different ones.
DASHES: dict[str, Any] = {
    colour: dash
    for dash, colours in {
        "-": (PALETTE[0], PALETTE[6], "#88CCEE", "#CC6677"), (0, (5, 1.5)): (PALETTE[1], "#44AA99"),
        (0, (6, 1.5, 1.5, 1.5)): (PALETTE[3], "#332288", "#117733"),
        (0, (1.5, 1.5)): (PALETTE[2], PALETTE[4], "#AA4499"), (0, (3, 3)): (PALETTE[5], "#7F7F7F"),
        (0, (8, 1.5, 1.5, 1.5, 1.5, 1.5)): ("#882255", "#999933"),
    }.items() for colour in colours
}  # fmt: skip
INK, FAINT = "#333333", "#BBBBBB"
EDGE = "#A39B8B"  # of obstacles
DPI = 80  # of animations
SMALL, TEXT, TITLE = 8, 9, 10  # points
LETTER = 0.07  # inches, of a text
IN_NOTEBOOKS = 80  # dots per inch


class NotebookFigure(Figure):
    """A figure that notebooks show, also where nobody has loaded pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        _save_png(self, buffer, IN_NOTEBOOKS)
        return buffer.getvalue()


def solver_colours(solvers: Iterable[str]) -> dict[str, str]:
    """A colour (hex) for each solver, the same in every figure.

    Names in KNOWN have fixed colours. Any other name starts at a place computed from its letters and takes the
    first free colour from there; two share a colour only if there are more solvers than colours.
    """
    names = list(dict.fromkeys(solvers))
    colours = {name: KNOWN[name] for name in names if name in KNOWN}
    for name in sorted(set(names) - set(KNOWN)):
        start = crc32(name.encode()) % len(PALETTE)
        ring = PALETTE[start:] + PALETTE[:start]
        colours[name] = next((colour for colour in ring if colour not in colours.values()), ring[0])
    return {name: colours[name] for name in names}


def solver_handles(colours: Mapping[str, str], **look: Any) -> list[Line2D]:
    """A line of a legend for each solver, by its colour and that colour's dash."""
    return [Line2D([], [], color=c, linestyle=DASHES[c], label=name, **look) for name, c in colours.items()]


def panels(count: int, columns: int, size: tuple[float, float], share: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels of `size` (width, height in inches) in at most `columns` columns.

    Args:
        share: one scale for all panels, labelled at the outer ones only.
    """
    columns = min(columns, count)
    rows = ceil(count / columns)
    # The extra height is the legend's.
    figure = NotebookFigure(figsize=(columns * size[0], rows * size[1] + 0.5), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    axes = list(grid.flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def tidy(axes: Axes, title: str = "", grid: str | None = "y") -> None:
    """Plain axes: two spines, small ticks, a title at the left, grid lines along "x", "y", "both" or None."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL, colors=INK)
    axes.set_axisbelow(True)
    axes.set_title(title, fontsize=TITLE, loc="left", color=INK)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(fontsize=TEXT, color=INK)
    if grid is not None:
        axes.grid(axis=grid, color="#E6E6E6", linewidth=0.8)  # type: ignore[arg-type]


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """One legend above all panels, where it covers no data, in as few rows as the figure's width allows."""
    columns = legend_columns(handles, figure.get_figwidth())
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, fontsize=TEXT, frameon=False)


def legend_columns(handles: Sequence[Artist], width: float) -> int:
    """The most columns in which a legend fits into a width, inches; matplotlib fills it column by column."""
    needed = [0.65 + LETTER * len(str(handle.get_label())) for handle in handles]
    for columns in range(len(handles), 1, -1):
        rows, longer = divmod(len(handles), columns)
        ends = [(rows + 1) * min(i, longer) + rows * max(i - longer, 0) for i in range(columns + 1)]
        if sum(max(needed[first:last]) for first, last in pairwise(ends)) <= width:
            return columns
    return 1


def tasks_of(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each task in order of appearance, with a title for their panel.

    A task is (scenario, model) and, in a merged table, the values of the swept variables: the columns with a dot.
    """
    swept = [name for name in table.columns if "." in str(name)]
    groups = table.groupby(["scenario", "model", *swept], sort=False, dropna=False, observed=True)
    for (scenario, model, *values), rows in groups:
        more = [_setting(str(name), value) for name, value in zip(swept, values, strict=True) if pd.notna(value)]
        yield ", ".join([f"{scenario} ({model})", *more]), rows


def _setting(name: str, value: object) -> str:
    words = name.split(".")[-1].replace("_", " ")
    return f"{words} {value:g}" if isinstance(value, float) else f"{words} {value}"


def save(
    figure: Figure, path: str | os.PathLike[str] | IO[bytes], dpi: int = 150, form: Literal["png", "pdf"] = "png"
) -> Path | None:
    """Write the figure, in the format that the ending of `path` names, into a folder made if need be.

    An open file instead of a path gets the format `form`; nothing is returned then. A PDF holds its text as text, and
    no date: the same figure has the same bytes.
    """
    if not isinstance(path, str | os.PathLike):
        if form == "png":
            _save_png(figure, path, dpi)
        else:
            with rc_context({"pdf.fonttype": 42}):
                figure.savefig(path, format=form, facecolor="white", metadata={"CreationDate": None})
        return None
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        _save_png(figure, path, dpi)
    else:
        figure.savefig(path, dpi=dpi, facecolor="white")
    return path


def _save_png(figure: Figure, path: Path | IO[bytes], dpi: int) -> None:
    """As `savefig`, which draws everything once more than it is seen, to lay the axes out."""
    former_dpi, colour = figure.dpi, figure.get_facecolor()
    figure.set_dpi(dpi)
    figure.set_facecolor("white")
    try:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()).save(path, format="png", dpi=(dpi, dpi))
    finally:
        figure.set_dpi(former_dpi)
        figure.set_facecolor(colour)


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


def put_head(figure: Figure, title: str, handles: list[Artist], caption: str = "") -> None:
    """Put title and legend above the panels, and a caption below, in inches that the figure grows by."""
    columns = legend_columns(handles, figure.get_figwidth())
    before = figure.get_figheight()
    below = fill(caption, int(figure.get_figwidth() / LETTER))
    foot = 0.19 * len(below.splitlines()) + (0.1 if below else 0.0)
    height = before + foot + 0.4 + 0.19 * ceil(len(handles) / columns)
    for ax in figure.axes:
        x, y, wide, high = ax.get_position(original=True).bounds
        ax.set_position((x, (foot + y * before) / height, wide, high * before / height))
    figure.set_figheight(height)
    figure.text(0.5, 1.0 - 0.08 / height, title, fontsize=TITLE + 1, color=INK, ha="center", va="top")
    if below:
        figure.text(0.5, 0.05 / height, below, fontsize=TEXT, color=INK, ha="center", va="bottom")
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0 - 0.25 / height)}
    figure.legend(handles=handles, ncols=columns, fontsize=TEXT, frameon=False, **where)
