"""Reports on studies, missions and fleets: tables, `summary.csv`, figures. `torchgco-report` is the command.

`torchgco-report DIR [DIR ...]` merges every `trials.parquet` below the folders, and the shards of studies that still
run, and reports on all of them together.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from torchgco.base.errors import InputError
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.flying.flight import Tasks
from torchgco.experiments.flying.mission_flight import PLANS_KEPT, VEHICLES, vehicles_table
from torchgco.experiments.flying.progress import draw
from torchgco.experiments.reports.verify import confirmed_frame, confirmed_text, difference_texts, verify
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import (
    LAYOUTS,
    MANIFEST,
    MISSION,
    PLANS_FILE,
    SOLUTIONS,
    TIME_STEPS,
    TRIALS,
    read_trials,
)
from torchgco.experiments.results.kinds import MISSIONS, Part, format_report, mission_lines, parts_of, write_tables
from torchgco.experiments.results.merge import REPEATED, UNFINISHED, merge
from torchgco.experiments.results.runs import is_merged
from torchgco.experiments.statistics.families import families_text, over_families
from torchgco.experiments.statistics.power import in_words
from torchgco.experiments.statistics.statistics import TASK, plain, task_columns
from torchgco.experiments.statistics.tables import OUTPUTS, csv_text, format_frame
from torchgco.fleets.drawn import solution_of
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.outcome import clearances, gates_passed, mission_frame, time_step_frame, unpacked
from torchgco.missions.planning_problem import airframe_of
from torchgco.obstacles.base import Obstacles
from torchgco.plotting import missions as of_missions
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.bodies import bodies
from torchgco.plotting.course import Course
from torchgco.plotting.distributions import clearance_figure, is_spread, violation_figure
from torchgco.plotting.families import families_figure
from torchgco.plotting.fleets import fleet_animation, fleet_figure
from torchgco.plotting.gates import outlines
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.rates import rates_figure, sweep_figure
from torchgco.plotting.study_figure import Columns, study_figure
from torchgco.plotting.style import save
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.plotting.ways import Ways
from torchgco.scenarios import Layouts, Vehicle

Drawings = dict[str, Callable[[], Figure]]
SHOWN_LAYOUTS = 12  # layouts in a picture, at most
OURS = re.compile(r"(rates|outcomes)(-.+)?|(missions-)?(clearance|violation)")  # names of what `drawings` draws
FACETS = 6  # most tasks that have panels of their own; more are pooled over the swept variables
Arrays = Mapping[str, np.ndarray]


def write_report(
    folder: Path,
    trajectories: Callable[[Arrays, int], Ways] | None = None,
    figures: bool = True,
    printed: Columns | None = None,
    tasks: Tasks | None = None,
    trials: pd.DataFrame | None = None,
    form: str = "table",
    pdf: bool = False,
) -> str:
    """Write `summary.csv`, `paired.csv` and `figures/*.png` next to the `trials.parquet` in a folder; return the table.

    Args:
        trajectories: of so many of the first layouts in `layouts.npz`, by solver, for their picture, from the arrays of
            `solutions.npz`; None: no such picture.
        figures: False: tables alone.
        printed: columns of a paper that a figure of the whole study spans, study.pdf; None: no such figure.
        tasks: of the study, whose numbers these pictures show where layouts have none; None: layouts have all that is
            known.
        trials: the table in that file, where it is known.
        form: of the table that is returned, one of OUTPUTS.
        pdf: whether figures are PDF, as papers take them, instead of PNG.

    Raises:
        InputError: the table is missing, unreadable or empty, or the trajectories don't fit the layouts.
    """
    trials = read_trials(folder / TRIALS) if trials is None else trials
    parts = parts_of(trials)
    write_tables(folder, parts)
    to_draw = {name: figure for part in parts for name, figure in drawings(part).items()} if figures else {}
    if (figures or printed) and trajectories is not None:
        stored = Layouts.load(folder / LAYOUTS)
        count = min(stored.count, SHOWN_LAYOUTS)
        layouts, how = _posed(stored.take(range(count)), tasks)
        with np.load(folder / SOLUTIONS, allow_pickle=False) as solutions:
            ways = trajectories(solutions, count)
        if figures:
            to_draw["layouts"] = lambda: layout_grid(layouts, ways, trials, **how)
        if printed:
            for kind in ("png", "pdf"):
                to_draw[f"study.{kind}"] = lambda: study_figure(layouts, ways, trials, parts[0].summary, printed, **how)
    if pdf:
        to_draw = {name if name.startswith("study.") else f"{name}.pdf": figure for name, figure in to_draw.items()}
    draw({name: partial(_draw, folder, name, figure) for name, figure in to_draw.items()})
    if figures:
        _forget(folder / "figures", {_file_name(name) for name in to_draw})
    return format_report(parts, form)


def _forget(figures: Path, drawn: set[str]) -> None:
    """Remove what earlier reports drew and this one doesn't: it would be read as one of this report's figures."""
    for path in figures.glob("*.p*"):
        if path.suffix in (".png", ".pdf") and OURS.fullmatch(path.stem) and path.name not in drawn:
            path.unlink(missing_ok=True)


def _posed(layouts: Layouts, tasks: Tasks | None) -> tuple[Arrays, dict[str, Any]]:
    """The arrays of layouts as problems are made of them, the vehicle's body where it is no ball, its position, and the
    obstacles of each problem."""
    if tasks is None:
        return layouts.arrays(), {}
    groups = layouts.alike()
    made = [tasks.of(places, exact=True) for places in groups]  # the first of the study's own
    first, arrays = made[0].problem, tasks.setup.vehicle.completed(layouts).arrays()
    how = {"body": VehicleBody.of(first), "position": first.dynamics.position}
    if first.dynamics.position is None:
        return arrays, how
    start, goal = (np.full((layouts.count, layouts.dimension), np.nan) for _ in range(2))
    obstacles: list[tuple[Obstacles, ...]] = [()] * layouts.count
    for places, task in zip(groups, made, strict=True):
        start[places], goal[places] = task.problem.x0[:, task.problem.position].numpy(), task.goal.numpy()
        for row, place in enumerate(places):
            obstacles[place] = task.problem.take(torch.tensor([row])).obstacles
    return {**arrays, "start": start, "goal": goal}, {**how, "obstacles": obstacles}


def _draw(folder: Path, name: str, figure: Callable[[], Figure], dpi: int = 150) -> None:
    path, ending = folder / "figures" / _file_name(name), "pdf" if name.endswith(".pdf") else "png"
    write(path, lambda file: save(figure(), file, dpi=300 if name == "study.png" else dpi, form=ending))


def _file_name(drawing: str) -> str:
    return drawing if drawing.endswith((".png", ".pdf")) else f"{drawing}.png"


def drawings(part: Part) -> Drawings:
    """Functions that draw, by name: rates against every swept variable, then rates and distributions of each task.

    What would be empty isn't drawn: a distribution or shares of single trials.
    """
    mission, again = part.kind is MISSIONS, part.kind.summarise
    named, trials, summary, to_draw = "outcomes" if mission else "rates", part.trials, part.summary, {}
    swept = task_columns(trials)[len(TASK) :]
    for name in (name for name in swept if trials[name].nunique() > 1):
        others = [other for other in swept if other != name]
        rows, table = trials[trials[name].notna()], summary[summary[name].notna()]
        if len(table[[*TASK, *others]].drop_duplicates()) > FACETS:
            table = again(rows.drop(columns=others))
        to_draw[f"{named}-{name}"] = lambda table=table, name=name: sweep_figure(table, name)
    if len(summary[[*TASK, *swept]].drop_duplicates()) > FACETS:
        trials = trials.drop(columns=swept)
        summary = again(trials)
    if not mission and summary["n"].max() > 1:  # of a single trial nothing is a rate
        to_draw["rates"] = lambda: rates_figure(summary)
    elif len(shown := several(trials)):
        to_draw["outcomes"] = lambda: of_missions.outcomes_figure(shown)
    return to_draw | _distributions(trials, "missions-" if mission else "")


def several(trials: pd.DataFrame) -> pd.DataFrame:
    """The missions of those tasks in which a solver flew more than one: shares of a single mission say nothing."""
    tasks = task_columns(trials)
    counts = trials.groupby([*tasks, "solver"], sort=False, dropna=False, observed=True)["layout"].transform("size")
    most = trials.assign(_n=counts).groupby(tasks, sort=False, dropna=False, observed=True)["_n"].transform("max")
    return trials[most > 1]


def _distributions(trials: pd.DataFrame, prefix: str) -> Drawings:
    to_draw: Drawings = {}
    if is_spread(trials, "clearance"):
        to_draw[f"{prefix}clearance"] = lambda: clearance_figure(trials)
    if not prefix and is_spread(trials, "violation"):  # a mission's is that of its plans
        to_draw["violation"] = lambda: violation_figure(trials)
    return to_draw


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-report`. Returns the exit code: 1 where rows can't be confirmed, and as `ended`."""
    parser = RunParser("torchgco-report", "One report on many studies.", "DIR")
    parser.add_argument("folders", nargs="*", metavar="DIR", type=Path, help="a study, or a folder of studies")
    parser.add_argument("--output", metavar="DIR", type=Path, help="default: 'report' in the first DIR")
    parser.add_argument("--format", choices=OUTPUTS, default="table", help="of the tables on stdout; default: table")
    instead = parser.add_mutually_exclusive_group()
    words = "one table of all trials in place of statistics: trials.csv, and on stdout with --format"
    instead.add_argument("--long", action="store_true", help=words)
    words = "compare solvers over all families by a column, such as cost or seconds: profiles, ranks; families.csv"
    instead.add_argument("--families", metavar="COLUMN", help=words)
    words = "print how many layouts tell two rates apart, such as 0.9 0.8, and no report"
    instead.add_argument("--power", nargs=2, type=float, metavar="RATE", help=words)
    parser.add_argument("--pdf", action="store_true", help="figures as PDF instead of PNG")
    parser.add_argument("--verify", action="store_true", help="confirm all rows and tables from the stored controls")
    return parser.run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    if options.power is not None:
        say(in_words(*options.power))
        return 0
    if not options.folders:
        raise InputError("DIR", "a study, or a folder of studies", "none")
    return _verify(options) if options.verify else _report(options)


