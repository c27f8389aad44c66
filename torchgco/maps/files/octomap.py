"""OctoMap's bt (free, occupied) and ot (probabilities) files.

The format: OctoMap 1.10, OcTreeBaseImpl and OccupancyOcTreeBase. Its library reads by recursion in C++ without a bound,
so this reader is written here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchgco.base.errors import shown
from torchgco.maps.files.part import Box
from torchgco.maps.files.source import MOST_CELLS, Cursor, Source, made, whole
from torchgco.maps.grid import OccupancyGrid

DEPTH = 16  # of OctoMap's trees: the root has a side of 2**16 cells, with the frame's origin in its middle
MOST_NODES = 2**24
FIRST_LINES = {".bt": "# Octomap OcTree binary file", ".ot": "# Octomap OcTree file"}
NODE_BYTES = {"OcTree": 0, "ColorOcTree": 3, "OcTreeStamped": 4}  # bytes of a node in an ot file after its log-odds
OCTOMAP_LINES, OCTOMAP_LETTERS = 64, 4096
FREE_CHILD, OCCUPIED_CHILD, INNER = 1, 2, 3  # a child in a bt file, two bits


@dataclass(frozen=True)
class Leaves:
    """Cubes of the tree: lowest cell (L, 3) from the root's corner, side in cells (L,), probability (L,)."""

    lowest: np.ndarray
    sides: np.ndarray
    values: np.ndarray


def read_octomap(source: Source, box: Box) -> OccupancyGrid:
    """The smallest grid around all known leaves, unknown between them; probabilities of an ot file are kept.

    Args:
        box: only what lies in it is read: the tree may be larger than a grid can be.

    Raises:
        InputError: another header, a tree that is cut, has nodes more or fewer than the header says, or no leaf.
    """
    expected = f"an OctoMap file, which begins with '{FIRST_LINES[source.path.suffix.lower()]}'"
    raw = source.bytes(expected)
    kind, size, resolution, offset = _header(source, raw, expected)
    source.limit(size, MOST_NODES, "nodes of a tree")
    cursor = Cursor(source, raw, expected, offset)
    binary = source.path.suffix.lower() == ".bt"
    leaves, nodes = _binary_tree(cursor, size) if binary else _tree(cursor, NODE_BYTES[kind])
    if nodes != size:
        source.refuse(f"a tree of {size:,} nodes", f"{nodes:,}")
    if not len(leaves.sides):
        source.refuse("a map with a known cell", "an empty tree")
    middle, begin, end = 2 ** (DEPTH - 1), leaves.lowest, leaves.lowest + leaves.sides[:, None]
    first, last = (np.clip(cells + middle, 0, 2**DEPTH) for cells in box.cells(resolution))
    begin, end = np.maximum(begin, first), np.minimum(end, last)
    inside = (begin < end).all(-1)
    if not inside.any():
        source.refuse(f"known cells in {box}", "none")
    begin, end, values = begin[inside], end[inside], leaves.values[inside]
    low, high = begin.min(0), end.max(0)
    count = f"cells ({' x '.join(map(str, high - low))}): read a part by `box` or `layer`"
    source.limit(int(np.prod(high - low, dtype=np.float64)), MOST_CELLS, count)
    cells = np.full(tuple(high - low), np.nan, np.float32)
    _fill(cells, begin - low, end - low, values)
    return made(source, cells, (low - middle) * resolution, resolution)


def _fill(cells: np.ndarray, begin: np.ndarray, end: np.ndarray, values: np.ndarray) -> None:
    single = (end - begin == 1).all(-1)
    cells[tuple(begin[single].T)] = values[single]
    for low, high, value in zip(begin[~single].tolist(), end[~single].tolist(), values[~single], strict=True):
        cells[tuple(map(slice, low, high))] = value


