"""One table from the trials of many runs, in which different solvers and layouts never share a name.

A layout is known by its digest and a solver by the digest of its settings, both columns of a study's trials. Runs of
older versions have neither: they are distinguished by their configurations and results alone.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from torchgco.errors import InputError
from torchgco.experiments.identity import ARITHMETIC, digest, flat
from torchgco.experiments.runs import MERGED, ROW, Run, find_runs
from torchgco.experiments.statistics import PAIR, TASK, task_columns
from torchgco.experiments.success import judged, sound
from torchgco.experiments.variants import UNKNOWN, labels, task_of_runs

REPEATED = "repeated"  # in the attributes of a merged table: rows left out because another run has the same flight
OLDER = "older"  # likewise: the folders of runs without digests
DIGESTS = ("layout_digest", "settings_digest")
# Columns in which runs of one flight may differ: they depend on timing, batching and the other solvers that flew.
INCIDENTAL = {"seconds", "batch_size", "threads", "best_cost", "best_from", "success"}
FOLDER, VARIANT, CONFIGURATION = "_folder", "_variant", "_configuration"
OWN = [FOLDER, VARIANT, CONFIGURATION]


def merge(folders: Iterable[str | os.PathLike[str]]) -> pd.DataFrame:
    """All trials found in and below `folders`, as one table with the columns of a study.

    - Keys of scenario and vehicle in which runs of one (scenario, model) differ become columns, named as on the
      command line: `scenario.num_obstacles`. Runs that flew other layouts without such a key get their folder in a
      column `hydra.run.dir`.
    - A solver that flew under several settings, versions or devices has a name for each, with the differing settings:
      "gco [max_outer_iterations=10]". Seeds don't count: other seeds are further trials of the same solver.
    - A flight that several runs hold counts once, as the first run has it.
    - Best costs are those of the merged table: success is judged again where layouts have no best cost in their file.

    The table's `attrs` hold `merged_from`, the folders read, `repeated`, how many rows were left out, and `older`, the
    folders of runs without digests. Of those, different results for one trial get the run's folder as label.

    Raises:
        InputError: a missing folder, folders without trials, a damaged file, and rows with different content for one
            flight.
    """
    runs = find_runs(folders)
    settings = {digest(held): held for run in runs for held in run.solvers.values()}
    rows = pd.concat([_tagged(run, swept, settings) for run, swept in zip(runs, task_of_runs(runs), strict=True)])
    rows = _named(_without_repetitions(rows.reset_index(drop=True)))
    merged = _sorted(_judged_together(rows)).drop(columns=OWN)
    older = [run.folder.as_posix() for run in runs if _is_older(run.trials)]
    found = [run.folder.as_posix() for run in runs]
    merged.attrs = {MERGED: found, REPEATED: sum(len(run.trials) for run in runs) - len(merged), OLDER: older}
    return merged


def _is_older(trials: pd.DataFrame) -> bool:
    return not set(DIGESTS) <= set(trials.columns)


def _tagged(run: Run, swept: pd.DataFrame, settings: Mapping[str, dict[str, Any]]) -> pd.DataFrame:
    """The rows of a run with its swept variables, its folder, and the variants of its solvers.

    settings  of all solvers whose manifest was found, by digest
    """
    rows = run.trials.assign(**{name: swept[name].array for name in swept.columns})
    configuration = json.dumps(run.configuration, sort_keys=True, default=str) if run.configuration else ""
    rows[FOLDER], rows[CONFIGURATION] = run.folder.as_posix(), configuration
    if _is_older(rows):
        return rows.assign(**{VARIANT: UNKNOWN})
    kernels = run.configuration.get("device", {}).get("kernels", "native")
    names = ["settings_digest", "device", "dtype", "version"]
    made = {}
    for key in rows[names].drop_duplicates().itertuples(index=False, name=None):
        code, device, dtype, version = key
        arithmetic = zip(ARITHMETIC, (device, dtype, kernels), strict=True)
        held = flat(settings.get(code, {"settings": code}))
        held |= {f"device.{name}": value for name, value in arithmetic} | {"version": version}
        made[key] = json.dumps(held, sort_keys=True, default=str)
    return rows.assign(**{VARIANT: [made[key] for key in rows[names].itertuples(index=False, name=None)]})


def _without_repetitions(rows: pd.DataFrame) -> pd.DataFrame:
    """Each flight once: as the first run has it, but one whose success is known before one whose isn't.

    Raises:
        InputError: two runs give one flight different content.
    """
    if "success" in rows.columns:
        rows = rows.loc[rows["success"].isna().sort_values(kind="stable").index]
    content = [name for name in rows.columns if name not in INCIDENTAL | {FOLDER, CONFIGURATION}]
    known = rows[rows[VARIANT] != UNKNOWN].drop_duplicates(content)
    flight = [*dict.fromkeys([*task_columns(rows), *ROW]), VARIANT, *(n for n in DIGESTS if n in rows.columns)]
    twice = known.duplicated(flight, keep=False)
    if twice.any():
        raise _dispute(known[twice], content)
    older = rows[rows[VARIANT] == UNKNOWN].groupby([*task_columns(rows), "solver"], sort=False, dropna=False)
    return pd.concat([known, *(_of_older_runs(group, content) for _, group in older)]).sort_index()


def _of_older_runs(group: pd.DataFrame, content: list[str]) -> pd.DataFrame:
    """The rows of one solver on one task without repetitions; labelled by their folders where results differ."""
    rows = group.drop_duplicates(content)
    disputed = rows[rows.duplicated(ROW, keep=False)]
    if disputed.empty:
        return rows
    # All rows get a label: under the bare name, a run's undisputed rows would look like the whole run.
    rows = group.drop_duplicates([*content, CONFIGURATION])
    same = rows[rows.duplicated([*ROW, CONFIGURATION], keep=False)]
    if len(same) or (disputed[CONFIGURATION] == "").any():
        raise _dispute(disputed if same.empty else same, content)
    first = rows.groupby(CONFIGURATION)[FOLDER].transform("first")
    return rows.assign(solver=rows["solver"] + " [" + first.map(_short(first.unique())) + "]")


def _named(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with a label after the name of each solver that flew in several variants."""
    names = rows["solver"].copy()
    for _, group in rows.groupby(["model", "solver"], sort=False, dropna=False):
        known, older = group[group[VARIANT] != UNKNOWN], group[group[VARIANT] == UNKNOWN]
        found = labels(known[VARIANT].unique().tolist())
        if len(found) > 1:
            names[known.index] = known["solver"] + " [" + known[VARIANT].map(found) + "]"
        if len(known) and len(older):
            names[older.index] = older["solver"] + " [" + older[FOLDER].map(_short(rows[FOLDER].unique())) + "]"
    return rows.assign(solver=names)


