"""`torchgco-view RUN`: a page of a finished study, which one turns around; see docs/view.md."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.experiments.config.build import vehicle_of
from torchgco.experiments.ending import ended, say
from torchgco.experiments.reports.mission_report import PLANS
from torchgco.experiments.results.files import damaged, write
from torchgco.experiments.results.identity import Manifest
from torchgco.experiments.results.records import DONE, LAYOUTS, MANIFEST, MISSION, SOLUTIONS, TRIALS, read_manifest
from torchgco.experiments.results.runs import read_trials
from torchgco.judging.judge import OTHERS_WITHIN
from torchgco.lagrangian.rollout import open_loop
from torchgco.problem.problem import Problem
from torchgco.scenarios import Layouts, Vehicle
from torchgco.view.document import Document
from torchgco.view.flights import Flight, Rows, contacts, flights_of, whole
from torchgco.view.notebook import constraint_name
from torchgco.view.page import page
from torchgco.view.vehicles import Look, look_of

NAME = "view.html"
BATCH = 64  # layouts whose trajectories are measured at once
QUADROTOR = Look("quadrotor", quaternion=slice(6, 10))  # of a mission's plant


@dataclass(frozen=True)
class Study:
    """What a page needs of a finished study."""

    folder: Path
    manifest: Manifest
    vehicle: Vehicle
    layouts: Layouts
    trials: pd.DataFrame

    @classmethod
    def read(cls, folder: Path) -> Study:
        """The study in a folder.

        Raises:
            InputError: a folder without a finished study, or with damaged files.
        """
        if not (folder / MANIFEST).is_file():
            raise InputError("RUN", f"the folder of a study, with its {MANIFEST}", folder)
        if not (folder / DONE).is_file():
            raise InputError("RUN", "a finished study (the same command resumes it)", folder)
        manifest = read_manifest(folder / MANIFEST)
        layouts, trials = Layouts.load(folder / LAYOUTS), read_trials(folder / TRIALS)
        return cls(folder, manifest, vehicle_of(manifest.configuration), layouts, trials)

    @property
    def missions(self) -> bool:
        return self.manifest.configuration.get("mission") is not None

    def batches(self) -> Iterator[tuple[slice, Problem]]:
        """Problems of some layouts at a time, and their places."""
        for first in range(0, self.layouts.count, BATCH):
            places = slice(first, min(first + BATCH, self.layouts.count))
            yield places, self.vehicle.task(self.layouts.take(range(places.start, places.stop))).problem

    @property
    def rows(self) -> Mapping[tuple[str, int], Mapping[str, Any]]:
        """The rows of the table by solver and layout."""
        return {(row["solver"], row["layout"]): row for row in self.trials.to_dict("records")}  # type: ignore[misc]


def study_page(folder: Path) -> str:
    """The page of a finished study. Raises InputError as `Study.read` does."""
    study = Study.read(folder)
    return page(_missions(study) if study.missions else _trajectories(study))


def _document(study: Study, problem: Problem, look: Look) -> Document:
    solvers, configuration = list(study.manifest.solvers), study.manifest.configuration
    scenario = study.layouts.name if configuration["scenario"].get("path") else configuration["scenario"]["name"]
    at = problem.position
    radius = max((float(part.vehicle_radius.max()) for part in problem.obstacles), default=study.vehicle.radius)
    count = f"{study.layouts.count} layouts" if study.layouts.count > 1 else "1 layout"
    return Document(
        title=f"{scenario}: {', '.join(solvers)}",
        about=f"{count}, {study.vehicle.name}, seed {configuration['seed']}, {problem.N} stages of "
        f"{problem.dynamics.dt:g} s",
        dimension=at.stop - at.start, dt=float(problem.dynamics.dt), look=look, radius=radius, solvers=solvers,
        constraints=[constraint_name(part) for part in problem.constraints], mission=study.missions,
    )  # fmt: skip


def _trajectories(study: Study) -> Document:
    """Single trajectories, rolled out from the controls that the study kept."""
    with np.load(study.folder / SOLUTIONS, allow_pickle=False) as held:
        names, numbers, controls = held["solver"].tolist(), held["layout"].tolist(), held["U"]
    if numbers != study.layouts.ids.tolist():
        raise damaged(study.folder / SOLUTIONS, "has other layouts")
    document, rows = None, study.rows
    for places, problem in study.batches():
        look = look_of(problem.dynamics)
        document = document or _document(study, problem, look)
        ids, flown = study.layouts.ids[places].tolist(), []
        for name in document.solvers:
            U = torch.from_numpy(controls[names.index(name)][places])
            X, here = open_loop(problem.dynamics, problem.x0, U), [rows[name, number] for number in ids]
            touching = np.array([not row["clearance"] >= 0 for row in here])
            said = [result_of(row) for row in here], [told(row) for row in here]
            flown.append(flights_of(problem, look, X, U, name, *said, OTHERS_WITHIN, touching))
        for b, number in enumerate(ids):
            document.add(f"layout {number}", problem, b, [flights[b] for flights in flown if len(flights[b].path)])
    assert document is not None
    return document


def result_of(row: Mapping[str, Any]) -> str:
    """The best that can be said of a row: success, reached, feasible or failed."""
    return next((name for name in ("success", "reached", "feasible") if row[name] is True), "failed")


def told(row: Mapping[str, Any]) -> Rows:
    """What the page says of a trajectory."""
    cost = f"{row['cost']:.6g}"
    if np.isfinite(row["best_cost"]) and row["best_cost"] != 0:
        cost += f" ({row['cost'] / row['best_cost']:.3f} of the best)"
    held: Rows = [("status", str(row["status"])), ("cost", cost)]
    held += [("clearance", f"{row['clearance']:.3f} m")] if np.isfinite(row["clearance"]) else []
    held += [("violation", f"{row['violation']:.2g}"), ("from the goal", f"{row['goal_distance']:.2f} m")]
    return [*held, ("iterations", f"{row['iterations']:g}"), ("time", f"{1e3 * row['seconds']:.3g} ms")]


def _missions(study: Study) -> Document:
    """Flights in closed loop: the track at the control steps and, where few missions were flown, all plans."""
    log = pd.read_parquet(study.folder / MISSION)
    flights = {key: rows for key, rows in log.groupby(["solver", "mission"], sort=False)}
    plans, rows, document = _plans(study), study.rows, None
    for places, problem in study.batches():
        document = document or _document(study, problem, QUADROTOR)
        for b, number in enumerate(study.layouts.ids[places].tolist()):
            held = []
            for name in document.solvers:
                steps = flights.get((name, number))
                if steps is not None and len(steps):
                    plan = plans.get(name)
                    kept = None if plan is None else plan[places.start + b, : len(steps)]
                    held.append(_mission(problem, b, name, steps, rows[name, number], kept))
            document.add(f"mission {number}", problem, b, held)
    assert document is not None
    return document


def _plans(study: Study) -> dict[str, np.ndarray]:
    """Planned positions (L, K, N+1, 3) by solver; none where many missions were flown."""
    if not (study.folder / PLANS).is_file():
        return {}
    with np.load(study.folder / PLANS, allow_pickle=False) as held:
        return dict(zip(held["solver"].tolist(), held["plan"], strict=True))


def _mission(
    problem: Problem, b: int, solver: str, steps: pd.DataFrame, row: Mapping[str, Any], plan: np.ndarray | None
) -> Flight:
    X = whole(steps[[f"x{i}" for i in range(13)]].to_numpy(dtype=float))
    path, part = X[:, :3], problem.take(torch.tensor([b]))
    clear, violation = steps["clearance"].to_numpy(dtype=float), steps["violation"].to_numpy(dtype=float)
    seconds = (steps["planner_seconds"] + steps["tracker_seconds"]).to_numpy(dtype=float)
    notes = [
        f"clearance {c:.3f} m; plan: {source}, violation {v:.2g}; {1e3 * s:.0f} ms"
        for c, v, s, source in zip(clear, violation, seconds, steps["source"], strict=True)
    ]
    held: Rows = [("outcome", str(row["outcome"])), ("flight time", f"{row['flight_time']:.2f} s")]
    held += [("clearance", f"{row['clearance']:.3f} m"), ("from the goal", f"{row['goal_distance']:.2f} m")]
    held += [("missed deadlines", f"{row['missed_deadlines']:g}"), ("kept plans", f"{row['shifted_plans']:g}")]
    bad = np.where(clear < 0, -clear, 0.0)[: len(path)]
    place = next((i for i, one in enumerate(problem.constraints) if one in problem.obstacles), -1)
    return Flight(
        solver, path, QUADROTOR.attitude(X), "reached" if row["reached"] is True else "failed", held, bad,
        np.where(bad > 0, place, -1), contacts(part.obstacles, path, float(problem.dynamics.dt)),
        None if plan is None else plan[: len(path)], notes[: len(path)],
    )  # fmt: skip


class _Parser(argparse.ArgumentParser):
    """Without the usage before an error: one line for every mistake."""

    def error(self, message: str) -> NoReturn:
        raise InputError("command line", "RUN and the options of --help", message)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchgco-view", description="A page of a study, to be turned around: one HTML file.")
    parser.add_argument("run", metavar="RUN", type=Path, help="the folder of a finished study")
    parser.add_argument("--output", metavar="FILE", type=Path, help=f"default: {NAME} in RUN")
    return parser


def write_view(folder: Path, output: Path | None = None) -> Path:
    """Write the page of a finished study; returns where it lies. Raises InputError as `Study.read` does."""
    path = folder / NAME if output is None else output
    if path.is_dir():
        raise InputError("--output", "a file", f"{path}, which is a folder")
    text = study_page(folder)
    write(path, lambda file: file.write(text.encode()))
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-view`. Returns the exit code, see `ended`."""

    def work() -> int:
        options = _parser().parse_args(arguments)
        path = write_view(options.run, options.output)
        say(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        return 0

    return ended("torchgco-view", work)
