"""One table from the trials of many runs, in which different solvers and layouts never share a name.

A layout is known by its digest and a solver by the digest of its settings, both columns of a study's trials. Runs of
older versions have neither: they are distinguished by their configurations and results alone.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.identity import ARITHMETIC, digest, flat
from torchgco.experiments.results.runs import MERGED, ROW, Run, find_runs
from torchgco.experiments.results.success import judged, sound
from torchgco.experiments.results.variants import labels, task_of_runs
from torchgco.experiments.statistics.statistics import PAIR, TASK, are_missions, grouped, task_columns

REPEATED = "repeated"  # in the attributes of a merged table: rows left out because another run has the same flight
OLDER = "older"  # likewise: the folders of runs without digests
UNFINISHED = "unfinished"  # likewise: for each study that isn't finished, "96 of 128 trials in FOLDER"
DIGESTS = ("layout_digest", "settings_digest")
# Columns in which runs of one flight may differ: they depend on timing, batching and the other solvers that flew.
INCIDENTAL = {"seconds", "batch_size", "threads", "best_cost", "best_from", "success"}
# Columns of numbers while runs are merged: of the run, the solver's variant (-1: unknown), the layout.
RUN, VARIANT, LAYOUT = "_run", "_variant", "_layout"
OWN = [RUN, VARIANT]
# Columns of text that become categories: comparing and copying text would take most of a large report's time.
TEXT = (*TASK, "solver", "status", "device", "dtype", "version", "best_from", *DIGESTS)


def merge(folders: Iterable[str | os.PathLike[str]]) -> pd.DataFrame:
    """All trials found in and below `folders`, as one table with the columns of a study, those of TEXT as categories.

    - Keys of scenario and vehicle in which runs of one (scenario, model) differ become columns, named as on the
      command line: `scenario.num_obstacles`. Runs that flew other layouts without such a key get their folder in a
      column `hydra.run.dir`. Missions are compared with missions alone.
    - A solver that flew under several settings, versions or devices has a name for each, with the differing settings:
      "gco [max_outer_iterations=10]". Seeds don't count: other seeds are further trials of the same solver.
    - A flight that several runs hold counts once, as the first run has it.
    - Best costs are those of the merged table: success is judged again where layouts have no best cost in their file.

    The table's `attrs` hold `merged_from`, the folders read, `repeated`, how many rows were left out, `older`, the
    folders of runs without digests, and `unfinished`. Of older runs, different results for one trial get the run's
    folder as label.

    Raises:
        InputError: a missing folder, folders without trials, a damaged file, and rows with different content for one
            flight.
    """
    found = find_runs(folders)
    unfinished = [run for run in found if run.planned is not None]
    runs = [run for run in found if len(run.trials)]
    if not runs:
        raise InputError("folders", "studies with trials", f"{', '.join(map(_folder, found))}, which have none yet")
    rows, variants = _tagged(runs)
    rows = _named(_without_repetitions(rows, runs), runs, variants)
    merged = _sorted(_judged_together(rows)).drop(columns=OWN)
    merged.attrs = {
        MERGED: [_folder(run) for run in runs],
        REPEATED: sum(len(run.trials) for run in runs) - len(merged),
        OLDER: [_folder(run) for run in runs if _is_older(run.trials)],
        UNFINISHED: [f"{len(run.trials)} of {run.planned} trials in {_folder(run)}" for run in unfinished],
    }
    return merged


def _folder(run: Run) -> str:
    return run.folder.as_posix()


def _is_older(trials: pd.DataFrame) -> bool:
    return not set(DIGESTS) <= set(trials.columns)


def _tagged(runs: Sequence[Run]) -> tuple[pd.DataFrame, list[str]]:
    """The rows of all runs with swept variables and the columns OWN, and the variants that these number."""
    swept = task_of_runs(runs)
    tables = [
        run.trials.assign(**{name: more[name].array for name in more.columns}, **{RUN: i})
        for i, (run, more) in enumerate(zip(runs, swept, strict=True))
    ]
    rows = pd.concat(tables, ignore_index=True)
    rows = rows.assign(**{name: pd.Categorical.from_codes(*pd.factorize(rows[name])) for name in TEXT if name in rows})
    settings = {digest(held): held for run in runs for held in run.solvers.values()}
    numbers: dict[str, int] = {}
    code = np.full(len(rows), -1)
    names = [RUN, "settings_digest", "device", "dtype", "version"]
    if not all(_is_older(run.trials) for run in runs):
        groups = grouped(rows, names)
        firsts = rows[names].iloc[[place[0] for place in groups]].to_numpy(dtype=object)
        for place, (number, *key) in zip(groups, firsts.tolist(), strict=True):
            if not _is_older(runs[number].trials):
                code[place] = numbers.setdefault(_variant(runs[number], settings, *key), len(numbers))
    return rows.assign(**{VARIANT: code}), list(numbers)


def _variant(run: Run, settings: Mapping[str, dict[str, Any]], code: str, device: str, dtype: str, version: str) -> str:
    """All that distinguishes a solver's results from those of its other variants, as JSON for `labels`.

    settings  of all solvers whose manifest was found, by digest
    """
    kernels = run.configuration.get("device", {}).get("kernels", "native")
    held = flat(settings.get(code, {"settings": code}))
    held |= {f"device.{name}": value for name, value in zip(ARITHMETIC, (device, dtype, kernels), strict=True)}
    return json.dumps(held | {"version": version}, sort_keys=True, default=str)


def _without_repetitions(rows: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """Each flight once: as the first run has it, but one whose success is known before one whose isn't.

    Raises:
        InputError: two runs give one flight different content.
    """
    content = [name for name in rows.columns if name not in INCIDENTAL | {RUN}]
    flight = [*dict.fromkeys([*task_columns(rows), *ROW]), VARIANT, *(n for n in DIGESTS[:1] if n in rows.columns)]
    known = rows[VARIANT] >= 0
    repeated = known & rows.duplicated(flight, keep=False)
    twins = rows[repeated]
    if len(twins):
        twins = twins.loc[twins["success"].isna().sort_values(kind="stable").index].drop_duplicates(content)
        disputed = twins.duplicated(flight, keep=False)
        if disputed.any():
            raise _dispute(twins[disputed], content, runs)
    if known.all() and not len(twins):
        return rows
    older = rows[~known]
    groups = [older.iloc[place] for place in grouped(older, [*task_columns(rows), "solver"])] if len(older) else []
    once = [_of_older_runs(held, content, runs) for held in groups]
    return pd.concat([rows[known & ~repeated], twins, *once]).sort_index()


def _of_older_runs(group: pd.DataFrame, content: list[str], runs: Sequence[Run]) -> pd.DataFrame:
    """The rows of one solver on one task without repetitions; labelled by their folders where results differ."""
    rows = group.drop_duplicates(content)
    disputed = rows[rows.duplicated(ROW, keep=False)]
    if disputed.empty:
        return rows
    texts = {i: json.dumps(runs[i].configuration, sort_keys=True, default=str) for i in group[RUN].unique()}
    configuration = group[RUN].map(texts)
    # All rows get a label: under the bare name, a run's undisputed rows would look like the whole run.
    rows = group.assign(_text=configuration).drop_duplicates([*content, "_text"])
    same = rows[rows.duplicated([*ROW, "_text"], keep=False)]
    if len(same) or not all(runs[i].configuration for i in disputed[RUN].unique()):
        raise _dispute(disputed if same.empty else same, content, runs)
    first = rows.groupby("_text")[RUN].transform("first")
    label = " [" + first.map(_short(first, runs)) + "]"
    return rows.drop(columns="_text").assign(solver=rows["solver"].astype(object) + label)


def _named(rows: pd.DataFrame, runs: Sequence[Run], variants: list[str]) -> pd.DataFrame:
    """The rows with a label after the name of each solver that flew in several variants."""
    names = rows["solver"].astype(object)
    for place in grouped(rows, ["model", "solver"]):
        code = rows[VARIANT].iloc[place]
        numbers = [number for number in code.unique() if number >= 0]
        if len(numbers) > 1:
            found = labels([variants[number] for number in numbers])
            label = code[code >= 0].map({number: found[variants[number]] for number in numbers})
            names[label.index] = names[label.index] + " [" + label + "]"
        if numbers and (code < 0).any():
            run = rows.loc[code.index[code < 0], RUN]
            names[run.index] = names[run.index] + " [" + run.map(_short(rows[RUN], runs)) + "]"
    return rows.assign(solver=names.astype("category"))


def _short(numbers: pd.Series, runs: Sequence[Run]) -> dict[int, str]:
    """A short name for the folder of each run, without their common part."""
    folders = {number: _folder(runs[number]) for number in numbers.unique()}
    common = os.path.commonpath(list(folders.values()))
    return {i: Path(name).name if name == common else os.path.relpath(name, common) for i, name in folders.items()}


def _dispute(rows: pd.DataFrame, content: list[str], runs: Sequence[Run]) -> InputError:
    """The error for rows of one name and different content, naming the first."""
    first = rows.iloc[0]
    twins = rows[(rows[ROW] == first[ROW]).all(axis=1)]
    columns = [name for name in content if twins[name].nunique(dropna=False) > 1]
    where = ", ".join(f"{name} {first[name]}" for name in ROW)
    return InputError(
        "folders",
        "one result per trial, or runs whose configurations are known to differ",
        f"two that differ in {', '.join(columns)} for {where}: "
        f"{' and '.join(_folder(runs[number]) for number in twins[RUN].iloc[:2])}",
    )


def _judged_together(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with success against one best cost per layout: its file's, else the best of all solvers that flew it."""
    if "best_from" not in rows.columns:
        return rows
    new = rows[rows[VARIANT] >= 0]
    layout = [*task_columns(rows), *PAIR[len(TASK) :], "layout_digest"]
    groups = pd.DataFrame(
        {
            LAYOUT: new.groupby(layout, sort=False, dropna=False, observed=True).ngroup(),
            "best": new["best_cost"].where(new["best_from"] == "file").astype(float),
            "solver": pd.factorize(new["solver"])[0],
        }
    ).groupby(LAYOUT)
    rivals = groups["solver"].transform("min") < groups["solver"].transform("max")
    rivals &= ~are_missions(new)  # they have no costs to compare
    narrow = new[["cost"]].assign(sound=sound(new), **{LAYOUT: groups.obj[LAYOUT]})
    again = judged(narrow, groups["best"].transform("min"), rivals, [LAYOUT])
    names = ["best_cost", "success", "best_from"]
    if len(new) < len(rows):
        again = pd.concat([again[names], rows.loc[rows[VARIANT] < 0, names]]).sort_index()
    return rows.assign(**{name: again[name] for name in names})


def _sorted(rows: pd.DataFrame) -> pd.DataFrame:
    """By task and swept variables; solvers that are no baseline first, as a study has its own solver first."""
    flown = rows[[RUN, "solver"]].drop_duplicates()
    baselines = flown.loc[flown.duplicated(RUN), "solver"]  # not the first of their run
    groups = grouped(rows, [*task_columns(rows), "solver"])
    heads = rows.iloc[[place[0] for place in groups]].reset_index(drop=True)
    keys = pd.DataFrame({name: pd.factorize(heads[name])[0] for name in TASK})
    for name in task_columns(rows)[len(TASK) :]:
        keys[name] = heads[name].rank(method="dense", na_option="bottom")
    keys["baseline"] = heads["solver"].isin(baselines)
    keys["solver"] = pd.factorize(heads["solver"])[0]
    order = keys.sort_values(list(keys.columns), kind="stable").index
    return rows.take(np.concatenate([groups[i] for i in order])).reset_index(drop=True)