def _header(source: Source, raw: bytes, expected: str) -> tuple[str, int, float, int]:
    """Kind of tree, number of nodes, side of a cell, and the byte after the header."""
    fields: dict[str, str] = {}
    offset = 0
    for line in range(OCTOMAP_LINES):
        end = raw.find(b"\n", offset, offset + OCTOMAP_LETTERS)
        text = raw[offset : max(end, offset)].decode("utf-8", "replace").strip()
        if end < 0 or (line == 0 and not text.startswith(FIRST_LINES[source.path.suffix.lower()])):
            source.refuse(expected, f"{shown(raw[offset : offset + 40])} at byte {offset:,}")
        offset = end + 1
        if text == "data":
            break
        if text and not text.startswith("#"):
            key, _, value = text.partition(" ")
            if key not in ("id", "size", "res") or key in fields:
                source.refuse(f"{expected}, then id, size, res and data", f"{shown(text[:60])} in line {line + 1}")
            fields[key] = value.strip()
    if set(fields) != {"id", "size", "res"}:
        source.refuse(f"{expected}, then id, size, res and data", f"only {', '.join(fields) or 'none of them'}")
    if fields["id"] not in NODE_BYTES:
        source.refuse(f"a tree of {', '.join(NODE_BYTES)}", shown(fields["id"]))
    size = whole(source, fields["size"], "size")
    try:
        resolution = float(fields["res"])
    except ValueError:
        resolution = np.nan
    if not 0.0 < resolution < np.inf:
        source.refuse("res, a length > 0 m", shown(fields["res"]))
    return fields["id"], size, resolution, offset


def _binary_tree(cursor: Cursor, size: int) -> tuple[Leaves, int]:
    """Leaves and number of nodes of a bt file: two bytes per inner node, its eight children two bits each."""
    count, child = min(cursor.left // 2, size), np.arange(8)
    words = np.frombuffer(cursor.data[cursor.at : cursor.at + 2 * count], "<u2")
    numbers = words.tolist()
    inner = _walked(cursor, count, 2, lambda i: [c for c in range(8) if numbers[i] >> 2 * c & 3 == INNER])
    kinds = words[: len(inner), None].astype(np.int64) >> 2 * child & 3
    node, which = np.nonzero((kinds == FREE_CHILD) | (kinds == OCCUPIED_CHILD))
    side = 1 << (inner[node, 3] - 1)
    corner = np.stack([which & 1, which >> 1 & 1, which >> 2], 1) * side[:, None]
    values = (kinds[node, which] == OCCUPIED_CHILD).astype(np.float32)
    return Leaves(inner[node, :3] + corner, side, values), len(node) + len(inner)


def _tree(cursor: Cursor, more: int) -> tuple[Leaves, int]:
    """Leaves and number of nodes of an ot file: log-odds, a colour or time, and a bit for each child that there is."""
    row = np.dtype([("log_odds", "<f4"), *([("more", f"V{more}")] if more else []), ("children", "u1")])
    count = cursor.left // row.itemsize
    cursor.source.limit(count, MOST_NODES, "nodes of a tree")
    rows = np.frombuffer(cursor.data[cursor.at : cursor.at + count * row.itemsize], row)
    bits = rows["children"].tolist()
    nodes = _walked(cursor, count, row.itemsize, lambda i: [c for c in range(8) if bits[i] >> c & 1] or None)
    leaves = rows["children"] == 0
    cells = nodes[leaves]
    with np.errstate(invalid="ignore"):  # some kinds of NaN, refused below
        odds = rows["log_odds"][leaves].astype(np.float64)
    if not np.isfinite(odds).all():
        cursor.source.refuse("finite log-odds of leaves", f"{odds[~np.isfinite(odds)][0]}")
    probabilities = (1.0 / (1.0 + np.exp(-np.clip(odds, -50.0, 50.0)))).astype(np.float32)
    return Leaves(cells[:, :3], 1 << cells[:, 3], probabilities), count


def _walked(cursor: Cursor, most: int, size: int, children: Callable[[int], list[int] | None]) -> np.ndarray:
    """Lowest cell and level (nodes, 4) of the nodes of a tree in the order of the file, at most so many.

    Args:
        size: bytes of a node.
        children: which children of a node are nodes of their own; None of a leaf.
    """
    nodes: list[tuple[int, int, int, int]] = []
    open_ = [(0, 0, 0, DEPTH)] if most else []
    while open_ and len(nodes) < most:
        x, y, z, level = open_.pop()
        octants, half = children(len(nodes)), 1 << level >> 1
        if octants is not None and level == 0:
            offset = cursor.at + size * len(nodes)
            cursor.source.refuse(f"a tree of depth {DEPTH}", f"a deeper one at byte {offset:,}")
        nodes.append((x, y, z, level))
        for child in reversed(octants or []):  # the first is read first, from the end of the list
            open_.append((x + half * (child & 1), y + half * (child >> 1 & 1), z + half * (child >> 2), level - 1))
    if open_ or size * len(nodes) < cursor.left:
        expected, how = f"{cursor.expected}, and ends with its tree's last node", "is cut" if open_ else "ends"
        cursor.source.refuse(expected, f"a tree that {how} at byte {cursor.at + size * len(nodes):,}")
    return np.array(nodes, np.int64).reshape(-1, 4)
