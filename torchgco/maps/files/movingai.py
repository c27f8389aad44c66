"""map: the grids of the MovingAI benchmarks for path planning (Sturtevant, 2012), a character per cell."""

from __future__ import annotations

import numpy as np

from torchgco.base.errors import shown
from torchgco.maps.files.images import turned
from torchgco.maps.files.source import MOST_CELLS, MOST_TEXT, Source, made, whole
from torchgco.maps.grid import OccupancyGrid

MAP = "a MovingAI map: type, height, width and map, then a row of characters per line"
FREE_LETTERS = b".GS"  # ground, and swamp, which can be passed
OCCUPIED_LETTERS = b"@OTW"  # outside of the map, trees, and water, which can't


def read_movingai(source: Source, resolution: float | None, origin: np.ndarray | None) -> OccupancyGrid:
    """The cells, rows from the top: x to the right, y upward.

    Raises:
        InputError: another header, rows more or fewer or of another length, or another character.
    """
    source.needs("resolution", resolution, "the side of a cell, m")
    lines = source.bytes(MAP, MOST_TEXT).replace(b"\r", b"").split(b"\n")
    header = dict[str, str]()
    for i, line in enumerate(lines[:4]):
        words = line.decode("ascii", "replace").split()
        if len(words) not in (1, 2) or words[0] not in ("type", "height", "width", "map"):
            source.refuse(MAP, f"{shown(line[:40])} in line {i + 1}")
        header[words[0]] = words[-1]
    if set(header) != {"type", "height", "width", "map"} or lines[3].strip() != b"map":
        source.refuse(MAP, f"a header of {', '.join(header)}")
    height, width = (whole(source, header[name], name, 1) for name in ("height", "width"))
    source.limit(height * width, MOST_CELLS, "cells")
    rows = lines[4 : 4 + height]
    bad = next((i for i, row in enumerate(rows) if len(row) != width), None)
    if bad is not None or len(rows) < height or any(line.strip() for line in lines[4 + height :]):
        got = f"{len(rows[bad])} characters in line {bad + 5}" if bad is not None else f"{len(lines) - 4} lines"
        source.refuse(f"{height} rows of {width} characters", got)
    cells = np.frombuffer(b"".join(rows), np.uint8).reshape(height, width)
    occupied = np.isin(cells, list(OCCUPIED_LETTERS))
    if (strange := ~(occupied | np.isin(cells, list(FREE_LETTERS)))).any():
        i, j = np.argwhere(strange)[0].tolist()
        known = ", ".join(map(chr, FREE_LETTERS + OCCUPIED_LETTERS))
        source.refuse(f"characters {known}", f"{shown(bytes([cells[i, j]]))} in line {i + 5}, column {j + 1}")
    return made(source, turned(occupied), np.zeros(2) if origin is None else origin, resolution)
