"""Maps of occupied cells or points, drawn by their distance fields."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchgco.maps.distance import DistanceField
from torchgco.plotting.bodies import Plane

TOUCH = 0.01  # spacings of the lattice: so near counts as inside
MOST_NODES = 1500  # along an axis of a picture


def draw_map(
    ax: Axes, field: DistanceField, path: np.ndarray, plane: Plane, margin: float, look: dict[str, Any]
) -> None:
    """Fill what a map occupies, and outline it at `margin` (m) from its sides.

    In space it is cut, at each x, in the height (in the side view: at the y) that the path (K, d) has there.

    Args:
        look: colours `facecolor` and `edgecolor`.
    """
    axes = [field.origin[0, k] + field.spacing * np.arange(size) for k, size in enumerate(field.values.shape[1:])]
    values = field.values[0]
    if field.d == 3:
        (hidden,) = {0, 1, 2} - set(plane)
        nearest = np.abs(path[None, :, 0] - axes[0][:, None]).argmin(1)
        level = np.rint((path[nearest, hidden] - field.origin[0, hidden]) / field.spacing).astype(int)
        level = np.clip(level, 0, len(axes[hidden]) - 1)
        values = np.moveaxis(values, hidden, 1)[np.arange(len(level)), level]
    steps = [max(-(-size // MOST_NODES), 1) for size in values.shape]
    x, y = (axes[k][::step] for k, step in zip(plane, steps, strict=True))
    thin = values[:: steps[0], :: steps[1]].T
    limits = ax.get_xlim(), ax.get_ylim()
    near = TOUCH * field.spacing
    if (thin <= near).any() and min(thin.shape) > 1:
        ax.contourf(x, y, thin, [-np.inf, near], colors=[look["facecolor"]], zorder=0.1)
        if margin > near:
            ax.contour(x, y, thin, [margin], colors=[look["edgecolor"]], linewidths=0.6, zorder=0.3)
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])
