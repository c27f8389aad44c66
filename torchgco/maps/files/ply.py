"""ply: the vertices of a Stanford polygon file, as text or binary, or its mesh; read by trimesh."""

from __future__ import annotations

import re
import warnings
from io import BytesIO

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.extras import imported
from torchgco.base.memory import limited
from torchgco.maps.files.meshes import read_mesh
from torchgco.maps.files.source import MOST_BYTES, MOST_POINTS, MOST_TEXT, Source, finite_points
from torchgco.maps.grid import OccupancyGrid

PLY = "a ply file of points with x, y and z"
PLY_HEADER = 2**20  # bytes of a header
PLY_MEMORY = 4 * MOST_BYTES  # bytes while it is read: text takes a multiple of its own
PLY_FORMAT = re.compile(rb"(?m)^format[ \t]+(?:ascii|binary_little_endian|binary_big_endian)[ \t]+1\.0[ \t\r]*$")
PLY_ELEMENT = re.compile(rb"(?m)^element[ \t]+(\S+)[ \t]+(\d{1,18})[ \t\r]*$")


def read_ply(source: Source, resolution: float | None, solid: bool | None) -> np.ndarray | OccupancyGrid:
    """Points (P, 3): the vertices. Of a mesh, whose surface lies between them, cells, as `read_mesh` says.

    Raises:
        InputError: another header, fewer bytes than it says, lists among the vertices or before them, a mesh without a
            resolution, points with one, text with anything but numbers.
    """
    raw = source.bytes(PLY)
    header, _, _ = raw[:PLY_HEADER].partition(b"end_header")
    if not header.startswith(b"ply") or len(header) == min(len(raw), PLY_HEADER):
        source.refuse(f"{PLY} with a header that ends with end_header", f"{raw[:20]!r} at its beginning")
    if PLY_FORMAT.search(header) is None:
        source.refuse(f"{PLY} in format ascii or binary, 1.0", "another one")
    counts = {name: int(count) for name, count in PLY_ELEMENT.findall(header)}
    count = counts.get(b"vertex", 0)
    if counts.get(b"face") or counts.get(b"tristrips"):
        return read_mesh(source, resolution, solid)
    for name, value in (("resolution", resolution), ("solid", solid)):
        if value is not None:
            raise InputError(f"{source.name}.{name}", f"none: {source.path} holds points, no mesh", value)
    for name, rows in counts.items():
        source.limit(rows, MOST_POINTS, f"rows of {name.decode('utf-8', 'replace')}")
    upto, _, after = header.partition(b"element vertex")
    if b"property list" in upto + after.partition(b"element ")[0]:  # trimesh takes all rows to be as long as the first
        source.refuse(f"{PLY} without lists", "lists among or before the vertices")
    if b"ascii" in header:
        source.limit(len(raw), MOST_TEXT, "bytes of text")
    trimesh = imported("trimesh", "maps", source.field)
    with source.library(PLY), limited(PLY_MEMORY), warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy's, of text that holds no numbers
        loaded = trimesh.exchange.ply.load_ply(BytesIO(raw), skip_materials=True)
        points = np.asarray(loaded.get("vertices", np.empty((0, 3))), np.float64)
    if len(points) != count:
        source.refuse(f"{count:,} vertices", f"{len(points):,}")
    return finite_points(source, points)
