"""Clearances of one map for one vehicle at the nodes of a lattice, each computed where it is asked for.

Most of a large map is far from every sensible way, and what is far from obstacles needs no interpolation.
"""

from __future__ import annotations

import ctypes
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from torchgco.roadmap.native_maps import SURE_SPACINGS, Map, call, map_of

Nodes = NDArray[np.int64]
Numbers = NDArray[np.float64]

SPLINE_WEIGHTS = (0.125, 0.75, 0.125)  # of a quadratic B-spline at a node, along each axis


class Clearances:
    """Distances to contact at the nodes of a map, and of a margin around it, m; negative where the vehicle would touch.

    Near contact they are what the constraint's lookup gives, and beyond the map the same bound as there.

    Args:
        values: distances at the map's nodes, as in its field, m.
        low, size: nodes before the map's first one, and of the lattice, along each axis.
        spacing: of the nodes, m.
        core, limit: distance below which squares are replaced by tangents, and the one that counts as 0, m.
        smooth: whether the constraint interpolates by B-splines.
    """

    def __init__(
        self, values: NDArray[np.float32], low: Nodes, size: Nodes, spacing: float, core: float, limit: float,
        smooth: bool,
    ) -> None:  # fmt: skip
        self.values, self.low, self.size = np.ascontiguousarray(values), low, size
        self.spacing, self.core, self.limit, self.smooth = spacing, core, limit, smooth
        self.kept: dict[Any, Any] = {}  # what is made of them

    @property
    def d(self) -> int:
        return self.values.ndim

    @cached_property
    def native(self) -> Map:
        """What C reads of them."""
        numbers = {"core": self.core, "limit": self.limit, "smooth": int(self.smooth)}
        return map_of(self.values, self.low, self.size, spacing=self.spacing, **numbers)

    def at(self, nodes: Nodes) -> Numbers:
        """Clearances (...) at nodes (..., d), m."""
        place = nodes - self.low
        held = np.clip(place, 0, np.array(self.values.shape) - 1)
        beyond = ((place - held) ** 2).sum(-1) * (self.spacing * self.spacing)  # from the map, m^2
        distance = self.values[tuple(np.moveaxis(held, -1, 0))].astype(float)
        if self.smooth:
            near = distance < self.limit + SURE_SPACINGS * self.spacing
            distance[near] = self._interpolated(held[near])
        return np.where(beyond > 0, np.sqrt(np.maximum(distance, 0.0) ** 2 + beyond), distance) - self.limit

    def _interpolated(self, held: Nodes) -> Numbers:
        """What the constraint's lookup gives at nodes (M, d) of the map, m."""
        h, core, last = self.spacing, self.core, np.array(self.values.shape) - 1
        square = np.zeros(len(held))
        for steps in product((-1, 0, 1), repeat=self.d):
            near = self.values[tuple(np.clip(held + steps, 0, last).T)].astype(float)
            weight = np.prod([SPLINE_WEIGHTS[step + 1] for step in steps])
            square += weight * np.where(near < core, core * (2.0 * near - core), near * near)
        square -= 0.25 * self.d * h * h
        return np.where(
            square < core * core, (square + core * core) / (2 * core), np.sqrt(np.maximum(square, core * core))
        )

    @cached_property
    def everywhere(self) -> NDArray[np.float32]:
        """At all nodes."""
        found = np.empty(self.size, np.float32)
        call("tgco_measure", self.d, self.native, found.ctypes.data_as(ctypes.c_void_p))
        return found

    @cached_property
    def rooms(self) -> NDArray[np.int32]:
        """Numbers of the connected regions of free nodes; 0 where blocked."""
        return np.asarray(scipy.ndimage.label(self.everywhere > 0, np.ones([3] * self.d))[0])

    @cached_property
    def marks(self) -> Nodes:
        """A node (M, d) of each connected region of blocked nodes."""
        regions = np.asarray(scipy.ndimage.label(self.everywhere < 0, np.ones([3] * self.d))[0])
        _, first = np.unique(regions, return_index=True)
        nodes = np.stack(np.unravel_index(first, regions.shape), axis=-1)
        return nodes[regions.flat[first] > 0]
