"""What `torchgco-report --verify` prints: which rows, columns and files are confirmed, and which aren't, and why."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd

from torchgco.experiments.reports.verify import Table, Verification
from torchgco.experiments.statistics.tables import aligned

DIFFERENT = 10  # differing values that are printed per table
# Of missions: columns that the log, which has the states at control steps alone, can't confirm; and those that are
# compared with the outcome only.
NOT_LOGGED = ("outcome", "flight_time", "clearance", "goal_distance", "energy", "iterations")
BY_OUTCOME = ("status", "feasible", "reached")


def confirmed_text(studies: Sequence[Verification]) -> str:
    """The values that differ, study by study, and what is confirmed of all others together."""
    right = [study for study in studies if not study.differs]
    where = f" in {len(right)} studies" if len(right) > 1 else ""
    lines = [*difference_texts(studies), f"{_rows(study.tables[0].rows for study in right)} confirmed{where}"]
    for kind in (False, True):
        of_kind = [study for study in right if study.missions == kind]
        if 0 < len(of_kind) < len(right):
            rows = _rows(study.tables[0].rows for study in of_kind)
            lines.append(f"{rows} of {'missions' if kind else 'trajectories'}:")
        lines += list(dict.fromkeys(f"  {line}" for study in of_kind for line in _columns(study)))
    for name in ("summary.csv", "paired.csv"):
        counted = [table.rows for study in right for table in study.tables if table.name == name]
        lines += [f"{_rows(counted)} of {name} confirmed"] if counted else []
    lines += [f"not confirmed: {study.folder / name}, which is missing" for study in right for name in study.absent]
    return "\n".join(lines)


def _rows(counts: Iterable[int]) -> str:
    total = sum(counts)
    return "1 row" if total == 1 else f"{total} rows"


def difference_texts(studies: Sequence[Verification]) -> list[str]:
    """The first values that differ in each table."""
    pairs = [(study, table) for study in studies for table in study.tables if len(table.differences)]
    return [_differences(study, table) for study, table in pairs]


def confirmed_frame(studies: Sequence[Verification]) -> pd.DataFrame:
    """A row per study and file.

    Columns: `study`, `file`, `rows`, `differing` values, and the names of the columns that are `confirmed` ("all" where
    there are no others), that follow from the outcome of a mission alone (`by_outcome`), that the `checksum` guards
    alone, and that are `unconfirmed`. A table that is missing has no rows and no columns.
    """
    rows = []
    for study in studies:
        for table in study.tables:
            names = _sorted(study, table)
            held = {kind: " ".join(found) for kind, found in names.items()}
            held |= {} if any(found for kind, found in names.items() if kind != "confirmed") else {"confirmed": "all"}
            first = {"study": str(study.folder), "file": table.name, "rows": table.rows}
            rows.append({**first, "differing": len(table.differences), **held})
        empty = dict.fromkeys(("confirmed", "by_outcome", "checksum", "unconfirmed"), "")
        for name in study.absent:
            rows.append({"study": str(study.folder), "file": name, "rows": 0, "differing": 0, **empty})
    return pd.DataFrame(rows)


def _sorted(study: Verification, table: Table) -> dict[str, list[str]]:
    """The columns of a table by how far they are confirmed."""
    trials = table is study.tables[0]
    bound = BY_OUTCOME if study.missions and trials else ()
    unknown = NOT_LOGGED if study.missions and trials else ()
    return {
        "confirmed": [name for name in table.columns if name not in bound],
        "by_outcome": [name for name in table.columns if name in bound],
        "checksum": [name for name in table.others if name not in unknown],
        "unconfirmed": [name for name in table.others if name in unknown],
    }


def _columns(study: Verification) -> list[str]:
    held = {name: ", ".join(names) for name, names in _sorted(study, study.tables[0]).items()}
    texts = {
        "confirmed": "columns: {}",
        "by_outcome": "agree with the outcome: {}",
        "checksum": "not computed again, but as the study wrote them (checksum): {}",
        "unconfirmed": "not confirmed: {} (missions are judged at time steps, of which the log has only the control "
        "steps), but as the study wrote them (checksum)",
    }
    return [text.format(held[name]) for name, text in texts.items() if held[name]]


def _differences(study: Verification, table: Table) -> str:
    count, place = len(table.differences), study.folder
    place = place if table is study.tables[0] else place / table.name
    rows = [[str(value) for value in row] for row in table.differences.head(DIFFERENT).to_numpy().tolist()]
    values = "1 value differs" if count == 1 else f"{count} values differ"
    lines = [f"{place}: {values} in {_rows([table.rows])}"]
    lines.append(aligned([list(table.differences.columns), *rows], 1))
    more = count - len(rows)
    return "\n".join([*lines, *([f"... and {more} more"] if more else [])])
