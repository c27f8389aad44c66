"""The length of the way through a map, for choosing how long a flight may take."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchgco.base.shapes import Dimensions
from torchgco.maps.distance import DistanceField
from torchgco.maps.field import BoundField, Field
from torchgco.native.compiler import NativeError
from torchgco.roadmap.geometry import length
from torchgco.roadmap.lattice import lattice_of
from torchgco.roadmap.mapped import POINTS, paths
from torchgco.roadmap.native_maps import library_for


def shortest_way(field: DistanceField, radius: float, start: Any, goal: Any) -> float | None:
    """The length of the shortest way of a vehicle through a map, m, as the roadmap finds it; None where it finds none.

    Args:
        field: a map that all problems share.
        radius: of the vehicle, m.
        start, goal: (d,), m.

    Raises:
        NativeError: without a compiler.
    """
    if library_for(field.d) is None:
        raise NativeError("the way through a map, by which its stages are chosen, takes a C compiler: state the stages")
    ends = np.array([start, goal], float)
    like = torch.from_numpy(ends[:1])
    bound = Field(field, radius).bind(Dimensions(1, 1, field.d, 0, None, slice(0, field.d), like))
    assert isinstance(bound, BoundField)
    lattice, unit = lattice_of([bound], [], ends), float(bound.sizes.max())
    found = paths(lattice, ends, lambda points: np.ones(len(points)), radius, unit, 1, POINTS)
    return float(length(torch.from_numpy(found[0])[None])[0]) if found else None
