"""Trajectories and missions: two kinds of trials that may share a table, each with statistics and texts of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.mission_statistics import summarise_missions
from torchgco.experiments.statistics.mission_tables import format_missions, printed_missions
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import TASK, are_missions, summarise, task_columns
from torchgco.experiments.statistics.tables import csv_text, format_frame, format_table, printed

KIND = "kind"  # first column of summary.csv and paired.csv


class Kind(NamedTuple):
    """A kind of trials: its name, its statistics, and the texts and tables made of these and of comparisons."""

    name: str
    summarise: Callable[[pd.DataFrame], pd.DataFrame]
    text: Callable[[pd.DataFrame, pd.DataFrame], str]
    printed: Callable[[pd.DataFrame, pd.DataFrame], list[pd.DataFrame]]


TRAJECTORIES = Kind("trajectory", summarise, format_table, printed)
MISSIONS = Kind("mission", summarise_missions, format_missions, printed_missions)


@dataclass(frozen=True)
class Part:
    """The trials of one kind with their statistics.

    Args:
        summary: see `Kind.summarise`.
        paired: see `compare`; of missions by `reached` alone.
    """

    kind: Kind
    trials: pd.DataFrame
    summary: pd.DataFrame
    paired: pd.DataFrame


def parts_of(trials: pd.DataFrame) -> list[Part]:
    """The kinds in a table of trials, each without the swept variables of the other.

    Raises:
        InputError: as `summarise`.
    """
    missions = are_missions(trials)
    if trials.empty or not missions.any():
        return [Part(TRAJECTORIES, trials, summarise(trials), compare(trials))]
    flown, single = _own(trials[missions]), _own(trials[~missions])
    pairs = compare(flown)
    found = [Part(MISSIONS, flown, summarise_missions(flown), pairs[pairs["outcome"] == "reached"])]
    return [Part(TRAJECTORIES, single, summarise(single), compare(single)), *found] if len(single) else found


def _own(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows without swept variables that they don't have."""
    swept = task_columns(rows)[len(TASK) :]
    return rows.drop(columns=[name for name in swept if rows[name].isna().all()]).reset_index(drop=True)


def joined(parts: Sequence[Part]) -> dict[str, pd.DataFrame]:
    """The tables "summary" and "paired" of all parts, with the kind in the first column."""
    return {name: _stacked([(part.kind.name, getattr(part, name)) for part in parts]) for name in ("summary", "paired")}


def write_tables(folder: Path, parts: Sequence[Part]) -> None:
    """Write summary.csv, and paired.csv where solvers are compared."""
    for name, table in joined(parts).items():
        if name == "summary" or len(table):
            write(folder / f"{name}.csv", lambda file, table=table: file.write(csv_text(table).encode()))


def _stacked(tables: Sequence[tuple[str, pd.DataFrame]]) -> pd.DataFrame:
    held = []
    for kind, table in tables:
        # Columns that the other kind lacks would turn counts into floats.
        counts = [name for name in table.columns if pd.api.types.is_integer_dtype(table[name])] if tables[1:] else []
        held.append(table.astype(dict.fromkeys(counts, "Int64")))
        held[-1].insert(0, KIND, kind)
    filled = [table for table in held if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else held[0]


def format_report(parts: Sequence[Part], form: str) -> str:
    """The statistics of all kinds of trials, in one of `tables.OUTPUTS`.

    Formats:
        csv: the summary with all its columns.
        json: all columns of both tables, under "summary" and "paired"; null where a number is undefined.
        markdown, latex: the columns that a paper prints, of both tables, for each kind.
        table: as `format_table` and `format_missions`.
    """
    if form == "table":
        return "\n\n".join(part.kind.text(part.summary, part.paired) for part in parts)
    if form in ("csv", "json"):
        tables = joined(parts)
        if form == "csv":
            return format_frame(tables["summary"], form)
        return json.dumps({name: json.loads(format_frame(table, form)) for name, table in tables.items()}, indent=1)
    tables = [table for part in parts for table in part.kind.printed(part.summary, part.paired)]
    return "\n\n".join(format_frame(table, form) for table in tables)
