"""A page of benchmarks/results: a measured table below a line that says how, when and where it was measured."""

from __future__ import annotations

from pathlib import Path

from benchmarks.speed.provenance import provenance
from benchmarks.speed.tables import put_between

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
