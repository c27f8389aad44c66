"""The folder of a study: shards while it runs, tables and arrays when it is done, and the success of its trials.

Every file is moved to its place whole (`files.write`), so that a study killed at any moment leaves whole files and a
second start resumes from them. Files are checked against the study's manifest when they are read again: a damaged or
foreign file is named in an error, and redone with `study.repair=true`.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError, first_line
from torchgco.base.files import PART, regular
from torchgco.experiments.results.durations import parted
from torchgco.experiments.results.files import checksum, create, damaged, readable, write
from torchgco.experiments.results.identity import Manifest, difference
from torchgco.experiments.results.limits import read_npz, read_table
from torchgco.experiments.statistics.statistics import check_trials
from torchgco.judging.judge import near_best
from torchgco.scenarios import Layouts

COLUMNS = (
    "scenario", "layout", "seed", "model", "solver", "status", "feasible", "reached", "success", "clear_95", "cost",
    "best_cost", "violation", "clearance", "clearance_knots", "goal_distance", "dynamics_residual", "clearance_full",
    "bound_violation", "kkt_residual", "step_error", "step_cost", "iterations", "outer_iterations", "guided", "seconds",
    "batch_size", "threads", "device", "dtype", "kernels", "version", "best_from", "layout_digest", "settings_digest",
)  # fmt: skip
JUDGED = ("success", "best_cost", "best_from")  # columns that compare rows: not in shards
MANIFEST, TRIALS, SOLUTIONS, LAYOUTS, DONE = "study.json", "trials.parquet", "solutions.npz", "layouts.npz", "done"
MISSION = "mission.parquet"  # in place of solutions, where missions are flown
# Where few missions fly: planned positions (solver, L, K, N+1, 3), and a row per time step of the plant.
PLANS_FILE, TIME_STEPS = "plans.npz", "time_steps.parquet"
Flown = tuple[pd.DataFrame, np.ndarray]  # rows without the judged columns, controls (rows, N, m)
Save = Callable[[IO[bytes]], Any]


@dataclass(frozen=True)
class StudyFolder:
    """One study's folder; with `repair`, damaged files are dropped and redone."""

    path: Path
    manifest: Manifest
    repair: bool = False

    @property
    def files(self) -> tuple[str, str, str]:
        """The files of the finished study, which are kept under their checksums."""
        missions = self.manifest.configuration.get("mission") is not None
        return TRIALS, MISSION if missions else SOLUTIONS, LAYOUTS

    def claim(self) -> None:
        """Make the folder this study's, or raise and leave it as it is.

        Raises:
            InputError: results of another study lie there, or the study's manifest is damaged or missing.
        """
        path = self.path / MANIFEST
        orphaned = self._has_rows()
        there = path.is_file()  # looked at after the results, which another job of the study may be writing
        if there and self._claimed(path):
            return
        if orphaned and not there and not self.repair:
            raise damaged(path, "is missing")
        self._refuse_foreign()
        if there:
            write(path, lambda file: file.write(self.manifest.to_json()))
        elif not create(path, lambda file: file.write(self.manifest.to_json())):
            self._claimed(path)  # by another job meanwhile

    def free(self) -> None:
        """Leave the folder to any other study, where this one has claimed it and nothing is flown.

        Raises:
            InputError: the study's manifest is damaged or missing, or another's.
        """
        if not self._has_rows() and self._claimed(self.path / MANIFEST):
            for path in (self.path / MANIFEST, *self.path.glob("run*.json"), *self.path.glob(".hydra/*.yaml")):
                path.unlink(missing_ok=True)
            with suppress(OSError):  # not there, or with files of somebody else
                (self.path / ".hydra").rmdir()

    def _has_rows(self) -> bool:
        return (self.path / TRIALS).is_file() or any(self.path.glob("shards/*.npz"))

    def _claimed(self, path: Path) -> bool:
        """Whether study.json is this study's; False where it is damaged and to be repaired."""
        try:
            stored = read_manifest(path)
        except InputError:
            if not self.repair:
                raise
            return False
        if stored.identity() != self.manifest.identity():
            raise self._another(f"({difference(stored.identity(), self.manifest.identity())})")
        return True

    def finished(self, layouts: Layouts) -> bool:
        """Whether all files of the study are present and undamaged.

        Raises:
            InputError: a file is damaged or missing. With `repair`, `layouts.npz` is written again, and for any other
                file the study counts as unfinished.
        """
        mark = self.path / DONE
        if not mark.is_file():
            return False
        for file in self._changed():
            if not self.repair:
                raise damaged(file, "is damaged" if file.is_file() else "is missing")
            if file.name != LAYOUTS:
                mark.unlink(missing_ok=True)  # another job may be repairing, too
                return False
            write(file, _arrays(layouts.arrays()))
            self.close()
        return True

    def verify(self) -> None:
        """Raise InputError where a file of the finished study isn't as the study wrote it."""
        for file in self._changed():
            raise damaged(file, "isn't as the study wrote it")

    def table(self) -> pd.DataFrame:
        """The trials of the finished study; InputError as `read_trials`."""
        return read_trials(self.path / TRIALS, trust=True)

    def _changed(self) -> Iterator[Path]:
        """The files of the finished study that aren't there as it wrote them."""
        for name, sums in (self._checksums() or {TRIALS: []}).items():
            file = self.path / name
            if not file.is_file() or checksum(file) not in sums:
                yield file

    def missing(self, solver: str) -> list[int]:
        """Ids of the layouts that a solver hasn't flown.

        Raises:
            InputError: a shard is damaged or isn't of this study; with `repair` it is removed.
        """
        left = dict.fromkeys(self.manifest.layouts)
        for path in self._shards(solver):
            try:
                rows, _ = self._read(path, solver)
            except InputError:
                if not path.is_file():  # the study was finished, or the shard repaired, by another process
                    continue
                if not self.repair:
                    raise
                path.unlink(missing_ok=True)
            else:
                for number in rows["layout"]:
                    left.pop(number, None)
        return list(left)

    def keep(self, solver: str, flown: Flown) -> None:
        """Write the results of a batch of consecutive layouts as a shard, named by solver, first and last layout."""
        rows, U = flown
        numbers = rows["layout"].tolist()
        rows = rows.assign(
            layout_digest=[self.manifest.layouts[number] for number in numbers],
            settings_digest=self.manifest.settings[solver],
        )
        # JSON by way of Python floats keeps every bit, NaN and infinity included.
        columns = json.dumps(rows.to_dict(orient="list"), default=lambda value: value.item())
        path = self.path / "shards" / f"{solver}-{numbers[0]:06d}-{numbers[-1]:06d}.npz"
        # Not compressed: controls hardly shrink, and a shard is dropped when the study is done.
        write(path, lambda file: np.savez(file, U=U, rows=np.array(columns)))

    def flown(self, solver: str) -> Flown:
        """All results of a solver that `keep` wrote, in the order of the layouts.

        Raises:
            InputError: a shard is damaged or isn't of this study.
        """
        shards = [self._read(path, solver) for path in self._shards(solver)]
        if not shards:
            return pd.DataFrame(columns=[name for name in COLUMNS if name not in JUDGED]), np.empty((0, 0, 0))
        rows = pd.concat([rows for rows, _ in shards], ignore_index=True)
        rank = {number: i for i, number in enumerate(self.manifest.layouts)}
        order = rows["layout"].map(rank).drop_duplicates().sort_values().index
        return rows.loc[order].reset_index(drop=True), np.concatenate([U for _, U in shards])[order.to_numpy()]

    def finish(self, trials: pd.DataFrame, flown: np.ndarray | pd.DataFrame, layouts: Layouts) -> None:
        """Write trials.parquet, layouts.npz, and solutions.npz from controls or mission.parquet from a table.

        Where the time is free the last of the controls is the length of each stage.
        """
        solvers = np.array(list(self.manifest.solvers))
        write(self.path / TRIALS, _table(trials))
        if isinstance(flown, pd.DataFrame):
            write(self.path / MISSION, _table(flown))
        else:
            arrays = {"U": flown} if layouts.free_time is None else parted(flown)
            write(self.path / SOLUTIONS, _arrays({**arrays, "solver": solvers, "layout": layouts.ids}))
        write(self.path / LAYOUTS, _arrays(layouts.arrays()))

    def replace(self, trials: pd.DataFrame, layouts: Layouts) -> None:
        """Put other trials and layouts in the place of a finished study's."""
        new = {TRIALS: _bytes(_table(trials)), LAYOUTS: _bytes(_arrays(layouts.arrays()))}
        # Old and new content both count as whole until `close`: a stop in between damages nothing.
        sums = self._checksums()
        both = {name: [*codes, sha256(new[name]).hexdigest()] if name in new else codes for name, codes in sums.items()}
        write(self.path / DONE, _json(both))
        for name, content in new.items():
            write(self.path / name, lambda file, content=content: file.write(content))

    def close(self) -> None:
        """Mark the study as done, with the checksums of its files, and drop its shards."""
        write(self.path / DONE, _json({name: [checksum(self.path / name)] for name in self.files}))
        self.drop_shards()
        for path in self.path.glob(f"{PART[0]}*{PART[1]}"):  # of a start that was killed while it wrote
            path.unlink(missing_ok=True)

    def drop_shards(self) -> None:
        """Remove the shards of a study that is done."""
        shutil.rmtree(self.path / "shards", ignore_errors=True)

    def _shards(self, solver: str) -> list[Path]:
        name = re.compile(rf"{re.escape(solver)}-\d+-\d+\.npz")
        return sorted(path for path in self.path.glob("shards/*.npz") if name.fullmatch(path.name))

    def _read(self, path: Path, solver: str) -> Flown:
        """A shard's rows and controls; InputError where it is damaged, or doesn't match its name or the study."""
        rows, U = read_shard(path)
        first, last = map(int, path.stem.split("-")[-2:])
        numbers = list(range(first, last + 1))
        if rows["layout"].tolist() != numbers or not set(numbers) <= self.manifest.layouts.keys():
            raise damaged(path, f"holds layouts {rows['layout'].tolist()}")
        wanted = {"solver": solver, "settings_digest": self.manifest.settings[solver], **self.manifest.constants}
        wanted |= {"layout_digest": [self.manifest.layouts[number] for number in numbers]}
        for name, value in wanted.items():
            if not (rows[name] == value).all():
                raise damaged(path, f"is of another study (column {name})")
        return rows, U

    def _checksums(self) -> dict[str, list[str]]:
        """The valid checksums of each file; with `repair`, an empty dict if they can't be read."""
        try:
            sums = read_checksums(self.path / DONE)
            if sums.keys() != set(self.files):
                raise damaged(self.path / DONE, "is damaged (it doesn't name all files)")
        except InputError:
            if not self.repair:
                raise
            return {}
        return sums

    def _refuse_foreign(self) -> None:
        """Raise where a readable file in the folder is of another study than the manifest to be written."""
        wanted = self.manifest.settings
        for path in [self.path / TRIALS, *self.path.glob("shards/*.npz")]:
            try:
                rows = read_table(path) if path.name == TRIALS else read_shard(path)[0]
            except Exception:  # unreadable: to be redone
                continue
            allowed = {"solver": wanted.keys(), "settings_digest": wanted.values()}
            allowed |= {name: [value] for name, value in self.manifest.constants.items()}
            for name, values in {**allowed, "layout_digest": self.manifest.layouts.values()}.items():
                if name not in rows.columns or not set(rows[name]) <= set(values):
                    raise self._another(f"(column {name} of {path.name})")

    def _another(self, which: str) -> InputError:
        return InputError(
            "hydra.run.dir", "an empty folder, or one of this very study", f"{self.path}, which holds another {which}"
        )


