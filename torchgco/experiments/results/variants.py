"""Differences between runs: variables swept over scenarios and vehicles, and the settings of solvers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
import pandas as pd

from torchgco.experiments.results.identity import CLOSED_LOOP, Manifest, flat
from torchgco.experiments.results.runs import Run
from torchgco.experiments.statistics.statistics import OPTION, TASK, are_missions, swept_columns

# Prefixes of keys that define the problems and missions; `model` has keys for solvers, too.
SWEPT = ("scenario.", "model.vehicle.", "vehicle.", "mission.", "plant.")
NAME_KEYS = ("scenario.name", "scenario._target_", "model.vehicle.name", "model.vehicle._target_")  # have columns
AIRFRAME = "model.vehicle.dynamics.airframe."  # whose keys are said in `vehicle`, and copied there
FILE = "scenario.path"
RUN_FOLDER = "hydra.run.dir"
LABEL_SETTINGS = 3  # settings named in a label


def task_of_runs(runs: Sequence[Run]) -> list[pd.DataFrame]:
    """For each run the columns that its rows get: the swept variables of each row's (scenario, model).

    A key is swept where all runs of a (scenario, model) have it, with different values, or where the command of one
    swept it; runs of missions are compared with each other only, as others lack their keys. `scenario.path` is left out
    while the layouts agree. Runs that differ in their layouts without such a key are distinguished by their folder.
    """
    tasks = [list(run.trials[TASK].drop_duplicates().itertuples(index=False, name=None)) for run in runs]
    missions = [bool(are_missions(run.trials).all()) for run in runs]
    chosen: dict[tuple[int, Any], dict[str, Any]] = {}
    of_kind = [(task, kind) for flown, kind in zip(tasks, missions, strict=True) for task in flown]
    for task, kind in dict.fromkeys(of_kind):
        members = [i for i, flown in enumerate(tasks) if task in flown and missions[i] == kind]
        of_task = lambda trials, task=task: trials[(trials[TASK] == list(task)).all(axis=1)]
        # Nearly always a run has flown a single task.
        tables = [runs[i].trials if len(tasks[i]) == 1 else of_task(runs[i].trials) for i in members]
        cells = _swept([runs[i] for i in members], tables)
        chosen |= {(i, task): values for i, values in zip(members, cells, strict=True)}
    columns = list(dict.fromkeys(key for values in chosen.values() for key in values))
    kinds = {key: _kind([values[key] for values in chosen.values() if key in values]) for key in columns}
    frames = []
    for i, (run, flown) in enumerate(zip(runs, tasks, strict=True)):
        cells = [chosen[i, task] for task in flown]
        of_row = np.zeros(len(run.trials), dtype=int)
        if len(flown) > 1:
            of_row = run.trials.groupby(TASK, sort=False, dropna=False, observed=True).ngroup()  # numbers `flown`
        arrays = {
            key: pd.array([_cell(cell.get(key), key in cell, kinds[key]) for cell in cells], dtype=kinds[key])
            for key in columns
        }
        frames.append(pd.DataFrame(arrays, index=range(len(cells))).take(of_row).set_axis(run.trials.index))
    return frames


def _swept(runs: Sequence[Run], tables: Sequence[pd.DataFrame]) -> list[dict[str, Any]]:
    """The swept variables of each run that flew a task; none for a run whose configuration isn't known.

    Args:
        tables: the trials of each run in that task.
    """
    all_keys = [_keys(run) for run in runs]
    known = [keys for keys in all_keys if keys]
    shared = [key for key in (known[0] if known else {}) if all(key in keys for keys in known)]
    columns = {key for run in runs for key in swept_columns(run.trials)}
    differs = lambda key: key in columns or len({_text(keys[key]) for keys in known}) > 1
    swept = [key for key in shared if key != FILE and differs(key)]
    cells = [{key: keys[key] for key in swept if keys} for keys in all_keys]
    clusters = _clusters(runs, cells, tables)
    if FILE in shared and any(clusters):
        for cell, keys in zip(cells, all_keys, strict=True):
            cell |= {FILE: keys[FILE]} if keys else {}
        clusters = _clusters(runs, cells, tables)
    for cell, cluster in zip(cells, clusters, strict=True):
        cell |= {RUN_FOLDER: cluster} if cluster else {}
    return cells


def _keys(run: Run) -> dict[str, Any]:
    return _of_problems(run.configuration)


def _of_problems(configuration: Mapping[str, Any]) -> dict[str, Any]:
    parts = {name: configuration.get(name) for name in ("scenario", "vehicle", "model", *CLOSED_LOOP)}
    keys = flat({name: node for name, node in parts.items() if isinstance(node, Mapping)})
    named = {key: value for key, value in keys.items() if key.startswith(SWEPT) and key not in NAME_KEYS}
    return {key: value for key, value in named.items() if parts["vehicle"] is None or not key.startswith(AIRFRAME)}


def values_of(rows: pd.DataFrame, manifest: Manifest, keys: Sequence[str]) -> dict[str, Any]:
    """Columns for the rows of a study: of those keys that define its problems, missions or solvers.

    An option `solver.KEY` has the value of each row's own solver, NA where that has no such option.
    """
    shared, columns = _of_problems(manifest.configuration), dict[str, Any]()
    options = {name: flat(settings) for name, settings in manifest.solvers.items()}
    for key in keys:
        if key in shared:
            columns[key] = column([shared[key]] * len(rows))
        elif key.startswith(OPTION) and any(key.removeprefix(OPTION) in settings for settings in options.values()):
            values = {name: settings.get(key.removeprefix(OPTION), pd.NA) for name, settings in options.items()}
            columns[key] = column([values[name] for name in rows["solver"]])
    return columns


def column(values: Sequence[Any]) -> Any:
    """Values of a key as an array: numbers where all are, else texts; NA where there is none."""
    kind = _kind([value for value in values if value is not pd.NA])
    return pd.array([_cell(value, value is not pd.NA, kind) for value in values], dtype=kind)


def _clusters(
    runs: Sequence[Run], cells: Sequence[Mapping[str, Any]], tables: Sequence[pd.DataFrame]
) -> list[str | None]:
    """For each run the folder of the first run that flew the same layouts; None where all did.

    Runs whose swept values (`cells`) differ are not compared.
    """
    clusters: list[tuple[str, dict[Any, str], str]] = []  # folder, digest by (layout, seed), swept values
    numbers = []
    values_of = pd.factorize(np.array([_text(cell) for cell in cells], dtype=object))[0]
    seeds = [(seed, code) for table, code in zip(tables, values_of, strict=True) for seed in table["seed"].unique()]
    if len(set(seeds)) == len(seeds):
        return [None] * len(runs)  # no two runs have layouts in common
    of_run = [_digests(table).assign(cell=code) for table, code in zip(tables, values_of, strict=True)]
    layouts = [rows for rows in of_run if len(rows)]
    if not layouts or not pd.concat(layouts).drop_duplicates().duplicated(["layout", "seed", "cell"]).any():
        return [None] * len(runs)  # nearly always: nothing to distinguish
    for run, rows, cell in zip(runs, of_run, cells, strict=True):
        digests, values = rows.set_index(["layout", "seed"])["layout_digest"].to_dict(), _text(cell)
        for number, (_, known, theirs) in enumerate(clusters):
            if values == theirs and all(known.get(key, code) == code for key, code in digests.items()):
                known.update(digests)
                numbers.append(number)
                break
        else:
            numbers.append(len(clusters))
            clusters.append((run.folder.as_posix(), digests, values))
    split = [sum(theirs == values for *_, theirs in clusters) > 1 for *_, values in clusters]
    return [clusters[number][0] if split[number] else None for number in numbers]


def _digests(trials: pd.DataFrame) -> pd.DataFrame:
    """The known layouts of some trials: columns layout, seed and layout_digest."""
    names = ["layout", "seed", "layout_digest"]
    return trials.loc[trials["layout_digest"].notna(), names]


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
    parsed = {variant: json.loads(variant) for variant in variants}
    keys = dict.fromkeys(key for settings in parsed.values() for key in settings)
    differ = [key for key in keys if len({_text(settings.get(key)) for settings in parsed.values()}) > 1]
    if "version" in differ and len({settings.get("version") for settings in parsed.values()}) == len(parsed):
        differ = ["version"]
    made: dict[str, str] = {}
    for variant, settings in parsed.items():
        more = f", {len(differ) - LABEL_SETTINGS} more" if len(differ) > LABEL_SETTINGS else ""
        label = ", ".join(f"{key}={_value(settings, key)}" for key in differ[:LABEL_SETTINGS]) + more
        alike = sum(other == label or other.startswith(f"{label} #") for other in made.values())
        made[variant] = f"{label} #{alike + 1}" if alike else label
    return made


def _value(settings: Mapping[str, Any], key: str) -> str:
    value = settings.get(key, "none")
    text = value if isinstance(value, str) else _text(value)
    return text if len(text) <= 24 else f"{text[:24]}..."
