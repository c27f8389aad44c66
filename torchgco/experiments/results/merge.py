"""One table from the trials of many runs: what differs between them becomes columns and names of solvers.

A layout is known by its digest and a solver by the digest of its settings, both columns of a study's trials.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.folder import judged
from torchgco.experiments.results.identity import ARITHMETIC, CLOSED_LOOP, Manifest, digest, flat
from torchgco.experiments.results.runs import DIGESTS, MERGED, ROW, Run, find_runs
from torchgco.experiments.statistics.statistics import (
    OPTION,
    PAIR,
    TASK,
    are_missions,
    group_columns,
    grouped,
    plain,
    swept_columns,
    task_columns,
)

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
    known = (table.loc[table["layout_digest"].notna(), ["layout", "seed", "layout_digest"]] for table in tables)
    of_run = [layouts.assign(cell=code) for layouts, code in zip(known, values_of, strict=True)]
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


REPEATED = "repeated"  # in the attributes of a merged table: rows left out because another run has the same flight
UNFINISHED = "unfinished"  # likewise: for each study that isn't finished, "96 of 128 trials in FOLDER"
# Columns in which runs of one flight may differ: they depend on timing, batching and the other solvers that flew.
INCIDENTAL = {"seconds", "batch_size", "threads", "kernels", "best_cost", "best_from", "success"}
# Columns of numbers while runs are merged: of the run, the solver's variant, the layout.
RUN, VARIANT, LAYOUT = "_run", "_variant", "_layout"
OWN = [RUN, VARIANT]
# Columns of text that become categories: comparing and copying text would take most of a large report's time.
CODED = (*TASK, "solver", "status", "device", "dtype", "kernels", "version", "best_from", *DIGESTS)


def merge(folders: Iterable[str | os.PathLike[str]], trust: bool = False) -> pd.DataFrame:
    """All trials found in and below `folders`, as one table with the columns of a study, those of CODED as categories.

    - Keys of scenario and vehicle in which runs of one (scenario, model) differ become columns, named as on the
      command line: `scenario.num_obstacles`. Runs that flew other layouts without such a key get their folder in a
      column `hydra.run.dir`. Missions are compared with missions alone.
    - A solver that flew under several settings, versions or devices has a name for each, with the differing settings:
      "gco [max_outer_iterations=10]". Seeds don't count: other seeds are further trials of the same solver.
    - A flight that several runs hold counts once, as the first run has it.
    - Best costs are those of the merged table: success is judged again where layouts have no best cost in their file.

    The table's `attrs` hold `merged_from`, the folders read, `repeated`, how many rows were left out, and `unfinished`.

    Raises:
        InputError: a missing folder, folders without trials, a damaged file, without `trust` one that takes more memory
            than a run's file may, and rows with different content for one
            flight.
    """
    all_runs = find_runs(folders, trust)
    unfinished = [run for run in all_runs if run.planned is not None]
    runs = [run for run in all_runs if len(run.trials)]
    if not runs:
        raise InputError("folders", "studies with trials", f"{', '.join(map(_folder, all_runs))}, which have none yet")
    rows, variants = _tagged(runs)
    rows = _named(_without_repetitions(rows, runs), variants)
    merged = _sorted(_judged_together(rows)).drop(columns=OWN)
    merged.attrs = {
        MERGED: [_folder(run) for run in runs],
        REPEATED: sum(len(run.trials) for run in runs) - len(merged),
        UNFINISHED: [f"{len(run.trials)} of {run.planned} trials in {_folder(run)}" for run in unfinished],
    }
    return merged


def read(*folders: str | os.PathLike[str], trust: bool = False) -> pd.DataFrame:
    """All trials of the studies in and below some folders as one table: a row per solver and layout.

        table = torchgco.read("outputs")
        table.groupby(["scenario.num_obstacles", "solver"])["reached"].mean()

    The columns are those of a study, see the glossary of the manual, and the keys in which studies differ or that their
    sweeps changed. A solver that flew with several settings has a name for each, a flight that several studies hold
    counts once, and success is judged against the best cost of all of them. Studies that still run give what they have.

    Args:
        folders: studies, or folders of studies.
        trust: whether files may take any memory.

    Returns:
        The table; its `attrs` have `merged_from`, the folders read, `repeated`, how many rows were left out, and
        `unfinished`, a text for each study that is.

    Raises:
        InputError: a missing folder, folders without trials, a damaged file, one that takes more memory than it may
            without `trust`, and different results for one flight.
    """
    merged = merge(folders, trust)
    table = plain(merged)
    table.attrs = merged.attrs
    return table


def _folder(run: Run) -> str:
    return run.folder.as_posix()


def _tagged(runs: Sequence[Run]) -> tuple[pd.DataFrame, list[str]]:
    """The rows of all runs with swept variables and the columns OWN, and the variants that these number."""
    swept = task_of_runs(runs)
    tables = [
        _unswept(run).assign(**{name: more[name].array for name in more.columns}, **{RUN: i})
        for i, (run, more) in enumerate(zip(runs, swept, strict=True))
    ]
    rows = pd.concat(tables, ignore_index=True)
    rows = rows.assign(**{name: pd.Categorical.from_codes(*pd.factorize(rows[name])) for name in CODED if name in rows})
    settings = {digest(solver): solver for run in runs for solver in run.solvers.values()}
    rows = rows.assign(**_options(rows, settings))
    numbers: dict[str, int] = {}
    code = np.zeros(len(rows), dtype=int)
    names = [RUN, "settings_digest", "device", "dtype", "version"]
    groups = grouped(rows, names)
    firsts = rows[names].iloc[[group[0] for group in groups]].to_numpy(dtype=object)
    for group, (number, *key) in zip(groups, firsts.tolist(), strict=True):
        code[group] = numbers.setdefault(_variant(runs[number], settings, *key), len(numbers))
    return rows.assign(**{VARIANT: code}), list(numbers)


def _unswept(run: Run) -> pd.DataFrame:
    """The trials of a run without keys of its problems, where these are known from its configuration."""
    keys = task_columns(run.trials)[len(TASK) :] if run.configuration else []
    return run.trials.drop(columns=keys)


def _options(rows: pd.DataFrame, settings: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The columns of swept options of solvers, for all rows whose settings are known, by digest."""
    options, columns = {code: flat(solver) for code, solver in settings.items()}, dict[str, Any]()
    for name in (name for name in swept_columns(rows) if name.startswith(OPTION)):
        pairs, key = zip(rows["settings_digest"], rows[name], strict=True), name.removeprefix(OPTION)
        columns[name] = column([options[code].get(key, pd.NA) if code in options else cell for code, cell in pairs])
    return columns


