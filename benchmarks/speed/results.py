"""The rows of `speed.csv`: stored as they are measured, published section by section."""

from __future__ import annotations

import csv
import os
from pathlib import Path

Row = dict[str, str]

MEASURED = ("section", "case", "solver", "quantity", "value", "unit", "ratio")
COLUMNS = (*MEASURED, "date", "commit", "processor", "torch", "casadi", "pytorch_mppi", "acados", "threads", "device")


class Results:
    """The kept file, and next to it a growing file.

    A row is written to the growing file as soon as it is measured. When a section ends, its rows replace those of
    former runs in the kept file. So after a stop the kept file holds complete sections, each from one run.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.growing = path, path.with_suffix(".part.csv")
        self.rows: list[Row] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(self.growing, [])

    def add(self, row: Row) -> None:
        """Add one measurement.

        Raises:
            ValueError: the row hasn't exactly the columns of COLUMNS.
        """
        if set(row) != set(COLUMNS):
            raise ValueError(f"a row has the columns {COLUMNS}, not {tuple(row)}")
        self.rows.append(row)
        with self.growing.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(row)

    def finish(self, section: str, device: str) -> None:
        """Replace the section's rows of former runs on that device by the new rows."""
        new = [row for row in self.rows if row["section"] == section]
        former = read_rows(self.path)
        kept = [row for row in former if (row["section"], row["device"]) != (section, device)]
        temporary = self.path.with_suffix(".tmp")
        _write(temporary, kept + new)
        os.replace(temporary, self.path)

    def close(self) -> None:
        """Delete the growing file: all its rows are in the kept file."""
        self.growing.unlink(missing_ok=True)


def read_rows(path: Path) -> list[Row]:
    """The rows of a kept file, [] where there is no file; missing columns are empty."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [{column: row.get(column, "") for column in COLUMNS} for row in csv.DictReader(file)]


def _write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
