"""Figures 8 to 12, A4 and A5 of docs/paper.md: the paper's mission, flown with three planners, and two animations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from figures import solve
from matplotlib.figure import Figure
from paper_runs import FOREST, FOREST_LAYOUT

from torchgco import compose, presets
from torchgco.constraints.obstacles import BoundSpheres
from torchgco.dynamics.quadrotor import Airframe
from torchgco.flights import mission_frame, mission_row, samples
from torchgco.outcome import Ending, judge_flight
from torchgco.plotting import missions as draw
from torchgco.plotting.animation import Picture, mission_animation, planar_animation
from torchgco.plotting.course import Course, flight
from torchgco.simulation.mission import Mission
from torchgco.simulation.planner import Planner

GOAL_RADIUS = 0.5  # m
MARGIN = 0.01  # m, of the planner with gco
SOLVERS = ("al_ilqr", "gco_paper", "gco")
SHOWN = "gco_paper"  # the solver of Figures 10 to 12, A4 and A5
SNAPSHOTS = 4
INFEASIBLE = 1e-3  # violation from which a plan counts as infeasible


@dataclass(frozen=True)
class Flight:
    """One mission with one planner."""

    name: str  # of the solver
    course: Course
    period: float  # s
    frame: pd.DataFrame  # a row per control step
    fine: pd.DataFrame  # a row per time step of the plant: t, x0 to x16, f1 to f4 and u1 to u4
    plans: np.ndarray  # (K, N+1, 3), m
    end: Ending
    row: Mapping[str, object]  # see `flights.mission_row`


def planner(name: str) -> Planner:
    """The paper's planner with al_ilqr or gco_paper; the library's with gco."""
    if name != "gco":
        return Planner(getattr(presets, name)(3), multipliers="reset", margin=0.0, estimation=0.0)
    return Planner(presets.gco(3), margin=MARGIN)


def fly(name: str, duration: float = 15.0) -> Flight:
    """Fly the mission of Figure 6's layout for at most `duration`, s."""
    setup = compose([*FOREST, "device.threads=1"])
    task = setup.task(setup.scenario.draw([FOREST_LAYOUT], setup.seed))
    log = Mission(planner(name), duration=duration, goal_radius=GOAL_RADIUS).fly(
        task.problem, ids=torch.tensor([FOREST_LAYOUT])
    )
    spheres, goal = task.problem.geometric[0], task.problem.goal
    assert goal is not None and isinstance(spheres, BoundSpheres) and spheres.velocities is None
    place = goal.position[0].numpy()
    course = Course(spheres.centers[0].numpy(), spheres.inflated_radii[0].numpy(), place, GOAL_RADIUS)
    arrays, contact = log.arrays(), draw.CONTACT * course.inflated_radii
    t, x = samples(arrays, 0, log.period)
    end = judge_flight(t, x[:, :3], course.centers, contact, None, place, GOAL_RADIUS)
    gaps = np.linalg.norm(arrays["x"][0, :, 0, None, :3] - course.centers, axis=-1) - contact
    frame = mission_frame(arrays, [FOREST_LAYOUT], log.period, [gaps.min(axis=-1)])
    row = mission_row(arrays, 0, log.period, end, Airframe())
    return Flight(name, course, log.period, frame, _fine(t, x, arrays["commands"][0]), log.plan[0].numpy(), end, row)


def _fine(t: np.ndarray, x: np.ndarray, commands: np.ndarray) -> pd.DataFrame:
    """A row per time step; a command holds from its row to the next, and the last is repeated."""
    u = commands.reshape(-1, 4)[: len(t) - 1]
    u = np.concatenate((u, u[-1:]))
    columns = {"t": t} | {f"x{i}": x[:, i] for i in range(17)}
    columns |= {f"f{i + 1}": x[:, 13 + i] for i in range(4)} | {f"u{i + 1}": u[:, i] for i in range(4)}
    return pd.DataFrame(columns)


def figures(flights: Sequence[Flight]) -> dict[str, Callable[[], Figure]]:
    """What to draw of the missions, by the names of the files."""
    one = next(part for part in flights if part.name == SHOWN)
    steps = np.linspace(0, 0.8 * (len(one.frame) - 1), SNAPSHOTS).round().astype(int).tolist()
    return {
        "figure-08": lambda: draw.compute_figure({part.name: part.frame for part in flights}, one.period),
        "figure-09": lambda: draw.distance_figure({part.name: part.fine for part in flights}, one.course),
        "figure-10": lambda: draw.snapshots_figure(one.frame, one.plans, one.course, steps, one.period),
        "figure-11": lambda: draw.commands_figure(one.fine),
        "figure-12": lambda: draw.states_figure(one.fine, one.course.goal),
        "figure-A4": lambda: draw.tracking_figure(one.frame, "violation"),
        "figure-A5": lambda: draw.tracking_figure(one.frame, "time"),
    }


def table(flights: Sequence[Flight]) -> pd.DataFrame:
    """A column per planner, a row per quantity."""
    return pd.DataFrame({part.name: _column(part) for part in flights})


