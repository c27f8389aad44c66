"""The search among a map's cells in C (c/lattice.c): what it reads and writes, and its library."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.native.declarations import Header, Structure
from torchgco.roadmap.library import C, library_of

SURE_SPACINGS = 2.0  # spacings beyond contact from which a distance is taken as it is, without interpolating
WAY_PARTS = 4  # of the way between two blocks, for each of the larger one's layers, between which it is looked at


# fmt: off
class Map(Structure): ...
class Graph(Structure): ...
class Sweep(Structure): ...
class String(Structure): ...
# fmt: on


LATTICE_HEADER = Header((C / "lattice.h").read_text())
LATTICE_HEADER.declare(Map, Graph, Sweep, String)


def library_for(d: int) -> ctypes.CDLL | None:
    """The library for space of this dimension; None where there is none, see `library_of`."""
    constants = {"DIM": d, "PARTS": WAY_PARTS, "SURE": SURE_SPACINGS}
    return library_of("lattice.c", LATTICE_HEADER, constants, "no paths are sought in maps")


def call(name: str, d: int, *arguments: Any) -> int:
    """Call a function of the library, which must be there; structures are passed by their addresses."""
    library = library_for(d)
    assert library is not None
    return getattr(library, name)(*(ctypes.byref(one) if isinstance(one, Structure) else one for one in arguments))


def map_of(values: NDArray[np.float32], low: NDArray[np.int64], size: NDArray[np.int64], **numbers: float) -> Map:
    """What C reads of a map; see `Clearances`."""
    three = [np.ones(3, np.int64), np.zeros(3, np.int64), np.ones(3, np.int64)]
    for whole, part in zip(three, (values.shape, low, size), strict=True):
        whole[: values.ndim] = part
    shape, before, count = map(torch.from_numpy, three)
    return Map.complete(values=torch.from_numpy(values), shape=shape, low=before, size=count, **numbers)
