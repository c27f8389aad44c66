"""Reports on finished studies of missions: mission.parquet, a table of outcomes, figures and an animation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torchgco.experiments.flying.mission_flight import PLANS_KEPT
from torchgco.experiments.flying.progress import draw as draw_all
from torchgco.experiments.flying.tasks import Tasks
from torchgco.experiments.reports.report import several
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import MISSION, PLANS_FILE, TIME_STEPS, TRIALS, read_trials
from torchgco.experiments.results.kinds import format_report, parts_of, write_tables
from torchgco.experiments.statistics.missions import mission_lines
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.outcome import clearances, gates_passed, mission_frame, time_step_frame, unpacked
from torchgco.missions.planning_problem import airframe_of
from torchgco.plotting import missions as draw
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.bodies import bodies, body_of
from torchgco.plotting.course import Course
from torchgco.plotting.gates import outlines
from torchgco.plotting.style import save

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
        draw_all(_drawings(folder, trials, tasks))
    text = format_report(parts, "table")
    return mission_lines(trials) if trials["layout"].nunique() <= PLANS_KEPT else text


def _drawings(folder: Path, trials: pd.DataFrame, tasks: Tasks) -> dict[str, Callable[[], object]]:
    """Functions that draw and write: outcomes, and where few missions fly, for each what the paper shows of it."""
    to_draw: dict[str, Callable[[], object]] = {}

    def add(name: str, figure: Callable[[], Figure]) -> None:
        path = folder / "figures" / f"{name}.png"
        to_draw[name] = lambda: write(path, lambda file: save(figure(), file, dpi=110))

    if len(shown := several(trials)):
        add("outcomes", lambda: draw.outcomes_figure(shown))
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
        add(f"{number}-compute", partial(draw.compute_figure, rows, period))
        if len(course.reaches):
            add(f"{number}-distance", partial(draw.distance_figure, fine, course))
        for name, frame in rows.items():
            plan, label = plans[name][number][: len(frame)], f"{number}-{name}"
            steps = np.linspace(0, 0.8 * (len(frame) - 1), SNAPSHOTS).round().astype(int).tolist()
            add(f"{label}-snapshots", partial(draw.snapshots_figure, frame, plan, course, steps, period))
            add(f"{label}-commands", partial(draw.commands_figure, fine[name], airframe))
            add(f"{label}-states", partial(draw.states_figure, fine[name], course.goal))
            add(f"{label}-tracking", partial(draw.tracking_figure, frame))
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
    if (body := body_of(task.problem)) is not None:
        vehicle = float(body.inner.vehicle_radius[0])
    course = Course(bodies(layouts.arrays(), 0), task.goal[0].numpy(), radius, vehicle, layouts.map, gates, body)
    return course, float(task.problem.dynamics.dt)
