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
from torchgco.native.compiler import Compiler, NativeError, find_compiler
from torchgco.native.declarations import Structure, fields, head, load

SURE_SPACINGS = 2.0  # spacings beyond contact from which a distance is taken as it is, without interpolating
WAY_PARTS = 4  # of the way between two blocks, for each of the larger one's layers, between which it is looked at
SOURCE = Path(__file__).parent / "c" / "lattice.c"


class Map(Structure):
    declared = (
        ("const float *", "values"),  # distances at the map's nodes
        ("const int64_t *", "shape low size"),  # (3): the map's nodes, those before its first one, all
        ("double", "spacing core limit"),
        ("int64_t", "smooth"),
    )
    _fields_ = fields(declared)


class Graph(Structure):
    declared = (
        ("const Map *", "map"),
        ("const int64_t *", "cells"),  # (3): of blocks, along each axis
        ("int64_t", "side merged"),  # nodes along the side of a cell; whether cells become one block where all are free
        ("double", "least"),  # clearance from which a block is free, m
        ("const float *", "tie"),  # (side ** DIM): what nodes are less clear than others of the same clearance, m
        ("int32_t *", "block"),  # (cells): the block of each, -1 where there is none
        ("int32_t *", "first node"),  # (blocks, 3): its first cell, its clearest node
        ("uint8_t *", "layers"),  # (blocks): cells along its side
        ("float *", "clearance"),  # (blocks)
        ("int64_t", "blocks"),
    )
    _fields_ = fields(declared)


class Sweep(Structure):
    declared = (
        ("const Graph *", "graph"),
        ("const double *", "weight"),  # (blocks): price per metre, infinite where blocked
        ("const int64_t *", "seed"),  # (seeds): blocks at which ways begin
        ("const double *", "seed_cost"),
        ("int64_t", "seeds end"),  # the block at which the cheapest way to the goal ends
        ("const double *", "ahead"),  # (blocks): of ways to the goal, no more than they cost; or NULL
        ("const int32_t *", "onward"),  # (blocks): -1 where ways to the goal end
        ("double", "deepest"),  # the clearance that joins two blocks, m
        ("double *", "cost"),  # (blocks)
        ("int32_t *", "before"),  # (blocks)
    )
    _fields_ = fields(declared)


class String(Structure):
    declared = (
        ("const Map *", "map"),
        ("const double *", "origin path"),  # (DIM), (points, DIM)
        ("int64_t", "points"),
        ("double", "least reach"),  # the clearance of segments at either end, and the longest segment, m
        ("int64_t", "parts rounds"),  # steps of a path that is drawn taut, and how often that is done
        ("double", "little"),  # gain in length, as a share, below which there is no further round
        ("double *", "taut"),  # (room, DIM)
        ("int64_t", "room"),
    )
    _fields_ = fields(declared)


def library_for(d: int) -> ctypes.CDLL | None:
    """The library for space of this dimension; None without a compiler, or where the process uses PyTorch's kernels."""
    compiler = find_compiler()
    return None if compiler is None or not native() else _library(d, compiler)


@functools.cache
def _library(d: int, compiler: Compiler) -> ctypes.CDLL | None:
    structures = [Map, Graph, Sweep, String]
    try:
        declared = head(structures, [], {"DIM": d, "PARTS": WAY_PARTS, "SURE": SURE_SPACINGS})
        return load(f"{declared}\n{SOURCE.read_text()}", structures)
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