def read_manifest(path: Path, whole: bool = False) -> Manifest:
    """The manifest in a study.json; InputError where it is damaged, with `whole` also where a group is missing."""

    def read(path: Path) -> Manifest:
        manifest = Manifest.from_json(regular(path).read_bytes())
        if whole:
            manifest.check_whole()
        return manifest

    return readable(path, read)


def read_checksums(path: Path) -> dict[str, list[str]]:
    """The valid checksums of each file of a finished study; InputError where its mark is damaged."""

    def read(path: Path) -> dict[str, list[str]]:
        sums = json.loads(regular(path).read_bytes())
        if not all(isinstance(digests, list) for digests in sums.values()):
            raise ValueError("no checksums")
        return sums

    return readable(path, read)


def read_shard(path: Path) -> Flown:
    """The rows and controls in a shard; InputError where it can't be read."""

    def read(path: Path) -> Flown:
        arrays = read_npz(path)
        rows, U = pd.DataFrame(json.loads(str(arrays["rows"]))), arrays["U"]
        absent = set(COLUMNS) - {*JUDGED, *rows.columns}
        if absent or U.ndim != 3 or len(U) != len(rows):
            raise ValueError(f"{len(rows)} rows, controls {U.shape}, no {', '.join(sorted(absent)) or 'more'}")
        return rows, U

    return readable(path, read, sized=False)


