"""Missions of a finished study on its page: tracks, plans, and what vehicles with a sensor saw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.base.memory import limited
from torchgco.experiments.flying.progress import page_bar
from torchgco.experiments.reports.finished import Study, document_of
from torchgco.experiments.results.folder import PLANS_FILE
from torchgco.experiments.results.limits import LARGEST_FILE
from torchgco.exploration.replay import replayed
from torchgco.judging.contact import contacts
from torchgco.missions import Mission
from torchgco.missions.tables import STATES
from torchgco.native.compiler import NativeError
from torchgco.plotting.course import DRAWN_STATES
from torchgco.problem.problem import Problem
from torchgco.view.document import Document, SearchPart
from torchgco.view.flights import Rows, ShownFlight, whole
from torchgco.view.sensed import Sensed
from torchgco.view.vehicles import Look

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
    return ShownFlight(
        solver, path, QUADROTOR.attitude(X), "reached" if row["reached"] is True else "failed", _told(row), bad,
        np.where(bad > 0, index, -1), contacts(problem.obstacles, path, float(problem.dynamics.dt), X),
        notes=_notes(steps)[: len(path)],
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