def _report(options: argparse.Namespace) -> int:
    output = options.output or options.folders[0] / "report"
    merged = merge(options.folders, options.trust)
    if output.exists() and not output.is_dir():
        raise InputError("--output", "a folder", f"{output}, which is a file")
    is_study = (output / TRIALS).exists() and not is_merged(output / TRIALS)
    if is_study or (output / MANIFEST).exists():
        raise InputError("--output", "a folder without the results of a study, which are kept", output)
    text = [str(name) for name in merged.columns if isinstance(merged[name].dtype, pd.CategoricalDtype)]
    # Numbers hardly repeat: a dictionary of them would be given up after the time it takes.
    write(output / TRIALS, lambda file: plain(merged).to_parquet(file, index=False, use_dictionary=text))
    trials = merged.copy(deep=False)
    trials.attrs = {}  # pandas copies them for every table that it makes from this one
    if options.long:
        say(_long(output, trials, options.format))
    elif options.families is not None:
        say(_families(output, trials, options))
    else:
        say(write_report(output, trials=trials, form=options.format, pdf=options.pdf))
    repeated = merged.attrs[REPEATED]
    notes = [f"{repeated} rows left out: another run has the same flight, and each counts once"] if repeated else []
    for note in [*notes, f"written to {output}"]:
        if options.format == "table":
            say(f"\n{note}")
        else:
            print(note, file=sys.stderr)
    for note in merged.attrs[UNFINISHED]:
        print(f"unfinished: {note}", file=sys.stderr)
    return 0


