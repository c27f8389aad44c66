"""`torchgco-view RUN`: a page of a finished study, and of some layouts their search, solved again; see docs/view.md."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.flying.progress import page_bar
from torchgco.experiments.reports.finished import MEASURED_AT_ONCE, Study, document_of, missions
from torchgco.experiments.results.durations import states_of
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import SOLUTIONS
from torchgco.fleets.drawn import solution_of
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers import AugmentedLagrangian
from torchgco.solvers.contracts import Advice, Guidance
from torchgco.view.document import Document, Rows, SearchPart, flights_of
from torchgco.view.notebook import add_fleets, fleet_document
from torchgco.view.page import page
from torchgco.view.searches import search_of
from torchgco.view.vehicles import look_of


class Guided(NamedTuple):
    """The guide region of a problem after one outer iteration."""

    number: int  # the problem's id
    outer: int  # the outer iteration
    balls: np.ndarray  # (K, d + 1): centres and radii, m, at the guided knots
    sample: np.ndarray  # (N+1, d): the trajectory that the balls lie along, m


@dataclass(frozen=True)
class Watched:
    """Another guidance, whose advice is passed on as it is and noted in `seen`.

    Args:
        guidance: that advises.
        seen: what it advised, in the order of the calls.
    """

    guidance: Guidance
    seen: list[Guided] = field(default_factory=list)

    def suited(self, problem: Problem) -> Self | None:
        suited = self.guidance.suited(problem)
        return None if suited is None else replace(self, guidance=suited)

    def start(self, problem: Problem, X: Tensor) -> GuideRegion | None:
        return self.guidance.start(problem, X)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        advice = self.guidance.update(problem, X, U, penalty, key)
        region = advice.penalty
        if isinstance(region, GuideRegion):
            for row in region.is_active.nonzero().flatten().tolist():
                center, radius = (z[row].detach().cpu().double().numpy() for z in (region.center, region.radius))
                here = np.isfinite(radius)
                balls = np.column_stack((center[here], radius[here]))
                self.seen.append(Guided(int(key.ids[row]), int(key.outer[row]), balls, center))
        return advice


def searches(study: Study, numbers: Sequence[int]) -> dict[int, SearchPart]:
    """What each solver that keeps a record did on the layouts of these numbers, by number; of missions, on first plans.

    Args:
        numbers: ids of some layouts of the study.

    Raises:
        InputError: missions with a sensor, whose search is that for a path on the map.
    """
    by_number: dict[int, SearchPart] = {}
    for name in study.manifest.solvers:
        solver, seen = study.solver(name).recording(), []
        if isinstance(solver, AugmentedLagrangian):
            if solver.guidance is None:
                continue
            watched = Watched(solver.guidance)
            solver, seen = replace(solver, guidance=watched), watched.seen
        for group in _alike(study, numbers):
            problem, solution = _solved(study, group, name, solver)
            for b, number in enumerate(group):
                record = search_of(solution, problem, b) or SearchPart()
                guides = [g for g in seen if g.number == number]
                if record.passes or record.rounds or guides:
                    whole = by_number.setdefault(number, SearchPart())
                    whole.passes.extend(f"{name}: {text}" for text in record.passes)
                    whole.rounds.extend((f"{name}: {text}", lines) for text, lines in record.rounds)
                    whole.guides.extend((f"outer iteration {g.outer}, {name}", g.balls, g.sample) for g in guides)
    return by_number


def _alike(study: Study, numbers: Sequence[int]) -> list[list[int]]:
    """The numbers of layouts that were solved together, as they have as many stages."""
    ids = study.layouts.ids.tolist()
    places = study.layouts.take([ids.index(number) for number in numbers]).alike()
    return [[numbers[i] for i in group] for group in places]


def _solved(study: Study, numbers: Sequence[int], name: str, solver: Any) -> tuple[Problem, Solution]:
    """The problems of the layouts of some numbers, and the solutions; of missions, those of first plans."""
    places = [study.layouts.ids.tolist().index(number) for number in numbers]
    task, ids = study.vehicle.task(study.layouts.take(places)), torch.tensor(numbers)
    if not study.missions:
        return task.problem, solver.solve(task.problem, task.U0, seed=study.seed, ids=ids)
    mission = study.mission(name)
    if not mission.sees_all:
        expected = "missions that know all obstacles; with a sensor the page shows the path sought on the map"
        raise InputError("--search", expected, "missions with a sensor")
    planner = replace(mission.planner, solver=solver)
    return replace(mission, planner=planner).first_plans(task.problem, study.seed, ids)


PAGE_NAME = "view.html"
SLOW_PAGE = 256  # layouts from which on a bar shows how far the page is


def study_page(folder: Path, searched: Sequence[int] = (), trust: bool = False) -> str:
    """The page of a finished study, with the search on the layouts of some numbers, which are solved again.

    Args:
        trust: whether the study's file may name any class, which then runs, or torchgco's own alone.

    Raises:
        InputError: as `Study.read`; a number of no layout, or one of a mission with a sensor.
    """
    study = Study.read(folder, trust)
    missing = sorted(set(searched) - set(study.layouts.ids.tolist()))
    if missing:
        raise InputError("--search", "numbers of layouts of the study", missing[0])
    if study.layouts.vehicles is not None:
        if searched:
            raise InputError("--search", "no numbers of fleets: single solves can be searched", searched[0])
        return page(_fleets(study))
    parts = searches(study, searched) if searched else {}
    return page(missions(study, parts) if study.missions else _trajectories(study, parts))


def _trajectories(study: Study, searched: Mapping[int, SearchPart]) -> Document:
    """Single trajectories, rolled out from the controls that the study kept."""
    document, rows, order = None, study.rows, list[np.ndarray]()
    bar = page_bar(study.layouts.count, SLOW_PAGE, "layout")
    for places, task in study.tasks():
        problem = task.problem
        look = look_of(problem.dynamics)
        document = document or document_of(study, problem, look)
        ids, flown = study.layouts.ids[places].tolist(), []
        for name in document.solvers:
            U, t = study.flight(name, places, problem.N)
            X = states_of(problem, U, t)
            here = [rows[name, number] for number in ids]
            touching = np.array([not row["clearance"] >= 0 for row in here])
            said = [result_of(row) for row in here], [told(row) for row in here]
            flown.append(flights_of(problem, look, X, U, name, *said, ADMITTED, touching, t))
        for b, number in enumerate(ids):
            shown = [flights[b] for flights in flown if len(flights[b].path)]
            document.add(f"layout {number}", problem, b, shown, searched.get(number))
        bar.update(len(ids))
        order.append(places)
    bar.close()
    assert document is not None
    document.ordered(np.argsort(np.concatenate(order)).tolist())
    return document


def _fleets(study: Study) -> Document:
    """Fleets, rolled out from the controls that the study kept, a colour for each vehicle."""
    document, controls = None, study.flown(SOLUTIONS, "U")
    for places in study.layouts.together(MEASURED_AT_ONCE):
        layouts = study.layouts.take(places)
        for name, U in controls.items():
            found = solution_of(study.vehicle, layouts, U[places])
            if document is None:
                about = f"{study.layouts.count} fleets of {found.fleet.V}, {study.vehicle.name}, seed {study.seed}"
                title = f"{study.trials['scenario'].iloc[0]}: {', '.join(controls)}"
                document = fleet_document(found.fleet.members, title, about)
            said = f", {name}" if len(controls) > 1 else ""
            labels = [f"fleet {number}{said}" for number in layouts.ids.tolist()]
            add_fleets(document, found.fleet.members, found.vehicles, labels)
    assert document is not None
    return document


def result_of(row: Mapping[str, Any]) -> str:
    """The best that can be said of a row: success, reached, feasible or failed."""
    return next((name for name in ("success", "reached", "feasible") if row[name] is True), "failed")


def told(row: Mapping[str, Any]) -> Rows:
    """What the page says of a trajectory."""
    cost = f"{row['cost']:.6g}"
    if np.isfinite(row["best_cost"]) and row["best_cost"] != 0:
        cost += f", {row['cost'] / row['best_cost']:.3f} × best"
    entries: Rows = [("status", str(row["status"])), ("cost", cost)]
    entries += [("clearance", f"{row['clearance']:.3f} m")] if np.isfinite(row["clearance"]) else []
    entries += [("violation", f"{row['violation']:.2g}"), ("from the goal", f"{row['goal_distance']:.2f} m")]
    seconds = row["seconds"]
    time = f"{seconds:.2f} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"
    return [*entries, ("iterations", f"{row['iterations']:g}"), ("time", time)]


def write_view(folder: Path, output: Path | None = None, searched: Sequence[int] = (), trust: bool = False) -> Path:
    """Write the page of a finished study; returns where it lies. Raises InputError as `study_page` does."""
    path = folder / PAGE_NAME if output is None else output
    if path.is_dir():
        raise InputError("--output", "a file", f"{path}, which is a folder")
    text = study_page(folder, searched, trust)
    write(path, lambda file: file.write(text.encode()))
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-view`. Returns the exit code, see `ended`."""
    parser = RunParser(prog="torchgco-view", description="A page of a study, to be turned around: one HTML file.")
    parser.add_argument("run", metavar="RUN", type=Path, help="the folder of a finished study")
    parser.add_argument("--output", metavar="FILE", type=Path, help=f"default: {PAGE_NAME} in RUN")
    words = "solve the layouts of these numbers again, and show the search"
    parser.add_argument("--search", metavar="N", type=int, nargs="+", default=[], help=words)
    return parser.run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    path = write_view(options.run, options.output, list(dict.fromkeys(options.search)), options.trust)
    say(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0
