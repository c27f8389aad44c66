"""Maps of cells or points, drawn by their distance fields; unknown cells have a colour of their own, a grid an edge."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch, Rectangle

from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.plotting.bodies import Plane

INSIDE_WITHIN = 0.01  # spacings of the lattice: so near counts as inside
PICTURE_NODES = 1500  # along an axis of a picture
EDGE_OF_MAP = {"fill": False, "edgecolor": "#555555", "linewidth": 0.9, "linestyle": (0, (7, 3))}
UNSEEN = "#BFD3EA"  # blue and pale, as free is white and what is occupied brown


def draw_map(
    ax: Axes, field: DistanceField, path: np.ndarray, plane: Plane, margin: float, colours: tuple[str, str]
) -> set[str]:
    """Fill what a map occupies, and outline at `margin` (m) from its sides what the vehicle keeps clear of.

    In space it is cut, at each x, in the height (in the side view: at the y) that the path (K, d) has there.

    Args:
        colours: of what is occupied, and of the outline.

    Returns:
        What is drawn, for the legend: "own", "grown" and "unknown".
    """
    axes = [field.origin[0, k] + field.spacing * np.arange(size) for k, size in enumerate(field.values.shape[1:])]
    values = _cut(field.values[0], axes, path, plane)
    steps = [max(-(-size // PICTURE_NODES), 1) for size in values.shape]
    x, y = (axes[k][::step] for k, step in zip(plane, steps, strict=True))
    thin = values[:: steps[0], :: steps[1]].T
    limits, drawn = (ax.get_xlim(), ax.get_ylim()), set[str]()
    near = INSIDE_WITHIN * field.spacing
    if (thin <= near).any() and min(thin.shape) > 1:
        ax.contourf(x, y, thin, [-np.inf, near], colors=[colours[0]], zorder=0.1)
        drawn.add("own")
        if margin > near:
            ax.contour(x, y, thin, [margin], colors=[colours[1]], linewidths=0.6, zorder=0.3)
            drawn.add("grown")
    if has_unknown(field):
        _draw_unknown(ax, field, path, plane)
        drawn.add("unknown")
    if isinstance(field.source, OccupancyGrid):
        (x0, y0), (x1, y1) = ((end[0, plane[0]], end[0, plane[1]]) for end in (field.origin, field.upper))
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=0.4, **EDGE_OF_MAP))
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])
    return drawn


def has_unknown(field: DistanceField | None) -> bool:
    """Whether a map has cells of which nobody knows whether they are free."""
    return field is not None and isinstance(field.source, OccupancyGrid) and bool(field.source.is_unknown.any())


def map_handles(field: DistanceField | None) -> list[Artist]:
    """The legend's entries of unknown cells, where there are any, and of the edge of a map of cells."""
    if field is None or not isinstance(field.source, OccupancyGrid):
        return []
    unknown = [Patch(facecolor=UNSEEN, label=f"unknown, counts as {field.unknown}")] if has_unknown(field) else []
    return [*unknown, Patch(label="edge of the map", **EDGE_OF_MAP)]


def _draw_unknown(ax: Axes, field: DistanceField, path: np.ndarray, plane: Plane) -> None:
    """Fill the unknown cells, over what is occupied: they may count as that."""
    grid = field.source
    assert isinstance(grid, OccupancyGrid)
    cells = grid.is_unknown if grid.batch is None else grid.is_unknown[0]
    origin = field.origin[0]
    middles = [origin[k] + grid.resolution * (np.arange(size) + 0.5) for k, size in enumerate(cells.shape)]
    shown = _cut(cells, middles, path, plane)
    low, high = origin, origin + grid.resolution * np.array(cells.shape)
    extent = (low[plane[0]], high[plane[0]], low[plane[1]], high[plane[1]])
    look = {"cmap": ListedColormap([UNSEEN]), "interpolation": "nearest", "origin": "lower", "zorder": 0.15}
    ax.imshow(np.ma.masked_equal(shown.T, False), extent=extent, aspect=ax.get_aspect(), **look)  # type: ignore[arg-type]


def _cut(values: np.ndarray, axes: list[np.ndarray], path: np.ndarray, plane: Plane) -> np.ndarray:
    """Values (V, W) over a plane; of those in space, where the path (K, d) has this x."""
    if values.ndim == 2:
        return values
    (hidden,) = {0, 1, 2} - set(plane)
    nearest = np.abs(path[None, :, 0] - axes[0][:, None]).argmin(1)
    level = np.abs(path[nearest, hidden][:, None] - axes[hidden]).argmin(1)
    return np.moveaxis(values, hidden, 1)[np.arange(len(level)), level]
