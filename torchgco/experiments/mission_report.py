"""Reports on finished studies of missions: mission.parquet, a table of outcomes, figures and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torchgco.constraints.bodies import CONTACT_FACTOR
from torchgco.experiments.build import Setup
from torchgco.experiments.files import write
from torchgco.experiments.mission_flight import FEW
from torchgco.experiments.paired import compare
from torchgco.experiments.records import LAYOUTS, MISSION, TRIALS
from torchgco.experiments.runs import read_trials
from torchgco.experiments.statistics import summarise, wilson
from torchgco.experiments.tables import aligned, paired_lines
from torchgco.flights import clearances, mission_frame, spheres_of, unpacked
from torchgco.outcome import Outcome
from torchgco.plotting import missions as draw
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.course import Course
from torchgco.plotting.style import save
from torchgco.scenarios import Layouts

SNAPSHOTS = 4  # instants of a mission in one figure
PLANS = "plans.npz"  # planned positions (solver, L, K, N+1, 3), where few missions fly


def mission_table(
    folder: Path, setup: Setup, layouts: Layouts, solvers: Sequence[str], logs: np.ndarray
) -> pd.DataFrame:
    """The rows of mission.parquet from packed logs (solver, L, K, W); where they hold plans, plans.npz is written."""
    assert setup.mission is not None
    problem = setup.vehicle.task(layouts).problem
    period, spheres, frames, plans = float(problem.dynamics.dt), spheres_of(problem), [], []
    for name, rows in zip(solvers, logs, strict=True):
        arrays = unpacked(rows, setup.mission.substeps(period) or 1)
        distances = [clearances(arrays, b, period, spheres[b]) for b in range(layouts.count)]
        frame = mission_frame(arrays, layouts.ids.tolist(), period, distances)
        frame.insert(0, "solver", name)
        frames.append(frame)
        plans.append(arrays.get("plan"))
    if plans[0] is not None:
        held = {"plan": np.stack(plans), "solver": np.array(solvers), "layout": layouts.ids}
        write(folder / PLANS, lambda file: np.savez_compressed(file, **held))
    return pd.concat(frames, ignore_index=True)


def write_mission_report(folder: Path, setup: Setup) -> str:
    """Write summary.csv and figures next to the mission.parquet in a folder, and return the report as text."""
    trials = read_trials(folder / TRIALS)
    summary = summarise(trials)
    write(folder / "summary.csv", lambda file: summary.to_csv(file, index=False))
    blocks = [outcome_table(trials), effort_table(trials)]
    paired = compare(trials)
    if len(paired):
        blocks.append(paired_lines(paired))
    if trials["layout"].nunique() <= FEW:
        blocks = [mission_lines(trials), *blocks[2:]]
    write_figures(folder, trials, pd.read_parquet(folder / MISSION), setup)
    return "\n\n".join(blocks)


def mission_lines(trials: pd.DataFrame) -> str:
    """A line per mission."""
    lines = []
    for row in trials.itertuples():
        lines.append(
            f"{row.scenario} {row.layout}, {row.solver}: {row.outcome} after {row.flight_time:.2f} s, clearance "
            f"{row.clearance:.3f} m, planner {1000 * row.planner_seconds_median:.0f} ms (99 %: "
            f"{1000 * row.planner_seconds_p99:.0f} ms), {row.missed_deadlines} missed deadlines. "
            f"{Outcome[row.outcome].sentence}"
        )
    return "\n".join(lines)


def outcome_table(trials: pd.DataFrame) -> str:
    """Shares of the four outcomes by solver, which are disjoint, with 95 % Wilson intervals in percent."""
    rows = [["solver", "n", *(outcome.name for outcome in Outcome)]]
    for name, group in trials.groupby("solver", sort=False):
        n, cells = len(group), []
        for outcome in Outcome:
            count = int((group["outcome"] == outcome.name).sum())
            low, high = wilson(count, n)
            cells.append(f"{count} [{100 * low:.0f}, {100 * high:.0f}]")
        rows.append([str(name), str(n), *cells])
    return aligned(rows, 1)


COUNTS = ("missed_deadlines", "shifted_plans")
EFFORT = (
    ("flight time", "flight_time", "{:.2f} s"), ("clearance", "clearance", "{:.3f} m"),
    ("energy", "energy", "{:.0f} J"),
    ("planner", "planner_seconds_median", "{:.4f} s"), ("99 %", "planner_seconds_p99", "{:.4f} s"),
    ("missed", "missed_deadlines", "{:.1f}"), ("kept plans", "shifted_plans", "{:.1f}"),
)  # fmt: skip


def effort_table(trials: pd.DataFrame) -> str:
    """Medians by solver: over the missions that reached the goal, deadlines and kept plans as means over all."""
    rows = [["solver", *(head for head, _, _ in EFFORT)]]
    for name, group in trials.groupby("solver", sort=False):
        reached = group[group["reached"].astype(bool)]
        cells = []
        for _, column, form in EFFORT:
            value = group[column].mean() if column in COUNTS else reached[column].median()
            cells.append("-" if pd.isna(value) else form.format(value))
        rows.append([str(name), *cells])
    return aligned(rows, 1)


def write_figures(folder: Path, trials: pd.DataFrame, missions: pd.DataFrame, setup: Setup) -> None:
    """figures/outcomes.png; where few missions fly, for each of them those of the paper, and an animation."""
    held: dict[str, Figure] = {"outcomes": draw.outcomes_figure(trials)}
    plans = _plans(folder)
    layouts = Layouts.load(folder / LAYOUTS)
    for i, number in enumerate(layouts.ids.tolist() if plans else []):
        course, period = _course(setup, layouts.take([i]))
        flown = {
            str(name): rows for name, rows in missions[missions["mission"] == number].groupby("solver", sort=False)
        }
        if not flown:  # a start in contact
            continue
        held[f"{number}-compute"] = draw.compute_figure(flown, period)
        held[f"{number}-distance"] = draw.distance_figure(flown, course)
        for name, rows in flown.items():
            plan = plans[name][i][: len(rows)]
            steps = np.linspace(0, 0.8 * (len(rows) - 1), SNAPSHOTS).round().astype(int).tolist()
            label = f"{number}-{name}"
            held[f"{label}-snapshots"] = draw.snapshots_figure(rows, plan, course, steps, period)
            held[f"{label}-commands"] = draw.commands_figure(rows)
            held[f"{label}-states"] = draw.states_figure(rows, course.goal)
            held[f"{label}-tracking"] = draw.tracking_figure(rows)
            mission_animation(rows, plan, course, period, folder / "figures" / f"{label}.gif", name)
    for name, figure in held.items():
        write(folder / "figures" / f"{name}.png", lambda file, figure=figure: save(figure, file, dpi=110))


def _plans(folder: Path) -> dict[str, np.ndarray]:
    """Planned positions (L, K, N+1, 3) by solver; empty where none were kept."""
    if not (folder / PLANS).is_file():
        return {}
    with np.load(folder / PLANS, allow_pickle=False) as held:
        return dict(zip(held["solver"].tolist(), held["plan"], strict=True))


def _course(setup: Setup, layouts: Layouts) -> tuple[Course, float]:
    """The obstacles and the goal of one layout, and its control period, s."""
    task = setup.vehicle.task(layouts)
    centers, contact, velocities = spheres_of(task.problem)[0]
    assert setup.mission is not None
    near = setup.mission.goal_radius
    radius = float(task.goal_radius) if near is None else near
    course = Course(centers, contact / CONTACT_FACTOR, task.goal[0].numpy(), radius, velocities)
    return course, float(task.problem.dynamics.dt)
