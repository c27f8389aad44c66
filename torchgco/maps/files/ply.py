"""ply: the vertices of a Stanford polygon file, as text or binary, or its mesh.

Read by hand: plyfile has a stronger licence, and trimesh, which reads meshes, is an extra that clouds do without.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.files.meshes import read_mesh
from torchgco.maps.files.source import MOST_POINTS, Cursor, Source, finite_points, whole
from torchgco.maps.files.text import columns_of
from torchgco.maps.grid import OccupancyGrid

PLY = "a ply file of points with x, y and z"
PLY_LINES, PLY_LETTERS = 1024, 4096
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass
class Element:
    """A table of the file: rows of named numbers. `lists` says that it has rows of different length."""

    name: str
    count: int
    names: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)
    lists: bool = False


def read_ply(source: Source, resolution: float | None, solid: bool | None) -> np.ndarray | OccupancyGrid:
    """Points (P, 3): the vertices. Of a mesh, whose surface lies between them, cells, as `read_mesh` says.

    Raises:
        InputError: another header, fewer bytes than it says, tables of lists before the vertices, a mesh without a
            resolution, points with one.
    """
    raw = source.bytes(PLY)
    order, elements, at, lines = _header(source, raw)
    vertices = next((element for element in elements if element.name == "vertex"), None)
    if vertices is None or not {"x", "y", "z"} <= set(vertices.names):
        source.refuse(PLY, f"properties {shown(vertices.names)}" if vertices else "no vertices")
    if any(element.count for element in elements if element.name in ("face", "tristrips")):
        return read_mesh(source, resolution, solid)
    for name, value in (("resolution", resolution), ("solid", solid)):
        if value is not None:
            raise InputError(f"{source.name}.{name}", f"none: {source.path} holds points, no mesh", value)
    before = elements[: elements.index(vertices)]
    if vertices.lists or any(element.lists and element.count for element in before):
        source.refuse(f"{PLY} without lists", "lists among or before the vertices")
    wanted = [vertices.names.index(axis) for axis in ("x", "y", "z")]
    cursor = Cursor(source, raw, PLY, at)
    if not order:
        return finite_points(source, _text(source, bytes(cursor.data[at:]), vertices, before, wanted, lines))
    for element in before:
        cursor.take(element.count * _row(element, order).itemsize, f"the table {shown(element.name)}")
    layout = _row(vertices, order)
    rows = np.frombuffer(cursor.take(vertices.count * layout.itemsize, f"{vertices.count:,} vertices"), layout)
    return finite_points(source, [rows[f"{i}"] for i in wanted])


def _row(element: Element, order: str) -> np.dtype:
    return np.dtype([(f"{i}", order + type) for i, type in enumerate(element.types)])


def _text(
    source: Source, text: bytes, vertices: Element, before: list[Element], wanted: list[int], lines: int
) -> np.ndarray:
    """Vertices of a file as text: a line each, after those of the tables before."""
    source.limit(text.count(b"\n"), 2 * MOST_POINTS, "lines")
    ends = np.flatnonzero(np.frombuffer(text + b"\n", np.uint8) == ord("\n")) + 1
    starts = np.concatenate([[0], ends])
    first = sum(element.count for element in before)
    if len(ends) < first + vertices.count:
        source.refuse(f"{first + vertices.count:,} lines after the header", f"{len(ends):,}")
    held = text[starts[first] : starts[first + vertices.count]]
    points = columns_of(source, held, wanted, PLY, lines + first + 1)
    if len(points) != vertices.count:
        source.refuse(f"{vertices.count:,} vertices", f"{len(points):,}")
    return points


def _header(source: Source, raw: bytes) -> tuple[str, list[Element], int, int]:
    """Order of bytes, tables, and the byte and line after the header."""
    order, elements, at, lines = None, [], 0, 0
    while True:
        end = raw.find(b"\n", at, at + PLY_LETTERS)
        if end < 0 or lines >= PLY_LINES:
            source.refuse(f"{PLY} with a header that ends with end_header", f"none in line {lines + 1}, byte {at:,}")
        words = raw[at:end].decode("utf-8", "replace").split()
        at, lines = end + 1, lines + 1
        match words:
            case ["ply"] if lines == 1:
                pass
            case _ if lines == 1:
                source.refuse(PLY, f"{shown(raw[:20])} in its first line")
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, "1.0"] if kind in ORDERS and order is None:
                order = ORDERS[kind]
            case ["element", name, count]:
                elements.append(Element(name, whole(source, count, f"a count in line {lines}")))
                source.limit(elements[-1].count, MOST_POINTS, f"rows of {shown(name)}")
            case ["property", "list", first, second, _] if elements and first in PLY_TYPES and second in PLY_TYPES:
                elements[-1].lists = True
            case ["property", type, name] if elements and type in PLY_TYPES and name not in elements[-1].names:
                elements[-1].names.append(name)
                elements[-1].types.append(PLY_TYPES[type])
            case ["end_header"] if order is not None:
                return order, elements, at, lines
            case _:
                source.refuse(f"{PLY}: format, element, property or end_header in line {lines}", shown(" ".join(words)))
