"""The roadmap in C: its libraries, compiled at the first search, and the search among a map's cells (c/lattice.c)."""

from __future__ import annotations

import ctypes
import functools
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.kernels import EagerWarning
from torchgco.native.compiler import Compiler, NativeError, build, find_compiler
from torchgco.native.declarations import Header, Structure, defines
from torchgco.native.includes import included, joined

C = Path(__file__).parent / "c"


def library_of(file: str, header: Header, constants: Mapping[str, Any], without: str) -> ctypes.CDLL | None:
    """The library of a file in `C`, for these macros; None where it isn't there.

    That is without a compiler, of which the solver itself warns, and where the source doesn't compile: an EagerWarning
    says why, and what there is not then (`without`).
    """
    compiler = find_compiler()
    return None if compiler is None else _library(file, header.layout, tuple(constants.items()), without, compiler)


@functools.cache
def _library(
    file: str, layout: str, constants: tuple[tuple[str, Any], ...], without: str, compiler: Compiler
) -> ctypes.CDLL | None:
    try:
        return build(joined(defines(dict(constants)) + included(file), C) + layout)
    except NativeError as error:
        warnings.warn(f"{without}: {str(error).splitlines()[0]}", EagerWarning, stacklevel=4)
        return None


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
