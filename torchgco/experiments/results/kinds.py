"""Trajectories and missions: two kinds of trials that may share a table, each with statistics of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.mission_statistics import summarise_missions
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import TASK, are_missions, summarise, task_columns

KIND = "kind"  # first column of summary.csv and paired.csv
TRAJECTORY, MISSION = "trajectory", "mission"


@dataclass(frozen=True)
class Part:
    """The trials of one kind with their statistics.

    summary  see `summarise`, and of missions `summarise_missions`
    paired   see `compare`; of missions by `reached` alone
    """

    kind: str
    trials: pd.DataFrame
    summary: pd.DataFrame
    paired: pd.DataFrame


def parts_of(trials: pd.DataFrame) -> list[Part]:
    """The kinds in a table of trials, each without the swept variables of the other.

    Raises InputError as `summarise`.
    """
    missions = are_missions(trials)
    if trials.empty or not missions.any():
        return [Part(TRAJECTORY, trials, summarise(trials), compare(trials))]
    flown, single = _own(trials[missions]), _own(trials[~missions])
    pairs = compare(flown)
    found = [Part(MISSION, flown, summarise_missions(flown), pairs[pairs["outcome"] == "reached"])]
    return [Part(TRAJECTORY, single, summarise(single), compare(single)), *found] if len(single) else found


def _own(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows without swept variables that they don't have."""
    swept = task_columns(rows)[len(TASK) :]
    return rows.drop(columns=[name for name in swept if rows[name].isna().all()]).reset_index(drop=True)


def joined(parts: Sequence[Part]) -> dict[str, pd.DataFrame]:
    """The tables "summary" and "paired" of all parts, with the kind in the first column."""
    return {name: _stacked([(part.kind, getattr(part, name)) for part in parts]) for name in ("summary", "paired")}


def write_tables(folder: Path, parts: Sequence[Part]) -> None:
    """Write summary.csv, and paired.csv where solvers are compared."""
    for name, table in joined(parts).items():
        if name == "summary" or len(table):
            write(folder / f"{name}.csv", lambda file, table=table: table.to_csv(file, index=False))


def _stacked(tables: Sequence[tuple[str, pd.DataFrame]]) -> pd.DataFrame:
    held = []
    for kind, table in tables:
        # Columns that the other kind lacks would turn counts into floats.
        counts = [name for name in table.columns if pd.api.types.is_integer_dtype(table[name])] if tables[1:] else []
        held.append(table.astype(dict.fromkeys(counts, "Int64")))
        held[-1].insert(0, KIND, kind)
    filled = [table for table in held if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else held[0]
