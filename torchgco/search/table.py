"""The passes of a solver as a table that a person can read: `Restarts.table`."""

from __future__ import annotations

from torchgco.search.row import Passes

TABLE_COLUMNS = ("name", "pass", "problems", "what it does")


def rows_of(passes: Passes) -> list[dict[str, str]]:
    """A row per pass, with the columns `TABLE_COLUMNS`.

    A trajectory is accepted where it is better than the best before: arrived before feasible before cheap.
    """
    return [
        dict(zip(TABLE_COLUMNS, (name, type(row).__name__, row.problems, row.does), strict=True))
        for name, row in passes.items()
    ]
