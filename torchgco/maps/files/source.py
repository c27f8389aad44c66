"""A map's file while it is read: its bytes within limits, and errors that name it."""

from __future__ import annotations

import os
import stat
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.grid import OccupancyGrid

MOST_BYTES = 2**30  # of a file that is read whole
MOST_TEXT = 2**28  # bytes of points written as text
MOST_CELLS = 2**27  # of a grid: 512 x 512 x 512
MOST_POINTS = 2**25
FARTHEST_AT = 1e7  # m, of any coordinate: what lies farther has another unit
PATH_ROOM = 150  # of a path in an error
LEAST_CELL = 1e-6  # m, of a cell

T = TypeVar("T")


@dataclass(frozen=True)
class Source:
    """The file at `path`; errors name arguments as `<name>.path`."""

    path: Path
    name: str = "map"

    @property
    def field(self) -> str:
        """What errors call the path."""
        return f"{self.name}.path"

    def needs(self, option: str, value: T | None, expected: str) -> T:
        """The value of an option of `read` that this file needs; InputError where it isn't given."""
        if value is None:
            raise InputError(f"{self.name}.{option}", f"{expected}, for {self.path}", value)
        return value

    def refuse(self, expected: str, got: object) -> NoReturn:
        """Raise InputError, which names the file before what came."""
        path = str(self.path)
        path = path if len(path) <= PATH_ROOM else f"...{path[-PATH_ROOM:]}"  # so that an error has room for the rest
        raise InputError(self.field, expected, f"{path}: {got}")

    def size(self, expected: str) -> int:
        """Bytes of a regular file.

        Raises:
            InputError: it isn't there, or is a folder, a pipe or a device.
        """
        try:
            status = os.stat(self.path)
        except (OSError, ValueError) as error:
            self.refuse(expected, _reason(error))
        if not stat.S_ISREG(status.st_mode):
            self.refuse(expected, "a folder" if stat.S_ISDIR(status.st_mode) else "no regular file")
        return status.st_size

    def bytes(self, expected: str, most: int = MOST_BYTES) -> bytes:
        """The whole file; InputError where it has more than `most` bytes."""
        size = self.size(expected)
        if size > most:
            self.refuse(f"{expected} of at most {most:,} bytes", f"{size:,} bytes")
        try:
            return self.path.read_bytes()
        except OSError as error:
            self.refuse(expected, _reason(error))

    def limit(self, count: int, most: int, what: str) -> None:
        """InputError where `count` of `what` is more than `most`: called before memory is taken."""
        if count > most:
            self.refuse(f"at most {most:,} {what}", f"{count:,}")

    @contextmanager
    def library(self, expected: str) -> Iterator[None]:
        """Whatever a library raises on damaged bytes becomes one InputError; its warnings are kept quiet."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        except InputError:
            raise
        except Exception as error:  # damaged bytes make NumPy, Pillow and zlib raise nearly anything
            self.refuse(expected, _reason(error))


def _reason(error: Exception) -> str:
    said = getattr(error, "strerror", None) or str(error)
    return (said.splitlines() or [type(error).__name__])[0]


class Cursor:
    """Reads a file's bytes in order; an end that comes too early is an InputError that names the byte.

    Args:
        expected: what the file should be, for errors.
        at: the first byte.
    """

    def __init__(self, source: Source, data: bytes, expected: str, at: int) -> None:
        self.source, self.expected, self.at, self.data = source, expected, at, memoryview(data)

    @property
    def left(self) -> int:
        """Bytes that follow."""
        return len(self.data) - self.at

    def take(self, count: int, what: str) -> memoryview:
        """The next `count` bytes."""
        if count < 0 or count > self.left:
            expected = f"{self.expected} with {count:,} bytes of {what} at byte {self.at:,}"
            self.source.refuse(expected, f"{self.left:,} bytes there")
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, kind: str, what: str) -> Any:
        """The next number, by a letter of `struct`, little-endian."""
        return struct.unpack(f"<{kind}", self.take(struct.calcsize(f"<{kind}"), what))[0]

    def text(self, count: int, what: str) -> str:
        """The next `count` bytes as UTF-8; bytes that aren't are replaced."""
        return bytes(self.take(count, what)).decode("utf-8", "replace")


def finite_points(source: Source, points: np.ndarray | list[np.ndarray]) -> np.ndarray:
    """Points (P, d), or d arrays of coordinates, as float64, without rows that aren't finite.

    Sensors write such rows where nothing came back.
    """
    with np.errstate(invalid="ignore"):  # some kinds of NaN
        points = np.stack([p.astype(np.float64) for p in points], 1) if isinstance(points, list) else points
        points = np.asarray(points, np.float64)
    kept = np.isfinite(points).all(1)
    if not kept.any():
        source.refuse("at least one point of finite coordinates", f"{len(points):,} points, none of them finite")
    points = points if kept.all() else points[kept]
    check_far(source, points)
    return points


def check_far(source: Source, coordinates: np.ndarray) -> None:
    """InputError where finite coordinates are beyond `FARTHEST_AT`."""
    if (farthest := float(np.abs(coordinates).max(initial=0.0))) > FARTHEST_AT:
        source.refuse(f"coordinates within {FARTHEST_AT:g} m", f"{farthest:g}")


def whole(source: Source, text: str, what: str, least: int = 0) -> int:
    """A whole number of at least `least`, written in decimal digits."""
    if not text.isascii() or not text.isdigit() or len(text) > 18 or int(text) < least:
        source.refuse(f"{what}, a whole number >= {least}", shown(text))
    return int(text)


def made(source: Source, occupied: np.ndarray, origin: Any, resolution: Any) -> OccupancyGrid:
    """The grid; what it refuses, and lengths that are too large or too small, become errors that name the file."""
    source.limit(occupied.size, MOST_CELLS, "cells")
    try:
        grid = OccupancyGrid(occupied, origin, resolution)
    except InputError as error:
        source.refuse(f"{error.field}: {error.expected}", error.got)
    if not grid.resolution >= LEAST_CELL:
        source.refuse(f"cells of at least {LEAST_CELL:g} m", f"{grid.resolution:g} m")
    check_far(source, np.stack([grid.origin, grid.upper]))
    return grid
