"""One table from the trials of many runs, never mixing what differs under one name."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from torchgco.experiments.statistics import GROUP, PAIR
from torchgco.shapes import InputError

TRIALS = "trials.parquet"
MERGED = "merged_from"  # in the attributes of a merged table: the folders it came from
REPEATED = "repeated"  # and how many rows were left out because another run had the same
ROW = [*PAIR, "solver"]
# Two runs never take the same time, so a time doesn't tell one result from another.
MEASURED = {"seconds"}
FOLDER, CONFIGURATION = "_folder", "_configuration"


def merge(folders: Iterable[str | os.PathLike[str]]) -> pd.DataFrame:
    """All trials found in and below `folders`, as one table with the columns of a study.

    A row that stands in several runs with the same content (`seconds` apart) is kept once, as the first run
    has it. Where runs of different configurations give different content for the same (scenario, model,
    solver, layout, seed), the solver's name gets the run's folder as a label, "gco [run]", in every row of
    that (scenario, model, solver). Tables that a merge wrote are passed over below a folder, and read where
    the folder itself is given.

    The table's `attrs` tell `merged_from`, the folders read, and `repeated`, how many rows were left out.

    Raises InputError for a folder that isn't there, folders without trials, a file that can't be read, and
    rows with different content under one name where the configurations are the same or unknown.
    """
    runs = _find(folders)
    rows = pd.concat([_tagged(run, path.parent) for path, run in runs.items()], ignore_index=True)
    groups = [_resolve(group) for _, group in rows.groupby(GROUP, sort=False, dropna=False)]
    merged = pd.concat(groups, ignore_index=True).drop(columns=[FOLDER, CONFIGURATION])
    merged.attrs = {MERGED: [str(path.parent) for path in runs], REPEATED: len(rows) - len(merged)}
    return merged


def read_trials(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The table in a `trials.parquet`; InputError if it can't be read or doesn't name its trials."""
    try:
        trials = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError("trials", "a readable parquet file", f"{path} ({reason})") from None
    missing = [name for name in ROW if name not in trials.columns]
    if missing:
        raise InputError("trials", f"columns {', '.join(ROW)}", f"{path} without {', '.join(missing)}")
    return trials


def is_merged(trials: pd.DataFrame) -> bool:
    """Whether the table comes out of a merge rather than out of a study."""
    return MERGED in trials.attrs


def _find(folders: Iterable[str | os.PathLike[str]]) -> dict[Path, pd.DataFrame]:
    """The tables by their path, each once, in the order of the folders and by name below each."""
    found: dict[Path, pd.DataFrame] = {}
    given = [Path(folder) for folder in folders]
    for folder in given:
        if not folder.is_dir():
            raise InputError("folders", "a folder that is there", folder)
        for path in sorted(folder.rglob(TRIALS)):
            trials = read_trials(path)
            if path.parent == folder or not is_merged(trials):
                found.setdefault(path.resolve(), trials)
    if not found:
        raise InputError("folders", f"a {TRIALS} in or below them", ", ".join(map(str, given)) or "no folder")
    return found


def _tagged(trials: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """The rows of one run with the folder and the configuration they came from; "" where that is unknown."""
    config = folder / ".hydra" / "config.yaml"
    known = config.read_text(encoding="utf-8") if config.is_file() else ""
    return trials.assign(**{FOLDER: folder.as_posix(), CONFIGURATION: known})


def _resolve(group: pd.DataFrame) -> pd.DataFrame:
    """The rows of one (scenario, model, solver) without repetitions, labelled where runs disagree."""
    content = [name for name in group.columns if name not in MEASURED | {FOLDER, CONFIGURATION}]
    rows = group.drop_duplicates(content)
    disputed = rows[rows.duplicated(ROW, keep=False)]
    if disputed.empty:
        return rows
    # Labelled as a whole: left under the bare name, a run's other rows would pass for all there is.
    rows = group.drop_duplicates([*content, CONFIGURATION])
    same = rows[rows.duplicated([*ROW, CONFIGURATION], keep=False)]
    if len(same) or (disputed[CONFIGURATION] == "").any():
        raise _dispute(disputed if same.empty else same, content)
    labels = _labels(rows.drop_duplicates(CONFIGURATION).set_index(CONFIGURATION)[FOLDER])
    return rows.assign(solver=rows["solver"] + " [" + rows[CONFIGURATION].map(labels) + "]")


def _labels(folders: pd.Series) -> dict[str, str]:
    """A short name for each configuration: its folder, without what the folders have in common."""
    common = os.path.commonpath(folders.tolist())
    names = folders.map(lambda folder: Path(folder).name if folder == common else os.path.relpath(folder, common))
    return names.to_dict()


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
