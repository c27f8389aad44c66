"""The two kinds of messages that are maps, as ROS 1 and ROS 2 (CDR) write them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from torchgco.base.errors import shown
from torchgco.maps.files.bags.container import CLOUDS, GRIDS, Message, plain
from torchgco.maps.files.rotated import rotated
from torchgco.maps.files.source import MOST_CELLS, MOST_POINTS, Cursor, Source, check_far, finite_points, made
from torchgco.maps.grid import OccupancyGrid

ZSTD = b"\x28\xb5\x2f\xfd"  # how bytes packed by zstd begin
MOST_FIELDS = 256  # of a point
LEVEL = 1e-3  # largest tilt of a grid, of a quaternion's x and y
# PointField's numbers for types.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class Fields:
    """Reads the fields of a message in order. In CDR, numbers lie at multiples of their size."""

    def __init__(self, source: Source, message: Message) -> None:
        self.cursor = Cursor(source, message.data, f"a message of {plain(message.type)}")
        self.aligned = message.encoding == "cdr"
        self.order, self.first = "<", 0
        if self.aligned:
            head = bytes(self.cursor.take(4, "CDR's head"))
            if head[:4] == ZSTD:
                source.refuse("messages that aren't packed (`ros2 bag convert` unpacks them)", "one packed by zstd")
            if head[0] != 0 or head[1] > 1:
                source.refuse("a message in plain CDR", f"one that begins with {head!r}")
            self.order, self.first = "<" if head[1] else ">", 4

    def numbers(self, kinds: str) -> list[Any]:
        """Numbers by letters of `struct`."""
        return [self._number(kind) for kind in kinds]

    def _number(self, kind: str) -> Any:
        type = np.dtype(self.order + kind)
        if self.aligned:
            self.cursor.take(-(self.cursor.at - self.first) % type.itemsize, "padding")
        return np.frombuffer(self.cursor.take(type.itemsize, "a number"), type)[0].item()

    def bytes(self, what: str) -> memoryview:
        """As many bytes as a number before says."""
        return self.cursor.take(self._number("I"), what)

    def text(self) -> str:
        return bytes(self.bytes("text")).rstrip(b"\0").decode("utf-8", "replace")

    def header(self, ros1: bool) -> str:
        """The frame that the header names."""
        self.numbers("III" if ros1 else "iI")
        return self.text()


def decoded(source: Source, message: Message) -> OccupancyGrid | np.ndarray:
    """A grid, or points (P, 3), in the message's frame.

    Raises:
        InputError: another encoding or kind, a message that is cut, or has values out of range.
    """
    if message.encoding not in ("cdr", "ros1"):
        source.refuse("messages as cdr or ros1", shown(message.encoding[:40]))
    readers: dict[str, Callable[[Source, Fields, bool], OccupancyGrid | np.ndarray]] = {CLOUDS: _cloud, GRIDS: _grid}
    if (kind := plain(message.type)) not in readers:
        source.refuse(f"messages of {CLOUDS} or {GRIDS}", shown(kind[:40]))
    return readers[kind](source, Fields(source, message), message.encoding == "ros1")


def _grid(source: Source, fields: Fields, ros1: bool) -> OccupancyGrid:
    fields.header(ros1)
    _, _, resolution, width, height = fields.numbers("IIfII")
    x, y, _, *turn = fields.numbers("ddddddd")
    source.limit(width * height, MOST_CELLS, f"cells ({width:,} x {height:,})")
    cells = np.frombuffer(fields.bytes("cells"), np.int8)
    if cells.size != width * height or not cells.size:
        source.refuse(f"{width:,} x {height:,} cells, at least one", f"{cells.size:,}")
    if cells.min() < -1 or cells.max() > 100:
        source.refuse("cells from 0 to 100, or -1 where unknown", f"{cells.min()} to {cells.max()}")
    values = np.where(cells < 0, np.float32("nan"), cells / np.float32(100.0)).reshape(height, width).T
    if not 0.0 < resolution < math.inf:
        source.refuse("a resolution > 0 m", resolution)
    resolution = float(np.format_float_positional(np.float32(resolution)))  # 0.05, not 0.05000000074505806
    corner, yaw = np.array([x, y]), _yaw(source, turn)
    if not np.isfinite(corner).all():
        source.refuse("a finite origin", f"({x}, {y})")
    check_far(source, corner)
    if yaw:
        values, corner = rotated(source, values, corner, yaw, resolution)
    return made(source, values, corner, resolution)


def _yaw(source: Source, turn: list[float]) -> float:
    """The angle about z of a quaternion (x, y, z, w), rad; one of zeros, which some programs leave, is none."""
    x, y, z, w = turn
    size = math.hypot(*turn)
    if size == 0.0:
        return 0.0
    if not abs(size - 1.0) < 0.01 or not max(abs(x), abs(y)) < LEVEL:
        source.refuse("an origin turned about z alone, a unit quaternion", f"({x:.3g}, {y:.3g}, {z:.3g}, {w:.3g})")
    return 2.0 * math.atan2(z, w)


def _cloud(source: Source, fields: Fields, ros1: bool) -> np.ndarray:
    fields.header(ros1)
    height, width, count = fields.numbers("III")
    source.limit(count, MOST_FIELDS, "fields of a point")
    kinds = [(fields.text(), *fields.numbers("IBI")) for _ in range(count)]
    offsets: dict[str, tuple[int, np.dtype]] = {}
    big, step, row = fields.numbers("BII")
    data = fields.bytes("points")
    source.limit(height * width, MOST_POINTS, f"points ({height:,} x {width:,})")
    for name, offset, kind, _ in kinds:
        if name in ("x", "y", "z"):
            type = np.dtype((">" if big else "<") + TYPES[kind]) if kind in TYPES else None
            if type is None or offset + type.itemsize > step:
                source.refuse(f"{name} as a number within a point's {step:,} bytes", f"type {kind} at byte {offset:,}")
            offsets[name] = (offset, type)
    if set(offsets) != {"x", "y", "z"}:
        source.refuse("points with x, y and z", ", ".join(name[:20] for name, *_ in kinds[:8]) or "no fields")
    row = step * width if height == 1 else row  # some drivers leave it out
    needed = (height - 1) * row + step * width
    if not height * width or row < step * width or len(data) < needed:
        source.refuse(f"{height:,} rows of {width:,} points of {step:,} bytes", f"{len(data):,} bytes")
    places = (offsets[axis] for axis in ("x", "y", "z"))
    columns = [np.ndarray((height, width), type, data, offset, (row, step)).reshape(-1) for offset, type in places]
    return finite_points(source, columns)
