"""The search among a map's cells in C (c/lattice.c): what it reads and writes, and its library."""

from __future__ import annotations

import ctypes
import functools
import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.kernels import EagerWarning, native
from torchgco.native.compiler import Compiler, NativeError, build, find_compiler
from torchgco.native.declarations import Header, Structure, defines
from torchgco.native.includes import included, joined

SURE_SPACINGS = 2.0  # spacings beyond contact from which a distance is taken as it is, without interpolating
WAY_PARTS = 4  # of the way between two blocks, for each of the larger one's layers, between which it is looked at
C = Path(__file__).parent / "c"


# fmt: off
class Map(Structure): ...
class Graph(Structure): ...
class Sweep(Structure): ...
class String(Structure): ...
# fmt: on


LATTICE_HEADER = Header((C / "lattice.h").read_text())
LATTICE_HEADER.declare(Map, Graph, Sweep, String)


def library_for(d: int) -> ctypes.CDLL | None:
    """The library for space of this dimension; None without a compiler, or where the process uses PyTorch's kernels."""
    compiler = find_compiler()
    return None if compiler is None or not native() else _library(d, compiler)


@functools.cache
def _library(d: int, compiler: Compiler) -> ctypes.CDLL | None:
    try:
        text = defines({"DIM": d, "PARTS": WAY_PARTS, "SURE": SURE_SPACINGS}) + included("lattice.c")
        return build(joined(text, C) + LATTICE_HEADER.layout)
    except NativeError as error:
        warnings.warn(f"paths in maps are sought by SciPy: {str(error).splitlines()[0]}", EagerWarning, stacklevel=3)
        return None


def map_of(values: NDArray[np.float32], low: NDArray[np.int64], size: NDArray[np.int64], **numbers: float) -> Map:
    """What C reads of a map; see `Clearances`."""
    three = [np.ones(3, np.int64), np.zeros(3, np.int64), np.ones(3, np.int64)]
    for whole, part in zip(three, (values.shape, low, size), strict=True):
        whole[: values.ndim] = part
    shape, before, count = map(torch.from_numpy, three)
    return Map.complete(values=torch.from_numpy(values), shape=shape, low=before, size=count, **numbers)
