"""Differences between runs: variables swept over scenarios and vehicles, and the settings of solvers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import pandas as pd

from torchgco.experiments.identity import CLOSED_LOOP, flat
from torchgco.experiments.runs import Run
from torchgco.experiments.statistics import TASK

UNKNOWN = ""  # variant of a solver in a run of an older version
# Prefixes of keys that define the problems and missions; `model` has keys for solvers, too.
SWEPT = ("scenario.", "model.vehicle.", "mission.", "plant.")
NAMES = ("scenario.name", "scenario._target_", "model.vehicle.name", "model.vehicle._target_")  # have columns
FILE = "scenario.path"
RUN = "hydra.run.dir"
MOST = 3  # settings named in a label


def task_of_runs(runs: Sequence[Run]) -> list[pd.DataFrame]:
    """For each run the columns that its rows get: the swept variables of each row's (scenario, model).

    A key is swept where all runs of a (scenario, model) have it, with different values. `scenario.path` is left
    out while the layouts agree. Runs that differ in their layouts without such a key are distinguished by their folder.
    """
    tasks = [list(run.trials[TASK].drop_duplicates().itertuples(index=False, name=None)) for run in runs]
    chosen: dict[tuple[int, Any], dict[str, Any]] = {}
    for task in dict.fromkeys(task for found in tasks for task in found):
        members = [i for i, found in enumerate(tasks) if task in found]
        cells = _swept([runs[i] for i in members], task)
        chosen |= {(i, task): held for i, held in zip(members, cells, strict=True)}
    columns = list(dict.fromkeys(key for held in chosen.values() for key in held))
    kinds = {key: _kind([held[key] for held in chosen.values() if key in held]) for key in columns}
    frames = []
    for i, run in enumerate(runs):
        of_row = [chosen[i, task] for task in run.trials[TASK].itertuples(index=False, name=None)]
        held = {
            key: pd.array([_cell(row.get(key), key in row, kinds[key]) for row in of_row], dtype=kinds[key])
            for key in columns
        }
        frames.append(pd.DataFrame(held, index=run.trials.index))
    return frames


def _swept(runs: Sequence[Run], task: tuple[Any, ...]) -> list[dict[str, Any]]:
    """The swept variables of each run that flew a task; none for a run whose configuration isn't known."""
    given = [_keys(run) for run in runs]
    known = [keys for keys in given if keys]
    shared = [key for key in (known[0] if known else {}) if all(key in keys for keys in known)]
    swept = [key for key in shared if key != FILE and len({_text(keys[key]) for keys in known}) > 1]
    cells = [{key: keys[key] for key in swept if keys} for keys in given]
    clusters = _clusters(runs, cells, task)
    if FILE in shared and any(clusters):
        for cell, keys in zip(cells, given, strict=True):
            cell |= {FILE: keys[FILE]} if keys else {}
        clusters = _clusters(runs, cells, task)
    for cell, cluster in zip(cells, clusters, strict=True):
        cell |= {RUN: cluster} if cluster else {}
    return cells


def _keys(run: Run) -> dict[str, Any]:
    parts = {name: run.configuration.get(name) for name in ("scenario", "model", *CLOSED_LOOP)}
    keys = flat({name: part for name, part in parts.items() if isinstance(part, Mapping)})
    return {key: value for key, value in keys.items() if key.startswith(SWEPT) and key not in NAMES}


def _clusters(runs: Sequence[Run], cells: Sequence[Mapping[str, Any]], task: tuple[Any, ...]) -> list[str | None]:
    """For each run the folder of the first run that flew the same layouts; None where all did.

    Runs whose swept values (`cells`) differ are not compared.
    """
    held: list[tuple[str, dict[Any, str], str]] = []  # folder, digest by (layout, seed), swept values
    place = []
    for run, cell in zip(runs, cells, strict=True):
        digests, values = _digests(run, task), _text(cell)
        for number, (_, known, theirs) in enumerate(held):
            if values == theirs and all(known.get(key, code) == code for key, code in digests.items()):
                known.update(digests)
                place.append(number)
                break
        else:
            place.append(len(held))
            held.append((run.folder.as_posix(), digests, values))
    split = [sum(theirs == values for *_, theirs in held) > 1 for *_, values in held]
    return [held[number][0] if split[number] else None for number in place]


def _digests(run: Run, task: tuple[Any, ...]) -> dict[Any, str]:
    if "layout_digest" not in run.trials.columns:
        return {}
    rows = run.trials[(run.trials[TASK] == list(task)).all(axis=1)]
    columns = rows[["layout", "seed", "layout_digest"]].dropna()
    return {(layout, seed): code for layout, seed, code in columns.itertuples(index=False, name=None)}


def _kind(values: Sequence[Any]) -> str:
    """Type of a column: numbers stay numbers, all else is text."""
    if all(isinstance(value, Real) and not isinstance(value, bool) for value in values):
        return "Int64" if all(isinstance(value, int) for value in values) else "Float64"
    return "string"


def _cell(value: Any, there: bool, kind: str) -> Any:
    if not there:
        return pd.NA
    return (value if isinstance(value, str) else _text(value)) if kind == "string" else value


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)


def labels(variants: Sequence[str]) -> dict[str, str]:
    """A label for each variant of a solver (settings by key, as JSON): the settings that differ, with their values.

    Where the versions alone distinguish the variants, the label is the version. Of many settings the first are named,
    and a number makes equal labels unique.
    """
    held = {variant: json.loads(variant) for variant in variants}
    keys = dict.fromkeys(key for settings in held.values() for key in settings)
    differ = [key for key in keys if len({_text(settings.get(key)) for settings in held.values()}) > 1]
    if "version" in differ and len({settings.get("version") for settings in held.values()}) == len(held):
        differ = ["version"]
    made: dict[str, str] = {}
    for variant, settings in held.items():
        more = f", {len(differ) - MOST} more" if len(differ) > MOST else ""
        label = ", ".join(f"{key}={_value(settings, key)}" for key in differ[:MOST]) + more
        alike = sum(other == label or other.startswith(f"{label} #") for other in made.values())
        made[variant] = f"{label} #{alike + 1}" if alike else label
    return made


def _value(settings: Mapping[str, Any], key: str) -> str:
    value = settings.get(key, "none")
    text = value if isinstance(value, str) else _text(value)
    return text if len(text) <= 24 else f"{text[:24]}..."
