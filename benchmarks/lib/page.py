"""Pages of results: tables between two marks, below a line that says how, when and where they were measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.lib.provenance import provenance
from torchgco.experiments.statistics.statistics import wilson

INTERVALS = "95 % Wilson intervals in percent"
SET_UP = "set-up excluded"


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A table: a line per row, below the names of the columns."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def interval(hits: int, n: int, digits: int = 0) -> str:
    """The 95 % Wilson interval of a rate, in percent."""
    low, high = (100 * end for end in wilson(int(hits), int(n)))
    return f"[{low:.{digits}f}, {high:.{digits}f}]"


def share(hits: int, n: int, digits: int = 0) -> str:
    """How many of how many, with the interval; "-" of none."""
    return f"{int(hits)} of {int(n)} {interval(hits, n, digits)}" if n else "-"


def shown(value: float, form: str) -> str:
    """A number in this format, "-" for NaN."""
    return "-" if value != value else format(value, form)


def origin(verb: str) -> str:
    """When, and at which commit: "Flown on ... at commit ..."."""
    source = provenance("cpu")
    return f"{verb} on {source['date']} at commit {source['commit']}"


def machine() -> str:
    return provenance("cpu")["processor"]


def measured(how: str, *notes: str) -> str:
    """The line above a table.

    Args:
        how: number of problems, seed, kind of time.
        notes: further parts of the line; "CasADi" gets its version.
    """
    casadi = provenance("cpu")["casadi"]
    more = [f"CasADi {casadi}" if note == "CasADi" else note for note in notes]
    return "; ".join([f"{origin('Measured')}, {how}, {machine()}, shared", *more]) + "."


def put(page: Path, name: str, text: str) -> None:
    """Put text between the marks of this name; the rest of the page stays unchanged.

    Raises:
        ValueError: the page has no such marks.
    """
    put_between(page, f"<!-- {name} -->", f"<!-- end {name} -->", text)


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