def _long(output: Path, trials: pd.DataFrame, form: str) -> str:
    """Write trials.csv, a row per solver and layout; returns what to print."""
    table = plain(trials)
    write(output / "trials.csv", lambda file: file.write(csv_text(table).encode()))
    return f"{len(table)} trials, {len(table.columns)} columns" if form == "table" else format_frame(table, form)


def _families(output: Path, trials: pd.DataFrame, options: argparse.Namespace) -> str:
    """Write families.csv and its figure; returns what to print."""
    table = over_families(trials, options.families)
    write(output / "families.csv", lambda file: file.write(csv_text(table).encode()))
    name = "families.pdf" if options.pdf else "families"
    draw({name: partial(_draw, output, name, partial(families_figure, table, options.families))})
    return families_text(table, options.families, options.format)


def _verify(options: argparse.Namespace) -> int:
    """Print what was confirmed; returns 1 where anything differs."""
    studies, unfinished = verify(options.folders, options.trust)
    for folder in unfinished:
        print(f"unfinished, not verified: {folder}", file=sys.stderr)
    if options.format == "table":
        say(confirmed_text(studies))
    else:
        say(format_frame(confirmed_frame(studies), options.format))
        print("".join(f"{line}\n" for line in difference_texts(studies)), end="", file=sys.stderr)
    return 1 if any(study.differs for study in studies) else 0


