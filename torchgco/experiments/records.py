"""The files of a study: shards while it runs, tables and arrays when it is done.

Every file is written beside its place and then moved there, so that a study killed at any moment leaves whole files,
and a second start goes on from them.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from torchgco.scenarios import Layouts
from torchgco.shapes import InputError

COLUMNS = (
    "scenario", "layout", "seed", "model", "solver", "status", "feasible", "reached", "success", "cost", "best_cost",
    "violation", "clearance", "clearance_knots", "goal_distance", "dynamics_residual", "clearance_full",
    "bound_violation", "kkt_residual", "iterations", "outer_iterations", "guided", "seconds", "batch_size", "threads",
    "device", "dtype", "version",
)  # fmt: skip


def write(path: Path, save: Callable[[IO[bytes]], Any]) -> None:
    """`save(file)` beside the place, fsync, then move: nobody sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        save(file)
        file.flush()
        os.fsync(file.fileno())
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)


@dataclass(frozen=True)
class Records:
    """One study's folder."""

    folder: Path

    def claim(self, configuration: dict[str, Any], layouts: Layouts) -> None:
        """Make the folder this study's, or raise where it holds another's.

        Raises:
            InputError: results of another configuration or of other layouts lie there.
        """
        described = {"configuration": configuration, "layouts": digest(layouts)}
        mark = self.folder / "study.json"
        if mark.is_file():
            held = json.loads(mark.read_text())
            if held != json.loads(json.dumps(described)):
                raise InputError(
                    "hydra.run.dir", "an empty folder, or one of this very study",
                    f"{self.folder}, which holds another ({_difference(held, described)})",
                )  # fmt: skip
        elif (self.folder / "trials.parquet").exists():
            raise InputError("hydra.run.dir", "an empty folder", f"{self.folder}, which holds trials")
        write(mark, lambda file: file.write(json.dumps(described, indent=1).encode()))

    def finished(self) -> bool:
        """Whether all files of the study are there already."""
        return (self.folder / "done").is_file()

    def shard(self, solver: str, start: int) -> Path:
        """Where the rows of one batch of one solver belong."""
        return self.folder / "shards" / f"{solver}-{start:06d}.npz"

    def write_shard(self, path: Path, rows: pd.DataFrame, U: np.ndarray) -> None:
        """Keep what a batch gave: its rows and its controls."""
        # JSON by way of Python floats keeps every bit, NaN and infinity included.
        columns = json.dumps(rows.to_dict(orient="list"), default=lambda value: value.item())
        write(path, lambda file: np.savez_compressed(file, U=U, rows=np.array(columns)))

    @staticmethod
    def read_shard(path: Path) -> tuple[pd.DataFrame, np.ndarray]:
        """What `write_shard` kept."""
        with np.load(path, allow_pickle=False) as held:
            return pd.DataFrame(json.loads(str(held["rows"]))), held["U"]

    def finish(self, trials: pd.DataFrame, U: np.ndarray, solvers: Sequence[str], layouts: Layouts) -> None:
        """Write trials.parquet, solutions.npz and layouts.npz; the shards have served."""
        write(self.folder / "trials.parquet", lambda file: trials.to_parquet(file, index=False))
        write(
            self.folder / "solutions.npz",
            lambda file: np.savez_compressed(file, U=U, solver=np.array(list(solvers)), layout=layouts.ids),
        )
        layouts.save(self.folder / "layouts.npz")

    def close(self) -> None:
        """Mark the study as done and drop its shards."""
        write(self.folder / "done", lambda file: file.write(b""))
        shutil.rmtree(self.folder / "shards", ignore_errors=True)


def digest(layouts: Layouts) -> str:
    """A hash of what is flown: a changed file under the same name is another study, a lower best cost in it isn't."""
    total = sha256()
    for name, array in sorted(replace(layouts, best_cost=None).arrays().items()):
        total.update(f"{name}{array.shape}{array.dtype}".encode() + np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def _difference(held: Any, new: Any, path: str = "") -> str:
    """The first key where two configurations part, as 'key is this there and that here'."""
    if isinstance(held, dict) and isinstance(new, dict):
        for key in sorted({*held, *new}, key=str):
            if held.get(key) != new.get(key):
                return _difference(held.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    return f"{path.removeprefix('configuration.')} is {held} there, {new} here"