def read_trials(path: str | os.PathLike[str], trust: bool = False) -> pd.DataFrame:
    """The table in a `trials.parquet`.

    Raises:
        InputError: it can't be read, lacks columns of a study, isn't as the study left it, or without `trust` takes
            more memory than a run's file may.
    """
    mark = Path(path).parent / DONE
    sums = read_checksums(mark).get(TRIALS, []) if mark.is_file() else []
    if sums and Path(path).is_file() and checksum(Path(path)) not in sums:
        raise damaged(Path(path), "isn't as the study wrote it")
    trials = table_of(path, trust)
    missing = [name for name in COLUMNS if name not in trials.columns]
    if missing:
        raise InputError("trials", "the columns of a study", f"{path} without {', '.join(missing)}")
    check_trials(trials, path)
    return trials


def table_of(path: str | os.PathLike[str], trust: bool, **options: Any) -> pd.DataFrame:
    """A table of trials, of a study or merged; InputError where it can't be read or takes more than it may."""
    try:
        return read_table(Path(path), trust, **options)
    except InputError:
        raise
    except Exception as error:  # damaged bytes make the reader raise nearly anything
        raise InputError("trials", "a readable parquet file", f"{path} ({first_line(error)})") from None


def _table(trials: pd.DataFrame) -> Save:
    return lambda file: trials.to_parquet(file, index=False)


