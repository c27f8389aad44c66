"""A finished study, as its page reads it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.experiments.config.build import mission_from, solver_from, vehicle_of
from torchgco.experiments.results.durations import times_at
from torchgco.experiments.results.files import damaged, readable
from torchgco.experiments.results.folder import (
    DONE,
    LAYOUTS,
    MANIFEST,
    MISSION,
    SOLUTIONS,
    TIME_STEPS,
    TRIALS,
    read_manifest,
    read_trials,
)
from torchgco.experiments.results.identity import Manifest
from torchgco.experiments.results.limits import check_stages, read_layouts, read_log, read_npz, read_table
from torchgco.missions import Mission
from torchgco.problem.problem import Problem
from torchgco.scenarios import Layouts, Task, Vehicle
from torchgco.view.document import Document
from torchgco.view.vehicles import Look

MEASURED_AT_ONCE = 64  # layouts whose trajectories are measured at once


@dataclass(frozen=True)
class Study:
    """What a page needs of a finished study.

    Args:
        trust: whether its files may have any size and name any class, whose code runs.
    """

    folder: Path
    manifest: Manifest
    vehicle: Vehicle
    layouts: Layouts
    trials: pd.DataFrame
    trust: bool = False

    @classmethod
    def read(cls, folder: Path, trust: bool = False, changed: bool = False) -> Study:
        """The study in a folder.

        Args:
            changed: whether its table may have been changed since.

        Raises:
            InputError: a folder without a finished study, with damaged files, or without `trust` one whose study.json
                names more than classes of torchgco's own options.
        """
        if not (folder / MANIFEST).is_file():
            raise InputError("RUN", f"the folder of a study, with its {MANIFEST}", folder)
        if not (folder / DONE).is_file():
            raise InputError("RUN", "a finished study (the same command resumes it)", folder)
        manifest = read_manifest(folder / MANIFEST, whole=True)
        vehicle = vehicle_of(manifest.configuration, trust)
        layouts = readable(folder / LAYOUTS, read_layouts, trust=trust)
        path = folder / TRIALS
        trials = readable(path, read_table, trust=trust) if changed else read_trials(path, trust)
        if not trust:
            check_stages(folder, vehicle, layouts, MEASURED_AT_ONCE)
        return cls(folder, manifest, vehicle, layouts, trials, trust)

    def flown(self, name: str, array: str) -> dict[str, np.ndarray]:
        """The numbers (L, ...) of each solver in one of its npz files.

        Raises:
            InputError: the file is damaged, takes more than it may, or has other solvers or layouts.
        """
        arrays = readable(self.folder / name, read_npz, trust=self.trust)
        solvers, ids = list(self.manifest.solvers), self.layouts.ids
        named = {"solver", "layout", array} <= arrays.keys() and arrays["solver"].tolist() == solvers
        if not named or not np.array_equal(arrays["layout"], ids):
            raise damaged(self.folder / name, "has other layouts")
        values = arrays[array]
        if values.shape[:2] != (len(solvers), len(ids)) or values.dtype != np.float64:
            raise damaged(self.folder / name, f"has {array} {values.shape}")
        return dict(zip(solvers, values, strict=True))

    @property
    def log(self) -> pd.DataFrame:
        """The control steps of its missions; InputError where the file is damaged, or takes more than it may."""
        return readable(self.folder / MISSION, read_log, trust=self.trust)

    @property
    def time_steps(self) -> pd.DataFrame | None:
        """The time steps of its plant, of few missions; None where it kept none. InputError as `log`."""
        path = self.folder / TIME_STEPS
        return readable(path, read_table, trust=self.trust) if path.is_file() else None

    @property
    def missions(self) -> bool:
        return self.manifest.configuration.get("mission") is not None

    @property
    def seed(self) -> int:
        return self.manifest.configuration["seed"]

    @property
    def rows(self) -> Mapping[tuple[str, int], Mapping[str, Any]]:
        """The rows of the table by solver and layout."""
        return {(row["solver"], row["layout"]): row for row in self.trials.to_dict("records")}  # type: ignore[misc]

    def tasks(self) -> Iterator[tuple[np.ndarray, Task]]:
        """The places of some layouts at a time, and what is flown there."""
        for places in self.layouts.together(MEASURED_AT_ONCE):
            yield places, self.vehicle.task(self.layouts.take(places))

    @cached_property
    def controls(self) -> dict[str, np.ndarray]:
        """The controls (L, N, m) of each solver; errors as `flown`."""
        return self.flown(SOLUTIONS, "U")

    @cached_property
    def times(self) -> dict[str, np.ndarray] | None:
        """The times (L, N+1) of the knots by solver, s, where the time is free; else None."""
        return None if self.layouts.free_time is None else self.flown(SOLUTIONS, "times")

    def flight(self, name: str, places: np.ndarray, N: int) -> tuple[Tensor, Tensor | None]:
        """A solver's controls (B, N, m) of some layouts, and the times (B, N+1) of the knots, s, where free."""
        t = times_at(None if self.times is None else self.times[name], places, N)
        return torch.from_numpy(self.controls[name][places, :N]), t

    def mission(self, solver: str) -> Mission:
        """The closed loop of a study of missions, as a solver's name flew it."""
        return mission_from(self.manifest.configuration, self.solver(solver), self.trust)

    def solver(self, name: str) -> Any:
        """A solver of the study as it flew."""
        return solver_from(self.manifest.solvers[name], self.trust)


def document_of(study: Study, problem: Problem, look: Look) -> Document:
    """The page of a study in the making, from the problems of some of its layouts."""
    solvers, dt = list(study.manifest.solvers), problem.dynamics.dt
    count = f"{study.layouts.count} layouts" if study.layouts.count > 1 else "1 layout"
    return Document.of(
        problem, study.vehicle.radius, title=f"{study.trials['scenario'].iloc[0]}: {', '.join(solvers)}",
        about=f"{count}, {study.vehicle.name}, seed {study.seed}, {problem.N} stages of {dt:g} s",
        dt=float(dt), look=look, solvers=solvers, mission=study.missions,
    )  # fmt: skip
