"""xyz: points written as text, a line each."""

from __future__ import annotations

import re
import warnings
from io import BytesIO

import numpy as np

from torchgco.maps.files.source import MOST_POINTS, MOST_TEXT, Source, finite_points

XYZ = "points as text, a line of 2 or 3 numbers or more each"
SEPARATORS = re.compile(rb"[,; \t]+")
COMMENT = re.compile(rb"#[^\n]*")
NOT_BY_COMMA = re.compile(rb"[0-9.][; \t]+[-+.0-9]")  # between two numbers of a line
MIXED = re.compile(rb"(?m)^(?=[^\n]*[0-9.],[-+.0-9])[^\n]*[0-9.],[ \t]+[-+.0-9]")
EMPTY_FIELD = re.compile(rb"(?m)^(?:[^,;\n]*[,;]){0,2}[ \t]*[,;]")  # of the first three


def read_xyz(source: Source) -> np.ndarray:
    """The first three numbers of each line, or both where lines have two; `#` begins a comment.

    Numbers are separated by spaces, tabs, commas or semicolons. Refused are commas beside other separators, or with and
    without a space after them in a line, as they may stand for decimal points, and lines without one of the first
    numbers. Further columns, such as colours, aren't read.
    """
    text = COMMENT.sub(b"", source.bytes(XYZ, MOST_TEXT))
    if b"," in text and (NOT_BY_COMMA.search(text) or MIXED.search(text)):
        source.refuse(XYZ, "commas beside other separators; for decimal commas: sed 's/,/./g' FILE > POINTS.xyz")
    if EMPTY_FIELD.search(text):
        source.refuse(XYZ, "a line without one of its first numbers")
    first = next((line for line in map(_bare, BytesIO(text)) if line), None)
    if first is None:
        source.refuse(XYZ, "no line of numbers")
    columns, more = len(SEPARATORS.split(first)), len(SEPARATORS.split(_bare(text.rstrip().rpartition(b"\n")[2])))
    if columns < 2:
        source.refuse(XYZ, f"{columns} in the first line")
    if columns == 2 < more:
        source.refuse(XYZ, f"2 in the first line, which may be a heading, and {more} in the last")
    return finite_points(source, columns_of(source, text, range(min(columns, 3)), XYZ))


def _bare(line: bytes) -> bytes:
    return line.split(b"#", 1)[0].strip(b",; \t\r\n")


def columns_of(
    source: Source, text: bytes, wanted: range | list[int], expected: str, first_line: int = 1
) -> np.ndarray:
    """Numbers (P, columns) of lines of text; a line that lacks one is an InputError that names it."""
    source.limit(text.count(b"\n") + 1, MOST_POINTS, "lines of points")
    text = text.translate(bytes.maketrans(b",;\t", b"   "))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no lines at all: no points then
            return np.loadtxt(BytesIO(text), np.float64, usecols=list(wanted), ndmin=2, encoding="latin1")
    except Exception:  # NumPy counts lines without comments and empty ones, and raises several kinds
        line = _wrong_line(text, wanted)
        source.refuse(expected, f"{line[1]} in line {first_line + line[0]:,}" if line else "no numbers")


def _wrong_line(text: bytes, wanted: range | list[int]) -> tuple[int, str] | None:
    for index, line in enumerate(BytesIO(text)):
        words = _bare(line).split()
        try:
            if words:
                [float(words[column].decode("latin1")) for column in wanted]
        except (ValueError, IndexError):
            said = b" ".join(words)[:60].decode("ascii", "replace")
            return index, f"'{said}'"
    return None
