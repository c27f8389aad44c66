"""The rows of `speed.csv`: kept as they are measured, taken over section by section."""

from __future__ import annotations

import csv
import os
from pathlib import Path

Row = dict[str, str]

MEASURED = ("section", "case", "solver", "quantity", "value", "unit", "ratio")
COLUMNS = (*MEASURED, "date", "commit", "processor", "torch", "casadi", "pytorch_mppi", "acados", "threads", "device")


class Results:
    """The file that is kept, and next to it the one that grows.

    A row is on disk as soon as it is measured. A section's rows replace those of former runs once it has ended:
    after a stop half way, the kept file holds whole sections, each from one run.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.growing = path, path.with_suffix(".part.csv")
        self.rows: list[Row] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(self.growing, [])

    def add(self, row: Row) -> None:
        """One measurement, every column of it."""
        if set(row) != set(COLUMNS):
            raise ValueError(f"a row has the columns {COLUMNS}, not {tuple(row)}")
        self.rows.append(row)
        with self.growing.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerow(row)

    def finish(self, section: str, device: str) -> None:
        """Put the section's new rows in place of those that a former run measured on that device."""
        new = [row for row in self.rows if row["section"] == section]
        former = read_rows(self.path)
        kept = [row for row in former if (row["section"], row["device"]) != (section, device)]
        beside = self.path.with_suffix(".tmp")
        _write(beside, kept + new)
        os.replace(beside, self.path)

    def close(self) -> None:
        """Drop the growing file: all that it holds is in the kept one."""
        self.growing.unlink(missing_ok=True)


def read_rows(path: Path) -> list[Row]:
    """The rows of a kept file, none where there is none; a column that it doesn't have is empty."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [{column: row.get(column, "") for column in COLUMNS} for row in csv.DictReader(file)]


def _write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
