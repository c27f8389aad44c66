"""`torchgco-view RUN`: a page of a finished study, which one turns around; see docs/view.md."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.experiments.ending import say
from torchgco.experiments.flying.progress import page_bar
from torchgco.experiments.reports.finished import MEASURED_AT_ONCE, Study, document_of
from torchgco.experiments.reports.mission_view import missions
from torchgco.experiments.reports.parser import RunParser
from torchgco.experiments.reports.searched import searches
from torchgco.experiments.results.durations import states_of
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import SOLUTIONS
from torchgco.fleets.drawn import solution_of
from torchgco.obstacles.base import ADMITTED
from torchgco.view.document import Document, SearchPart
from torchgco.view.flights import Rows, flights_of
from torchgco.view.notebook import add_fleets, fleet_document
from torchgco.view.page import page
from torchgco.view.vehicles import look_of

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
            flown.append(flights_of(problem, look, X, U, name, *said, ADMITTED, touching))
        for b, number in enumerate(ids):
            shown = [flights[b] for flights in flown if len(flights[b].path)]
            # The knots' times are those of the solver under study; others are shown at the same knots.
            all_times = study.times
            knot_times = None if all_times is None else all_times[document.solvers[0]][places[b], : problem.N + 1]
            document.add(f"layout {number}", problem, b, shown, searched.get(number), knot_times)
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