def _short(folders: Iterable[str]) -> dict[str, str]:
    """A short name for each folder, without their common part."""
    names = list(folders)
    common = os.path.commonpath(names)
    return {name: Path(name).name if name == common else os.path.relpath(name, common) for name in names}


def _dispute(rows: pd.DataFrame, content: list[str]) -> InputError:
    """The error for rows of one name and different content, naming the first."""
    first = rows.iloc[0]
    twins = rows[(rows[ROW] == first[ROW]).all(axis=1)]
    columns = [name for name in content if twins[name].nunique(dropna=False) > 1]
    where = ", ".join(f"{name} {first[name]}" for name in ROW)
    return InputError(
        "folders",
        "one result per trial, or runs whose configurations are known to differ",
        f"two that differ in {', '.join(columns)} for {where}: {' and '.join(twins[FOLDER].iloc[:2])}",
    )


def _judged_together(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with success against one best cost per layout: its file's, else the best of all solvers that flew it."""
    if "best_from" not in rows.columns:
        return rows
    new = rows[rows["layout_digest"].notna() & rows["settings_digest"].notna()]
    layout = [*task_columns(rows), *PAIR[len(TASK) :], "layout_digest"]
    best = new["best_cost"].where(new["best_from"] == "file").astype(float)
    groups = new.assign(_best=best).groupby(layout, sort=False, dropna=False)
    rivals = groups["solver"].transform("nunique") > 1
    again = judged(new.assign(sound=sound(new)), groups["_best"].transform("min"), rivals, layout)
    old = rows[~rows.index.isin(new.index)]
    return pd.concat([again[rows.columns], old]).sort_index() if len(old) else again[rows.columns]


def _sorted(rows: pd.DataFrame) -> pd.DataFrame:
    """By task and swept variables; solvers that are no baseline first, as a study has its own solver first."""
    firsts = rows.groupby(FOLDER, sort=False)["solver"].transform("first")
    baselines = set(rows.loc[rows["solver"] != firsts, "solver"])
    rank = {name: i for i, name in enumerate(rows["solver"].unique())}
    keys = pd.DataFrame(index=rows.index)
    for name in TASK:
        keys[name] = pd.factorize(rows[name])[0]
    for name in task_columns(rows)[len(TASK) :]:
        keys[name] = rows[name].rank(method="dense", na_option="bottom")
    keys["baseline"] = rows["solver"].isin(baselines)
    keys["solver"] = rows["solver"].map(rank)
    return rows.loc[keys.sort_values(list(keys.columns), kind="stable").index].reset_index(drop=True)
