"""pcd: clouds of points of PCL, as text, binary or compressed.

The format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. Known libraries take the memory that
a header names before they look for the bytes, so this reader is strict and small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchgco.base.errors import shown
from torchgco.maps.files.source import MOST_BYTES, MOST_POINTS, Cursor, Source, finite_points, whole
from torchgco.maps.files.text import columns_of

PCD = "a pcd file with fields x, y and z"
PCD_LINES, PCD_LETTERS = 64, 4096  # of a header, and of one of its lines
FIELDS = 256  # of a point
PCD_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
PCD_TYPES = {
    ("F", 4): "<f4", ("F", 8): "<f8", ("U", 1): "u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
    ("I", 1): "i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
}  # fmt: skip


@dataclass(frozen=True)
class Header:
    """Names and numbers of each field of a point, how many points follow, and how."""

    names: list[str]
    counts: list[int]
    point: np.dtype  # of all fields, in their order
    points: int
    data: str
    at: int  # byte after the header
    lines: int


def read_pcd(source: Source) -> np.ndarray:
    """Points (P, 3), or (P, 2) of a file without z, in its frame: the viewpoint is where it was seen from, and unused.

    Raises:
        InputError: another header, fewer bytes than it says, or damaged ones.
    """
    raw = source.bytes(PCD)
    header = _header(source, raw)
    wanted = [header.names.index(axis) for axis in ("x", "y", "z") if axis in header.names]
    if len(wanted) < 2 or "x" not in header.names or "y" not in header.names:
        source.refuse(PCD, f"fields {' '.join(header.names)}")
    if any(header.counts[i] != 1 for i in wanted):
        source.refuse("one x, y and z per point", f"COUNT {' '.join(map(str, header.counts))}")
    cursor = Cursor(source, raw, PCD, header.at)
    if header.data == "ascii":
        columns = [sum(header.counts[:i]) for i in wanted]
        points = columns_of(source, bytes(cursor.data[cursor.at :]), columns, PCD, header.lines + 1)
        if len(points) != header.points:
            source.refuse(f"{header.points:,} points", f"{len(points):,}")
        return finite_points(source, points)
    read = _binary if header.data == "binary" else _compressed
    return finite_points(source, read(cursor, header, wanted))


def _header(source: Source, raw: bytes) -> Header:
    header: dict[str, list[str]] = {}
    offset = lines = 0
    while "DATA" not in header:
        end = raw.find(b"\n", offset, offset + PCD_LETTERS)
        if end < 0 or lines >= PCD_LINES:
            source.refuse(f"{PCD} with a header that ends with DATA", f"none in line {lines + 1}, byte {offset:,}")
        words = raw[offset:end].decode("utf-8", "replace").split()
        offset, lines = end + 1, lines + 1
        if words and not words[0].startswith("#"):
            if words[0] not in PCD_KEYS or words[0] in header:
                source.refuse(f"{PCD}: a line of each of {', '.join(PCD_KEYS)}", f"{shown(words[0])} in line {lines}")
            header[words[0]] = words[1:]
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if key not in header]:
        source.refuse(f"{PCD} with {' and '.join(missing)}", "a header without")
    names = header["FIELDS"]
    lists = (names, header["SIZE"], header["TYPE"], header.get("COUNT", ["1"] * len(names)))
    if len({len(values) for values in lists}) > 1 or not 0 < len(names) <= FIELDS:
        source.refuse("FIELDS, SIZE, TYPE and COUNT of one length", [len(values) for values in lists])
    sizes = [whole(source, size, "SIZE", 1) for size in header["SIZE"]]
    counts = [whole(source, count, "COUNT", 0) for count in lists[3]]
    if sum(counts) > FIELDS:
        source.refuse(f"at most {FIELDS} numbers per point", sum(counts))
    fields = []
    for pair, count in zip(zip(header["TYPE"], sizes, strict=True), counts, strict=True):
        if pair not in PCD_TYPES:
            source.refuse("TYPE F, U or I of 1, 2, 4 or 8 bytes", f"{shown(pair[0])} of {pair[1]}")
        fields.append((f"{len(fields)}", PCD_TYPES[pair], (count,)))
    sides = [whole(source, " ".join(header[key]), key) for key in ("WIDTH", "HEIGHT")]
    points = sides[0] * sides[1]
    if "POINTS" in header and whole(source, " ".join(header["POINTS"]), "POINTS") != points:
        source.refuse(f"POINTS {points} as WIDTH and HEIGHT say", " ".join(header["POINTS"]))
    source.limit(points, MOST_POINTS, "points")
    data = " ".join(header["DATA"])
    if data not in ("ascii", "binary", "binary_compressed"):
        source.refuse("DATA ascii, binary or binary_compressed", shown(data))
    return Header(names, counts, np.dtype(fields), points, data, offset, lines)


def _binary(cursor: Cursor, header: Header, wanted: list[int]) -> list[np.ndarray]:
    """One point after the other."""
    rows = np.frombuffer(cursor.take(header.points * header.point.itemsize, f"{header.points:,} points"), header.point)
    return [rows[f"{i}"][:, 0] for i in wanted]


def _compressed(cursor: Cursor, header: Header, wanted: list[int]) -> list[np.ndarray]:
    """LZF of all values of the first field, then all of the second, ..."""
    packed, size = cursor.number("I", "compressed size"), cursor.number("I", "size")
    if size != (due := header.points * header.point.itemsize):
        cursor.source.refuse(f"{due:,} bytes of {header.points:,} points", f"{size:,}")
    cursor.source.limit(size, MOST_BYTES, "bytes of points")
    offset = cursor.at
    data = unpack(cursor.source, cursor.take(packed, "compressed points"), size, offset)
    starts = np.cumsum([0, *(header.points * header.point[i].itemsize for i in range(len(header.names)))]).tolist()
    return [np.frombuffer(data, header.point[i].base, header.points, starts[i]) for i in wanted]


def unpack(source: Source, data: memoryview, size: int, offset: int = 0) -> bytearray:
    """`size` bytes that were packed by LZF; `offset` is where they lie in the file, for errors.

    A first byte c < 32 begins c + 1 bytes as they are. Others copy c >> 5 bytes and two more (with 7, the next byte is
    added) that were unpacked before: their distance less one are the last 5 bits of c and the byte that follows.
    """
    packed, out, i = bytes(data), bytearray(), 0
    try:
        while i < len(packed):
            control = packed[i]
            i += 1
            if control < 32:
                out += packed[i : i + control + 1]
                i += control + 1
                if i > len(packed):
                    raise IndexError
            else:
                length = control >> 5
                if length == 7:
                    length += packed[i]
                    i += 1
                length += 2
                start = len(out) - ((control & 31) << 8) - packed[i] - 1
                i += 1
                if start < 0:
                    raise IndexError
                piece = out[start : start + length]
                # A copy may overlap what it writes: then it repeats.
                out += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
            if len(out) > size:
                raise IndexError
    except IndexError:
        source.refuse(f"{size:,} bytes packed by LZF", f"damage at byte {offset + min(i, len(packed)):,}")
    if len(out) != size:
        source.refuse(f"{size:,} bytes packed by LZF", f"{len(out):,}")
    return out