def _column(part: Flight) -> dict[str, str]:
    frame, fine, row, period = part.frame, part.fine, part.row, part.period
    t = flight(fine, "t")["t"]
    near = part.course.nearness(fine[["x0", "x1", "x2"]].to_numpy(), t)
    planned, tracked = 1e3 * frame["planner_seconds"], 1e3 * frame["tracker_seconds"]
    thrust = fine[["f1", "f2", "f3", "f4"]].to_numpy()
    return {
        "outcome": part.end.outcome.name,
        "flight time (s)": f"{part.end.flight_time:.2f}",
        "smallest distance / (r_obs + r_veh)": f"{near.min():.3f}",
        "control steps": f"{len(frame)}",
        "steps with guidance": f"{int((frame['guided'] > 0).sum())}",
        "plans flown with a violation above 1e-3": f"{int((frame['violation'] > INFEASIBLE).sum())}",
        "largest violation of a plan": f"{frame['violation'].max():.1e}",
        "planner, first step (ms)": f"{planned.iloc[0]:.0f}",
        "planner, median (ms)": f"{planned.median():.0f}",
        "planner, 99th percentile (ms)": f"{planned.quantile(0.99):.0f}",
        f"steps over {1e3 * period:.0f} ms": f"{row['missed_deadlines']}",
        "tracker per control step, median (ms)": f"{tracked.median():.1f}",
        "tracker's largest violation (N)": f"{frame['tracking_violation'].max():.1e}",
        "largest speed (m/s)": f"{np.linalg.norm(fine[['x3', 'x4', 'x5']], axis=1).max():.1f}",
        "largest tilt, roll or pitch (deg)": f"{_tilt(fine):.0f}",
        "thrust of a rotor (N)": f"{thrust.min():.1f} to {thrust.max():.1f}",
        "energy of the rotors (J)": f"{row['energy']:.0f}",
    }


def _tilt(fine: pd.DataFrame) -> float:
    q = fine[["x6", "x7", "x8", "x9"]].to_numpy().T
    return float(np.rad2deg(np.abs(draw.euler_angles(q)[:2])).max())


def markdown(rows: pd.DataFrame) -> str:
    """The table in Markdown."""
    lines = [["", *map(str, rows.columns)], ["---"] * (rows.shape[1] + 1)]
    lines += [[str(name), *map(str, values)] for name, values in zip(rows.index, rows.to_numpy(), strict=True)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def animate(flights: Sequence[Flight], outputs: Path) -> None:
    """The mission with gco, and how gco frees a planar vehicle."""
    one = next(part for part in flights if part.name == "gco")
    mission_animation(one.frame, one.plans, one.course, one.period, outputs / "mission.gif", "gco")
    free(outputs / "freeing.gif")


def free(path: Path) -> Path:
    """Animate one solve by gco: its first iterates, candidates along paths, the proposal, and the result."""
    calls, layouts, final = solve(0)
    first = [words[2][0, :, :2].numpy() for words, _ in calls["caught"]]
    end = next(i for i, (_, advice) in enumerate(calls["caught"]) if bool(advice.stop.any()))
    pictures = [Picture(f"1  AL-iLQR, inner solve {i + 1}", x[None], seconds=0.7) for i, x in enumerate(first[:end])]
    caught = first[end]
    pictures.append(Picture(f"1  AL-iLQR, inner solve {end + 1}: caught", caught[None], seconds=1.5))
    tracked = calls["tracked"][0][1]
    rows = tracked.live.nonzero().flatten().tolist()
    every = tracked.X[rows, :, :2].numpy()
    for count in range(6, len(every), 6):
        pictures.append(Picture(f"2  {len(every)} candidates track paths", every[:count], caught[None], 0.1))
    pictures.append(Picture(f"2  {len(every)} candidates track paths", every, caught[None], 1.2))
    relaxed, sound = calls["relaxed"][0][1]
    sets = relaxed.X[sound.nonzero().flatten(), :, :2].numpy()
    pictures.append(Picture(f"3  relaxed: {len(sets)} are sound", sets, seconds=1.5))
    (before, _, kept, _), (refined, _, best, _) = calls["refined"][0]
    kept = [row for row in kept.nonzero().flatten().tolist() if not torch.equal(before.U[row], refined.U[row])]
    few = refined.X[kept, :, :2].numpy()
    pictures.append(Picture(f"4  refined: {len(few)} end feasible", few, seconds=1.5))
    proposal = refined.X[int(best[0]), :, :2].numpy()
    pictures.append(Picture("5  the cheapest is the proposal", proposal[None], few, 1.5))
    pictures.append(Picture("6  solved on from there: the result", final[None], caught[None], 2.5))
    assert layouts.start is not None and layouts.goal is not None
    assert layouts.vehicle_radius is not None and layouts.goal_radius is not None
    start, goal = (np.broadcast_to(x, (1, x.shape[-1]))[0, :2] for x in (layouts.start, layouts.goal))
    margin, scene = layouts.vehicle_radius, (layouts.centers[0], layouts.radii[0] + layouts.vehicle_radius)
    return planar_animation(pictures, *scene, (start, goal), path, margin, layouts.goal_radius)