SMALL_DPI = 110  # of figures of which a mission or fleet has several
SNAPSHOTS = 4  # instants of a mission in one figure


def mission_table(folder: Path, tasks: Tasks, solvers: Sequence[str], logs: np.ndarray) -> pd.DataFrame:
    """The rows of mission.parquet from packed logs (solver, L, K, W).

    Where the logs hold plans, these and all time steps are written into files of their own.
    """
    mission, layouts = tasks.setup.mission, tasks.layouts
    assert mission is not None
    problem = tasks.of(range(layouts.count), exact=True).problem
    period, contact, gates = float(problem.dynamics.dt), Contact.among(problem), Passing.among(problem)
    frames, plans, fine = [], [], []
    for name, rows in zip(solvers, logs, strict=True):
        arrays = unpacked(rows, mission.substeps(period) or 1, not mission.sees_all)
        passed = None if gates is None else gates_passed(arrays, gates)
        frame = mission_frame(arrays, layouts.ids.tolist(), period, clearances(arrays, period, contact), passed)
        frame.insert(0, "solver", name)
        frames.append(frame)
        if "plan" in arrays:
            plans.append(arrays["plan"])
            fine.append(time_step_frame(arrays, layouts.ids.tolist(), period, airframe_of(problem.dynamics)))
            fine[-1].insert(0, "solver", name)
    if plans:
        steps = pd.concat(fine, ignore_index=True)
        write(folder / TIME_STEPS, lambda file: steps.to_parquet(file, index=False))
        columns = {"plan": np.stack(plans), "solver": np.array(solvers), "layout": layouts.ids}
        write(folder / PLANS_FILE, lambda file: np.savez_compressed(file, **columns))
    return pd.concat(frames, ignore_index=True)


def write_mission_report(folder: Path, tasks: Tasks, figures: bool = True) -> str:
    """Write summary.csv, paired.csv and figures next to the mission.parquet in a folder; return the report as text."""
    trials = read_trials(folder / TRIALS)
    parts = parts_of(trials)
    write_tables(folder, parts)
    if figures:
        draw(_drawings(folder, trials, tasks))
    text = format_report(parts, "table")
    return mission_lines(trials) if trials["layout"].nunique() <= PLANS_KEPT else text


