"""How wide a vehicle may be to get from start to goal through a map: the way whose narrowest place is widest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchgco.maps.distance import DistanceField

PASSAGE_NODES = 2**26  # of a lattice, at most, whose regions are numbered: 256 MB of numbers
NODE_ROUNDING = 1e-9  # nodes


def widest_passage(
    field: DistanceField, which: int, start: np.ndarray, goal: np.ndarray, goal_radius: float, radius: float
) -> float | None:
    """The largest radius, m, of vehicles that get to the goal, where one of `radius` can't; 0 where none does.

    Exact by the nodes of the lattice: the way's clearance at its narrowest place, at the node that is farthest from
    what is occupied. Outside of the map nothing is. Other obstacles don't count.

    Args:
        which: the number of the map.
        start, goal: (d,), m; the vehicle may stop anywhere within `goal_radius` of the goal.

    Returns:
        None where a vehicle of `radius` may get there, or the lattice is too large to tell.
    """
    values = field.values[which]
    if values.size > PASSAGE_NODES:
        return None
    padded = np.pad(values, 1, constant_values=np.inf)
    origin = field.origin[which] - field.spacing
    first = _near(padded.shape, (start - origin) / field.spacing, 1.0)
    last = _near(padded.shape, (goal - origin) / field.spacing, max(1.0, goal_radius / field.spacing))
    # A way through points with this much clearance has a node within half a cell's diagonal at each of them.
    least = radius - 0.5 * np.sqrt(field.d) * field.spacing
    if _joined(padded, least, first, last):
        return None
    levels = np.unique(values[(values > 0) & (values < least)])
    low, high = 0, len(levels)  # the ways at levels[:low] are known to be there, those at levels[high:] not
    while low < high:
        middle = (low + high) // 2
        if _joined(padded, float(levels[middle]), first, last):
            low = middle + 1
        else:
            high = middle
    return float(levels[low - 1]) if low > 0 else 0.0


def _near(shape: tuple[int, ...], center: np.ndarray, reach: float) -> tuple[NDArray[np.int64], ...]:
    """Indices of the nodes within `reach` of a place, in nodes; of a place outside, the nearest node."""
    reach += NODE_ROUNDING
    nearest = np.clip(np.rint(center), 0, np.array(shape) - 1).astype(np.int64)
    axes = [np.arange(max(0, int(np.ceil(x - reach))), min(n - 1, int(np.floor(x + reach))) + 1)
            for x, n in zip(center, shape, strict=True)]  # fmt: skip
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shape))
    near = nodes[np.linalg.norm(nodes - center, axis=1) <= reach]
    return tuple(np.concatenate((near, nearest[None])).T)


def _joined(
    clearance: np.ndarray, least: float, first: tuple[NDArray[np.int64], ...], last: tuple[NDArray[np.int64], ...]
) -> bool:
    """Whether nodes of this clearance join one of the first to one of the last."""
    from scipy.ndimage import label

    numbers, _ = label(clearance >= max(least, np.finfo(np.float32).tiny), np.ones([3] * clearance.ndim))
    here = np.unique(numbers[first])
    return bool(np.isin(numbers[last], here[here > 0]).any())
