"""Pages of results: tables between two marks, below a line that says how, when and where they were measured.

A page shows what answers its question. A long table stands in a CSV file beside it (`filed`), its short form here.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.lib.provenance import provenance
from torchgco.experiments.statistics.statistics import wilson

FILED = re.compile(r"^<!-- file (\S+) -->\n((?:\|.*\n?)+)", re.MULTILINE)


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A table: a line per row, below the names of the columns."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def cells_of(table: str) -> list[list[str]]:
    """The cells of a Markdown table, its head first."""
    lines = [line for line in table.splitlines() if not line.startswith(("|---", "| ---"))]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def filed(name: str, table: str, *parts: str) -> str:
    """A table that `put` moves into the file NAME.csv beside the page, and its short forms."""
    return "\n\n".join([f"<!-- file {name}.csv -->\n{table}", *parts])


def chosen(table: str, columns: Sequence[str], **rows: Sequence[str]) -> str:
    """Some columns of a table, and of its rows those that have one of the cells given for a column."""
    head, *lines = cells_of(table)
    held = [line for line in lines if all(line[head.index(name)] in of for name, of in rows.items())]
    return markdown(columns, ([line[head.index(name)] for name in columns] for line in held))


def crossed(table: str, down: str, across: str, cell: str) -> str:
    """One column of a table, intervals left out: a row per cell of the column `down`, a column per cell of `across`."""
    head, *lines = cells_of(table)
    i, j, k = (head.index(name) for name in (down, across, cell))
    found = {(line[i], line[j]): line[k].split(" [")[0] for line in lines}
    rows, columns = (list(dict.fromkeys(key[place] for key in found)) for place in (0, 1))
    return markdown([down, *columns], ([row, *(found.get((row, name), "-") for name in columns)] for row in rows))


def moved(text: str, folder: Path) -> str:
    """The text with its filed tables written into files of this folder, and links in their place."""

    def move(found: re.Match[str]) -> str:
        rows = [[cell.replace("\\|", "|") for cell in line] for line in cells_of(found[2])]
        with (folder / found[1]).open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
        said = f"All {len(rows) - 1} rows" if len(rows) > 2 else "One row"
        return f"{said}: [{found[1]}]({found[1]})." + "\n" * found[2].endswith("\n")

    return FILED.sub(move, text)


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
        how: number of problems, seed, and what departs from the protocol of benchmarks/README.md.
        notes: further parts of the line; "CasADi" gets its version.
    """
    casadi = provenance("cpu")["casadi"]
    more = [f"CasADi {casadi}" if note == "CasADi" else note for note in notes]
    return "; ".join([f"{origin('Measured')}, {how}, {machine()}", *more]) + "."


def put(page: Path, name: str, text: str) -> None:
    """Put text between the marks of this name, and its filed tables beside the page; the rest stays unchanged.

    Raises:
        ValueError: the page has no such marks.
    """
    put_between(page, f"<!-- {name} -->", f"<!-- end {name} -->", text)


def put_between(file: Path, begin: str, end: str, new: str) -> None:
    """Put text between two marks, and its filed tables beside the file; the rest stays unchanged.

    Raises:
        ValueError: the file doesn't contain each mark once, in order.
    """
    text = file.read_text()
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"{file} has no part between {begin} and {end}")
    head, rest = text.split(begin)
    tail = rest.split(end)[1]
    file.write_text(f"{head}{begin}\n{moved(new, file.parent)}\n\n{end}{tail}")
