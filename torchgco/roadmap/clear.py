"""Ways through maps that keep clear of obstacles as far as there is room: for vehicles that turn slowly.

A path that is drawn taut turns at the very corners, where such a vehicle has to stop. These are the cheapest ways where
all that is near an obstacle is expensive, in the middle of doors, with their corners averaged.
"""

from __future__ import annotations

import numpy as np
import scipy

from torchgco.maps.ways import length
from torchgco.roadmap.cheapest import HOPS
from torchgco.roadmap.geometry import Scene
from torchgco.roadmap.lattice import Array, Lattice
from torchgco.roadmap.mapped import CLOSE_UNITS, Price, Ways, even, in_one, one_of_each_class, ways_of

ROOMY = 4.0  # units from an obstacle within which a way costs up to double: the middle of doors up to eight units wide
AVERAGED = 0.8  # units: the standard deviation over which the corners of a path with few of them are averaged


def clear_ways(scene: Scene, b: int, count: int) -> list[Array]:
    """Ways (P, d), m, of the problem at place b, from block to block; in the plane one of each homotopy class.

    Of up to `count` classes, the cheapest first, and of as many more that are the cheapest where only the last of the
    room is expensive, as for paths that are drawn taut: a wide way round may cost far more to fly. In space one.
    """

    def search(lattice: Lattice, ends: Array, price: Price, radius: float, unit: float) -> list[Array]:
        ways = ways_of(lattice, ends, price, radius, ROOMY * unit)
        if ways is None:
            return []
        if lattice.d == 3:
            return [ways.path(int(ways.total.argmin()))]
        closer = Ways(ways.blocks, ends, price, CLOSE_UNITS * unit, ways.free_above)
        wide, near = one_of_each_class(ways), one_of_each_class(closer)
        kinds = dict.fromkeys([*list(wide)[:count], *list(near)[:count]])
        return [ways.path(wide[kind]) for kind in kinds if kind in wide]

    return in_one(scene, b, 0.0, search)


def clear_path(lattice: Lattice, ends: Array, price: Price, radius: float, unit: float) -> list[Array]:
    """A path (HOPS+1, d) that keeps clear of obstacles as far as its way allows, its corners averaged; none, or one."""
    ways = ways_of(lattice, ends, price, radius, ROOMY * unit)
    if ways is None:
        return []
    path = ways.path(int(ways.total.argmin()))
    step = max(lattice.spacing, length(path) / (HOPS * ROOMY))
    points = even(path, max(2, int(np.ceil(length(path) / step)) + 1))
    inner = scipy.ndimage.gaussian_filter1d(points, AVERAGED * unit / step, axis=0, mode="nearest")
    return [even(np.concatenate((ends[:1], inner[1:-1], ends[1:])), HOPS + 1)]


def evenly(way: Array, step: float) -> Array:
    """Points (P, d) at equal distances of about `step`, m, along a way (Q, d)."""
    return even(way, max(2, round(length(way) / step) + 1))


def smoothed(points: Array, deviation: float) -> Array:
    """Points (P, d) averaged by a Gaussian of so many points; the ends stay where they are."""
    if deviation <= 0.0:
        return points
    between = points - np.linspace(points[0], points[-1], len(points))  # 0 at both ends
    odd = np.concatenate((-between[:0:-1], between, -between[-2::-1]))  # about both: averages there are 0, too
    averaged = scipy.ndimage.gaussian_filter1d(odd, deviation, axis=0, mode="nearest")
    return points - between + averaged[len(points) - 1 : 2 * len(points) - 1]
