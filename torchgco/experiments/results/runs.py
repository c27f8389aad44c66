"""The runs below some folders, finished or not, as `torchgco-report` finds them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.files import damaged
from torchgco.experiments.results.folder import (
    COLUMNS,
    DONE,
    MANIFEST,
    TRIALS,
    StudyFolder,
    read_manifest,
    read_trials,
    table_of,
    with_success,
)
from torchgco.experiments.results.identity import Manifest
from torchgco.experiments.results.limits import read_layouts
from torchgco.experiments.statistics.statistics import PAIR
from torchgco.scenarios import LayoutFile, Layouts

MERGED = "merged_from"  # in the attributes of a merged table: the folders it came from
ROW = [*PAIR, "solver"]
DIGESTS = ("layout_digest", "settings_digest")


@dataclass(frozen=True)
class Run:
    """One table of trials with its known origin.

    Args:
        configuration: of the study; empty for a table alone, without study.json.
        solvers: resolved settings by name; empty likewise.
        planned: trials of the whole study where it isn't finished; None where it is.
    """

    folder: Path
    trials: pd.DataFrame
    configuration: dict[str, Any]
    solvers: dict[str, Any]
    planned: int | None = None


def find_runs(folders: Iterable[str | os.PathLike[str]], trust: bool = False) -> list[Run]:
    """The runs in and below `folders`, each once, in the order of the folders and by name below each.

    Tables that a merge wrote are passed over below a folder, and read where the folder itself is given. The trials of
    an unfinished study come from its shards; their success is provisional.

    Raises:
        InputError: a missing folder, folders without trials, a damaged file, a table that is no study's, without
            `trust` one that takes more memory than a run's file may.
    """
    paths = [Path(folder) for folder in folders]
    studies = below(paths, TRIALS, MANIFEST).values()
    runs = [run for folder in studies if (run := _run(folder, folder in paths, trust)) is not None]
    if not runs:
        raise InputError("folders", f"a {TRIALS} in or below them", ", ".join(map(str, paths)) or "no folder")
    return runs


def is_merged(path: Path) -> bool:
    """Whether a table comes out of a merge rather than out of a study. Raises InputError if it can't be read."""
    return MERGED in table_of(path, trust=True, columns=[]).attrs


def below(folders: Sequence[Path], *names: str) -> dict[Path, Path]:
    """The folders in and below some, with one of these files: as they were found, by their resolved paths.

    Raises:
        InputError: one of the folders is missing.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError("folders", "an existing folder", folder)
    groups = (sorted({path.parent for name in names for path in folder.rglob(name)}) for folder in folders)
    return {folder.resolve(): folder for group in groups for folder in group}


def _run(folder: Path, explicit: bool, trust: bool) -> Run | None:
    """The run in a folder; None for a table that a merge wrote, unless the folder itself was given."""
    if (folder / TRIALS).is_file():
        trials = read_trials(folder / TRIALS, trust)
        if MERGED in trials.attrs and not explicit:
            return None
        if not (folder / MANIFEST).is_file():
            return Run(folder, trials, {}, {})
        manifest = read_manifest(folder / MANIFEST)
        return Run(folder, trials, manifest.configuration, manifest.solvers)
    manifest = read_manifest(folder / MANIFEST)
    if (folder / DONE).is_file():
        raise damaged(folder / TRIALS, "is missing")
    study = StudyFolder(folder, manifest)
    parts = [rows for name in manifest.solvers if len(rows := study.flown(name)[0])]
    trials = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(COLUMNS))
    if parts:
        rivals = 1 if manifest.configuration.get("mission") is not None else len(parts)
        trials = with_success(trials, _layouts(manifest), rivals)
    planned = len(manifest.layouts) * len(manifest.solvers)
    return Run(folder, trials, manifest.configuration, manifest.solvers, planned)


def _layouts(manifest: Manifest) -> Layouts | None:
    """The layouts of a study's file, for their best costs; None where there is none, or it has moved."""
    scenario = manifest.configuration.get("scenario") or {}
    path = scenario.get("path")
    of_layouts = scenario.get("_target_") == f"{LayoutFile.__module__}.{LayoutFile.__qualname__}"
    return read_layouts(Path(path)) if of_layouts and isinstance(path, str) and Path(path).is_file() else None