def _arrays(arrays: Mapping[str, np.ndarray]) -> Save:
    return lambda file: np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _json(content: Mapping[str, Sequence[str]]) -> Save:
    return lambda file: file.write(json.dumps(content, indent=1).encode())


def _bytes(save: Save) -> bytes:
    buffer = io.BytesIO()
    save(buffer)
    return buffer.getvalue()


def judged(rows: pd.DataFrame, best: pd.Series, rivals: pd.Series, layout: Sequence[str]) -> pd.DataFrame:
    """The rows with `best_cost`, `best_from` ("file" or "study") and `success`.

    Args:
        rows: with columns cost and reached.
        best: best cost of the layout's file, by row; NaN where there is none.
        rivals: by row, whether several solvers flew the layout; then the cheapest that reached replaces a missing
            `best`.
        layout: columns that name a layout.

    Where no best cost is known (a single solver, none in the file) success is NA.
    """
    reached = rows["reached"].astype(bool)
    cheapest = rows.assign(_cost=rows["cost"].where(reached)).groupby(list(layout), dropna=False)["_cost"]
    filled = best.where(best.notna() | ~rivals, cheapest.transform("min")).astype(float)
    source = pd.Series(None, index=rows.index, dtype=object).mask(rivals, "study").mask(best.notna(), "file")
    success = (reached & near_best(rows["cost"], filled)).astype("boolean")
    return rows.assign(best_cost=filled, success=success.where(source.notna(), pd.NA), best_from=source)


def with_success(rows: pd.DataFrame, layouts: Layouts | None, solvers: int) -> pd.DataFrame:
    """The rows of a study in its columns, with `best_cost` and `success`.

    The best cost is that of the layouts' file, else the best of the study where at least two solvers flew.
    """
    best = pd.Series(np.nan, index=rows.index)
    if layouts is not None and layouts.best_cost is not None:
        best = rows["layout"].map(dict(zip(layouts.ids.tolist(), layouts.best_cost, strict=True))).astype(float)
    rivals = pd.Series(solvers > 1, index=rows.index)
    more = [name for name in rows.columns if name not in COLUMNS]
    return judged(rows, best, rivals, ["layout"]).reindex(columns=[*COLUMNS, *more])
