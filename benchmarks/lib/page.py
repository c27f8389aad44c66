"""A page of benchmarks/results: a measured table below a line that says how, when and where it was measured."""

from __future__ import annotations

from pathlib import Path

from benchmarks.lib.provenance import provenance

INTERVALS = "95 % Wilson intervals in percent"
SET_UP = "set-up excluded"


def put_table(page: Path, how: str, table: str, *notes: str) -> None:
    """Put a table between the marks of a page, which bear the page's name.

    Args:
        how: number of problems, seed, kind of time.
        notes: further parts of the line; "CasADi" gets its version.

    Raises:
        ValueError: the page has no such marks.
    """
    origin = provenance("cpu")
    first = f"Measured on {origin['date']} at commit {origin['commit']}, {how}, {origin['processor']}, shared"
    more = [f"CasADi {origin['casadi']}" if note == "CasADi" else note for note in notes]
    text = "; ".join([first, *more])
    put_between(page, f"<!-- {page.stem} -->", f"<!-- end {page.stem} -->", f"{text}.\n\n{table}")


def put_between(file: Path, begin: str, end: str, new: str) -> None:
    """Put text between two marks; the rest of the file stays unchanged.

    Raises:
        ValueError: the file doesn't contain each mark once, in order.
    """
    text = file.read_text()
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"{file} has no part between {begin} and {end}")
    head, rest = text.split(begin)
    tail = rest.split(end)[1]
    file.write_text(f"{head}{begin}\n{new}\n\n{end}{tail}")
