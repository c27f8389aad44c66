"""A finished study as its page reads it: what was flown, and missions with tracks, plans and what a sensor saw."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.memory import limited
from torchgco.constraints.gates import gates_of
from torchgco.experiments.config.build import mission_from, solver_from, vehicle_of
from torchgco.experiments.flying.progress import page_bar
from torchgco.experiments.results.durations import times_at
from torchgco.experiments.results.files import damaged, readable
from torchgco.experiments.results.folder import (
    DONE,
    LAYOUTS,
    MANIFEST,
    MISSION,
    PLANS_FILE,
    SOLUTIONS,
    TIME_STEPS,
    TRIALS,
    read_manifest,
    read_trials,
)
from torchgco.experiments.results.identity import Manifest
from torchgco.experiments.results.limits import LARGEST_FILE, check_stages, read_layouts, read_log, read_npz, read_table
from torchgco.exploration.mission import replayed
from torchgco.judging.contact import contacts
from torchgco.judging.gates import crossings, through_balls
from torchgco.missions import Mission
from torchgco.missions.outcome import STATES
from torchgco.native.compiler import NativeError
from torchgco.plotting.course import DRAWN_STATES
from torchgco.problem.problem import Problem
from torchgco.scenarios import Layouts, Task, Vehicle
from torchgco.view.document import Document, Rows, SearchPart, ShownFlight, whole
from torchgco.view.sensed import Sensed
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


QUADROTOR = Look("quadrotor", quaternion=slice(6, 10))  # the plant
SLOW_MAP = 100  # control periods from which on a bar shows how far a map is


def missions(study: Study, searched: Mapping[int, SearchPart]) -> Document:
    """Flights in closed loop: the track at the control steps and, where few missions were flown, plans and maps.

    Args:
        searched: searches of first plans by the numbers of their missions.
    """
    log, document = _Log.read(study), None
    for places, task in study.tasks():
        problem = task.problem
        document = document or document_of(study, problem, QUADROTOR)
        for b, number in enumerate(study.layouts.ids[places].tolist()):
            single = problem.take(torch.tensor([b]))
            flights = [log.flight(study, single, name, number, document.notes) for name in document.solvers]
            flown = [flight for flight in flights if flight is not None]
            document.add(f"mission {number}", problem, b, flown, searched.get(number))
    assert document is not None
    return document


@dataclass(frozen=True)
class _Log:
    """What a study kept of its missions.

    Args:
        steps: rows of mission.parquet by solver and mission.
        rows: of the table, likewise.
        plans: positions (K, N+1, 3), m, likewise, of few missions.
        loops: by solver, where few missions were flown with a sensor.
    """

    steps: Mapping[tuple[str, int], pd.DataFrame]
    rows: Mapping[tuple[str, int], Mapping[str, Any]]
    plans: Mapping[tuple[str, int], np.ndarray]
    loops: Mapping[str, Mission]
    missing: str = ""  # why there are no loops

    @classmethod
    def read(cls, study: Study) -> _Log:
        steps = dict(iter(study.log.groupby(["solver", "mission"], sort=False)))
        stored = study.flown(PLANS_FILE, "plan") if (study.folder / PLANS_FILE).is_file() else {}
        numbers, loops, missing = study.layouts.ids.tolist(), dict[str, Mission](), ""
        plans = {(name, i): plan for name, plans in stored.items() for i, plan in zip(numbers, plans, strict=True)}
        if study.manifest.configuration["mission"].get("sensor", "full") != "full":
            try:
                loops = {name: study.mission(name) for name in stored}
            except InputError as error:  # an option that another version knew
                missing = f"no map: {error}"
        return cls(steps, study.rows, plans, loops, missing)  # type: ignore[arg-type]

    def flight(self, study: Study, problem: Problem, solver: str, number: int, notes: list[str]) -> ShownFlight | None:
        """The flight of a mission, the problem of which is given; None without a finite state."""
        key = solver, number
        steps, plan, loop = self.steps.get(key), self.plans.get(key), self.loops.get(solver)
        if steps is None or not len(steps):
            return None
        flight = _flight(problem, solver, steps, self.rows[key])
        if not len(flight.path):
            return None
        plan = None if plan is None else plan[: len(steps)]
        notes += [self.missing] if self.missing and self.missing not in notes else []
        if plan is None or loop is None:
            return replace(flight, plan=None if plan is None else plan[: len(flight.path)])
        x = torch.tensor(steps[[f"x{i}" for i in range(STATES)]].to_numpy(dtype=float))
        try:
            with limited(math.inf if study.trust else LARGEST_FILE), page_bar(len(x), SLOW_MAP, "period", "map") as bar:
                seen, sought = replayed(loop, problem, x, study.seed, number, bar.update)
        except (NativeError, MemoryError) as error:  # a map of any size can be asked for
            notes += [] if notes else [f"no map: {str(error).splitlines()[0]}"]
            return replace(flight, plan=plan[: len(flight.path)])
        safe = steps["safe"].to_numpy() == 1
        return replace(flight, plan=plan[: len(flight.path)], sensed=Sensed(seen, sought, safe))


def _flight(problem: Problem, solver: str, steps: pd.DataFrame, row: Mapping[str, Any]) -> ShownFlight:
    X = whole(steps[list(DRAWN_STATES)].to_numpy(dtype=float))
    path, clear = X[:, :3], steps["clearance"].to_numpy(dtype=float)
    bad = np.where(clear < 0, -clear, 0.0)[: len(path)]
    index = next((i for i, constraint in enumerate(problem.constraints) if constraint in problem.obstacles), -1)
    gates = None if len(path) < 2 else gates_of(problem)
    passed = [] if gates is None else [through_balls(gates.centers, gates.sizes, torch.tensor(path[None]))]
    return ShownFlight(
        solver, path, QUADROTOR.attitude(X), "reached" if row["reached"] is True else "failed", _told(row), bad,
        np.where(bad > 0, index, -1), contacts(problem.obstacles, path, float(problem.dynamics.dt), X),
        crossings(passed), notes=_notes(steps)[: len(path)],
    )  # fmt: skip


def _told(row: Mapping[str, Any]) -> Rows:
    rows: Rows = [("outcome", str(row["outcome"])), ("flight time", f"{row['flight_time']:.2f} s")]
    rows += [("clearance", f"{row['clearance']:.3f} m"), ("from the goal", f"{row['goal_distance']:.2f} m")]
    if row["batch_size"] == 1:  # the divided times of a batch don't decide it
        rows += [("missed deadlines", f"{row['missed_deadlines']:g}")]
    rows += [("kept plans", f"{row['shifted_plans']:g}")]
    if np.isfinite(row.get("gates_passed", np.nan)):
        rows += [("gates passed", f"{row['gates_passed']:g}"), ("farthest from one", f"{row['gate_distance']:.3f} m")]
    share = row.get("safe_share", np.nan)
    return [*rows, ("periods with a safe plan", f"{100 * share:.4g} %")] if np.isfinite(share) else rows


def _notes(steps: pd.DataFrame) -> list[str]:
    clear, violation = steps["clearance"].to_numpy(dtype=float), steps["violation"].to_numpy(dtype=float)
    seconds = (steps["planner_seconds"] + steps["tracker_seconds"]).to_numpy(dtype=float)
    safe = ["" if flag else ", not safe" for flag in steps["safe"] == 1] if "safe" in steps else [""] * len(steps)
    return [
        f"clearance {c:.3f} m; plan: {source}{word}, violation {v:.2g}; {1e3 * s:.0f} ms"
        for c, v, s, source, word in zip(clear, violation, seconds, steps["source"], safe, strict=True)
    ]