def _variant(run: Run, settings: Mapping[str, dict[str, Any]], code: str, device: str, dtype: str, version: str) -> str:
    """All that distinguishes a solver's results from those of its other variants, as JSON for `labels`.

    Args:
        settings: of all solvers whose manifest was found, by digest.
    """
    kernels = (run.configuration.get("device") or {}).get("kernels", "native")
    values = flat(settings.get(code, {"settings": code}))
    values |= {f"device.{name}": value for name, value in zip(ARITHMETIC, (device, dtype, kernels), strict=True)}
    return json.dumps(values | {"version": version}, sort_keys=True, default=str)


def _without_repetitions(rows: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """Each flight once: as the first run has it, but one whose success and metrics are known before others.

    Raises:
        InputError: two runs give one flight different content.
    """
    own = {name for run in runs for name in (run.configuration.get("study") or {}).get("metrics") or ()}
    left_out = INCIDENTAL | {RUN} | own  # a study may have metrics that another hasn't
    content = [name for name in rows.columns if name not in left_out and not name.startswith(OPTION)]
    flight = [*dict.fromkeys([*task_columns(rows), *ROW]), VARIANT, "layout_digest"]
    repeated = rows.duplicated(flight, keep=False)
    twins = rows[repeated]
    if twins.empty:
        return rows
    unknown = twins[["success", *(name for name in rows.columns if name in own)]].isna().sum(axis=1)
    twins = twins.loc[unknown.sort_values(kind="stable").index].drop_duplicates(content)
    disputed = twins.duplicated(flight, keep=False)
    if disputed.any():
        raise _dispute(twins[disputed], content, runs)
    return pd.concat([rows[~repeated], twins]).sort_index()


def _named(rows: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """The rows with a label after the name of each solver that flew in several variants."""
    names = rows["solver"].astype(object)
    for group in grouped(rows, ["model", "solver"]):
        code = rows[VARIANT].iloc[group]
        numbers = code.unique().tolist()
        if len(numbers) > 1:
            by_variant = labels([variants[number] for number in numbers])
            label = code.map({number: by_variant[variants[number]] for number in numbers})
            names[code.index] = names[code.index] + " [" + label + "]"
    return rows.assign(solver=names.astype("category"))


def _dispute(rows: pd.DataFrame, content: list[str], runs: Sequence[Run]) -> InputError:
    """The error for rows of one name and different content, naming the first."""
    first = rows.iloc[0]
    twins = rows[(rows[ROW] == first[ROW]).all(axis=1)]
    columns = [name for name in content if twins[name].nunique(dropna=False) > 1]
    where = ", ".join(f"{name} {first[name]}" for name in ROW)
    return InputError(
        "folders",
        "one result per trial",
        f"two that differ in {', '.join(columns)} for {where}: "
        f"{' and '.join(_folder(runs[number]) for number in twins[RUN].iloc[:2])}",
    )


def _judged_together(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with success against one best cost per layout: its file's, else the best of all solvers that flew it."""
    layout = [*task_columns(rows), *PAIR[len(TASK) :], "layout_digest"]
    groups = pd.DataFrame(
        {
            LAYOUT: rows.groupby(layout, sort=False, dropna=False, observed=True).ngroup(),
            "best": rows["best_cost"].where(rows["best_from"] == "file").astype(float),
            "solver": pd.factorize(rows["solver"])[0],
        }
    ).groupby(LAYOUT)
    rivals = groups["solver"].transform("min") < groups["solver"].transform("max")
    rivals &= ~are_missions(rows)  # they have no costs to compare
    narrow = rows[["cost", "reached"]].assign(**{LAYOUT: groups.obj[LAYOUT]})
    again = judged(narrow, groups["best"].transform("min"), rivals, [LAYOUT])
    return rows.assign(**{name: again[name] for name in ("best_cost", "success", "best_from")})


def _sorted(rows: pd.DataFrame) -> pd.DataFrame:
    """By task and swept variables; solvers that are no baseline first, as a study has its own solver first."""
    flown = rows[[RUN, "solver"]].drop_duplicates()
    baselines = flown.loc[flown.duplicated(RUN), "solver"]  # not the first of their run
    groups = grouped(rows, group_columns(rows))
    heads = rows.iloc[[group[0] for group in groups]].reset_index(drop=True)
    keys = pd.DataFrame({name: pd.factorize(heads[name])[0] for name in TASK})
    for name in task_columns(rows)[len(TASK) :]:
        keys[name] = heads[name].rank(method="dense", na_option="bottom")
    keys["baseline"] = heads["solver"].isin(baselines)
    for name in (name for name in swept_columns(rows) if name.startswith(OPTION)):
        keys[name] = heads[name].rank(method="dense", na_option="bottom")
    keys["solver"] = pd.factorize(heads["solver"])[0]
    order = keys.sort_values(list(keys.columns), kind="stable").index
    return rows.take(np.concatenate([groups[i] for i in order])).reset_index(drop=True)
