"""One table from the trials of many runs, in which different solvers and layouts never share a name.

A layout is known by its digest and a solver by the digest of its settings, both columns of a study's trials.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.folder import judged
from torchgco.experiments.results.identity import ARITHMETIC, digest, flat
from torchgco.experiments.results.runs import DIGESTS, MERGED, ROW, Run, find_runs
from torchgco.experiments.results.variants import column, labels, task_of_runs
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

REPEATED = "repeated"  # in the attributes of a merged table: rows left out because another run has the same flight
UNFINISHED = "unfinished"  # likewise: for each study that isn't finished, "96 of 128 trials in FOLDER"
# Columns in which runs of one flight may differ: they depend on timing, batching and the other solvers that flew.
INCIDENTAL = {"seconds", "batch_size", "threads", "best_cost", "best_from", "success"}
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