def _drawings(folder: Path, trials: pd.DataFrame, tasks: Tasks) -> dict[str, Callable[[], object]]:
    """Functions that draw and write: outcomes, and where few missions fly, for each what the paper shows of it."""
    to_draw: dict[str, Callable[[], object]] = {}

    def add(name: str, figure: Callable[[], Figure]) -> None:
        to_draw[name] = partial(_draw, folder, name, figure, SMALL_DPI)

    if len(shown := several(trials)):
        add("outcomes", lambda: of_missions.outcomes_figure(shown))
    if not all((folder / name).is_file() for name in (PLANS_FILE, TIME_STEPS)):  # of many missions
        return to_draw
    with np.load(folder / PLANS_FILE, allow_pickle=False) as flown:
        plans = dict(zip(flown["solver"].tolist(), flown["plan"], strict=True))
    tables = [pd.read_parquet(folder / name) for name in (MISSION, TIME_STEPS)]
    airframe = airframe_of(tasks.setup.vehicle.dynamics)
    for number in tasks.layouts.ids.tolist():  # in a study they are places
        course, period = _course(tasks, number)
        rows, fine = (_by_solver(table[table["mission"] == number]) for table in tables)
        if not rows:  # a start in contact
            continue
        fine = {name: fine[name] for name in rows}  # of solvers that never flew there is the start alone
        add(f"{number}-compute", partial(of_missions.compute_figure, rows, period))
        if len(course.reaches):
            add(f"{number}-distance", partial(of_missions.distance_figure, fine, course))
        for name, frame in rows.items():
            plan, label = plans[name][number][: len(frame)], f"{number}-{name}"
            steps = np.linspace(0, 0.8 * (len(frame) - 1), SNAPSHOTS).round().astype(int).tolist()
            add(f"{label}-snapshots", partial(of_missions.snapshots_figure, frame, plan, course, steps, period))
            add(f"{label}-commands", partial(of_missions.commands_figure, fine[name], airframe))
            add(f"{label}-states", partial(of_missions.states_figure, fine[name], course.goal))
            add(f"{label}-tracking", partial(of_missions.tracking_figure, frame))
            gif = folder / "figures" / f"{label}.gif"
            to_draw[f"{label}.gif"] = partial(mission_animation, frame, plan, course, period, gif, name)
    return to_draw


def _by_solver(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(name): rows for name, rows in table.groupby("solver", sort=False)}


def _course(tasks: Tasks, number: int) -> tuple[Course, float]:
    """The obstacles, the gates and the goal of one layout, and its control period, s."""
    task, setup, layouts = tasks.of([number], exact=True), tasks.setup, tasks.layouts.take([number])
    assert setup.mission is not None
    near = setup.mission.goal_radius
    radius = float(task.goal_radius) if near is None else near
    stated = layouts.vehicle_radius
    vehicle = setup.vehicle.radius if stated is None else stated
    gates = tuple(outlines(task.problem, 0))
    if (body := VehicleBody.of(task.problem)) is not None:
        vehicle = body.inner
    course = Course(bodies(layouts.arrays(), 0), task.goal[0].numpy(), radius, vehicle, layouts.map, gates, body)
    return course, float(task.problem.dynamics.dt)


SHOWN_FLEETS = 4  # fleets that get a picture and an animation, at most


def write_fleet_report(folder: Path, vehicle: Vehicle, layouts: Layouts, figures: bool = True) -> str:
    """Write vehicles.parquet, the tables and figures next to the `trials.parquet` in a folder; returns the table."""
    with np.load(folder / SOLUTIONS, allow_pickle=False) as flown:
        controls = dict(zip(flown["solver"].tolist(), flown["U"], strict=True))
    table = vehicles_table(vehicle, layouts, controls)
    write(folder / VEHICLES, lambda file: table.to_parquet(file, index=False))
    if figures:
        draw(_fleet_drawings(folder, vehicle, layouts.take(range(min(SHOWN_FLEETS, layouts.count))), controls))
    return write_report(folder, figures=figures)


def _fleet_drawings(
    folder: Path, vehicle: Vehicle, layouts: Layouts, controls: dict[str, np.ndarray]
) -> dict[str, Callable[[], object]]:
    """Functions that draw and write a picture and an animation of each fleet, by the solver under study."""
    to_draw, U = dict[str, Callable[[], object]](), next(iter(controls.values()))
    for place, number in enumerate(layouts.ids.tolist()):
        label, one = f"{layouts.name}-{number}", [place]
        found = solution_of(vehicle, layouts.take(one), U[one])
        to_draw[label] = partial(_draw, folder, label, partial(fleet_figure, *found.arrays(), None), SMALL_DPI)
        to_draw[f"{label}.gif"] = partial(fleet_animation, *found.arrays(), folder / "figures" / f"{label}.gif")
    return to_draw
