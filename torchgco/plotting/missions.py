"""Figures of missions: computing times, distances, snapshots, commands, states, tracking, and how missions ended.

A frame has a row per control step of one mission (see `torchgco.missions.outcome.mission_frame`). Those figures that
show a motion alone also take a row per time step of the plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter
from scipy.spatial.transform import Rotation

from torchgco.base.errors import InputError
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.outcome import Outcome
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.plotting import trajectory as draw
from torchgco.plotting.course import (
    POSITION,
    VEHICLE_COLOUR,
    VIEWS,
    Course,
    draw_instant,
    draw_still,
    flight,
    handles,
)
from torchgco.plotting.style import (
    DASHES,
    INK,
    PALETTE,
    SMALL,
    TEXT,
    legend,
    panels,
    solver_colours,
    solver_handles,
    tasks_of,
    tidy,
)

Frames = Mapping[str, pd.DataFrame]  # by solver
CLOSE = (0.93, 1.12)  # shares shown near the boundaries
ENDS = {
    Outcome.REACHED: "#009E73",
    Outcome.COLLISION: "#D55E00",
    Outcome.TIMEOUT: "#BFBFBF",
    Outcome.DIVERGED: "#4D4D4D",
}
NARROW_BAR = 0.06  # share of a bar below which no count is written into it
FLOOR, LEAST_TIME = 1e-16, 1e-6  # N and s: the smallest violation and time on logarithmic axes
POSITION_AXES = ("x", "y", "z")


def compute_figure(frames: Frames, period: float) -> Figure:
    """Time of planner and tracker in every control step against the control period, a panel per solver.

    Args:
        frames: with columns t, planner_seconds, tracker_seconds and guided.
        period: s.

    A step in which guidance was on has a blue band. The title counts the steps in which planner and tracker together
    took longer than the period. Raises InputError for frames that lack a column or hold several missions.
    """
    figure, axes = panels(len(frames), 1, (8.0, 1.9), share=True)
    parts = {"planner_seconds": PALETTE[0], "tracker_seconds": PALETTE[1]}
    for ax, (solver, frame) in zip(axes, frames.items(), strict=True):
        values = flight(frame, "t", *parts, "guided")
        t, total = values["t"], values["planner_seconds"] + values["tracker_seconds"]
        for start in t[values["guided"] > 0]:
            ax.axvspan(start, start + period, color=draw.GUIDED, linewidth=0, zorder=0)
        for name, colour in parts.items():
            ax.plot(t, 1e3 * values[name], color=colour, linewidth=1.2, drawstyle="steps-post")
        ax.axhline(1e3 * period, color=draw.LIMIT, linestyle="--", linewidth=1.0)
        ax.set(yscale="log", ylabel="computing time [ms]")
        tidy(ax, f"{solver}: {int((total > period).sum())} of {len(t)} steps above the period")
    axes[-1].set_xlabel("time in the mission [s]")
    lines = [Line2D([], [], color=colour, label=name.split("_")[0]) for name, colour in parts.items()]
    mark = Line2D([], [], color=draw.LIMIT, linestyle="--", linewidth=1.0, label=f"period, {1e3 * period:.0f} ms")
    legend(figure, [*lines, mark, Patch(color=draw.GUIDED, label="guidance on")])
    return figure


def distance_figure(frames: Frames, course: Course) -> Figure:
    """Smallest distance from an obstacle's centre over time, as a share of r_obs + r_veh, a line per solver.

    Of a box or a capsule it is the distance from its sides or its axis, and r_obs the radius that rounds it.

    Args:
        frames: with columns t and x0 to x2; a row per time step shows contacts between control steps, too.

    Planners keep to the line at 1, bodies touch at 0.95; the lower panel shows these closer. A dot marks the end of a
    mission. If all radii are alike, the right axes have metres.
    Raises InputError as `compute_figure`.
    """
    figure, axes = panels(2, 1, (7.6, 2.6))
    colours = solver_colours(frames)
    for ax, title in zip(axes, ("", "near the boundaries"), strict=True):
        for solver, frame in frames.items():
            t = flight(frame, "t")["t"]
            near = course.nearness(course.track(frame), t)
            ax.plot(t, near, color=colours[solver], linestyle=DASHES[colours[solver]], linewidth=1.4)
            ax.plot(t[-1:], near[-1:], color=colours[solver], marker="o", markersize=5, clip_on=title != "")
        ax.axhline(1.0, color=INK, linestyle=":", linewidth=1.2)
        ax.axhline(CONTACT_FACTOR, color=draw.LIMIT, linestyle="--", linewidth=1.0)
        ax.set_ylabel("distance / ($r_{obs} + r_{veh}$) [-]")
        tidy(ax, title)
        _metres(ax, course)
    axes[1].set(ylim=CLOSE, xlim=axes[0].get_xlim(), xlabel="time in the mission [s]")
    marks = [
        Line2D([], [], color=INK, linestyle=":", linewidth=1.2, label="planner's boundary, 1.0"),
        Line2D([], [], color=draw.LIMIT, linestyle="--", linewidth=1.0, label=f"contact, {CONTACT_FACTOR}"),
    ]
    legend(figure, [*solver_handles(colours), *marks])
    return figure


def snapshots_figure(
    frame: pd.DataFrame, plans: np.ndarray, course: Course, steps: Sequence[int], period: float
) -> Figure:
    """Plan, vehicle, flown track and obstacles at chosen control steps, from above and from the side, a row per step.

    Args:
        frame: with columns t and x0 to x2, a row per control step.
        plans: planned positions (K, N+1, 3), m, K at least the frame's rows.
        steps: indices of control steps.
        period: of control steps and of the plan's knots, s.

    Raises:
        InputError: as `compute_figure`, for a step that isn't in the frame, and for plans that don't fit it.
    """
    t, track = flight(frame, "t")["t"], course.track(frame)
    check_plans(plans, len(t))
    low, high = course.limits(track)
    height = 0.4 + 3.9 * (high - low)[1:].max() / (high - low)[0]
    figure = Figure(figsize=(9.8, height * len(steps) + 0.7), layout="constrained")
    grid = figure.subplots(len(steps), 2, sharex=True, squeeze=False)
    for row, step in zip(grid, steps, strict=True):
        if not 0 <= step < len(t):
            raise InputError("steps", f"0 to {len(t) - 1}", step)
        for ax, plane, view in zip(row, VIEWS, ("above", "the side"), strict=True):
            draw_still(ax, course, plane)
            draw_instant(ax, course, t[step], track[: step + 1], plans[step], period, plane)
            draw.frame(ax, low.tolist(), high.tolist(), plane)
            tidy(ax, f"{t[step]:.2f} s, from {view}", grid=None)
    for ax in grid[:-1].flat:
        ax.set_xlabel("")
    draw.time_bar(figure, grid.flat, period * (plans.shape[1] - 1))
    names = draw.handles("knot", "infeasible", "obstacle", "inflated", "start", "goal", knot="plan")
    extra = [
        Line2D([], [], color=INK, linewidth=1.4, label="flown"),
        Line2D([], [], color=VEHICLE_COLOUR, markeredgecolor=INK, marker="o", linestyle="none", label="vehicle"),
    ]
    touched = any(len(course.contacts(track[: step + 1], period)) for step in steps)
    legend(figure, [*names[:2], *extra, *names[2:], *handles(course, touched)])
    return figure


def commands_figure(frame: pd.DataFrame, airframe: Airframe | None = None) -> Figure:
    """Commanded rotor speeds and thrusts of the four rotors over time.

    Args:
        frame: with columns t, u1 to u4 (rpm) and f1 to f4 (N), a row per time step, or per control step: in such a
            frame u1_low to u4_high, the least and the largest speed of each step, are drawn as a band around the first
            one.

    Dashed are the limits of the thrusts, and the speeds that hold a thrust at its limits. Commands may exceed these, as
    a rotor answers with a lag. Raises InputError as `compute_figure`.
    """
    body = Airframe() if airframe is None else airframe
    rows = {"u": ("rotor speed [rpm]", body.rotor_speeds), "f": ("thrust [N]", (body.thrust_min, body.thrust_max))}
    t = flight(frame, "t")["t"]
    figure, axes = panels(2, 1, (7.6, 2.5), share=False)
    for ax, (kind, (label, marks)) in zip(axes, rows.items(), strict=True):
        for colour, name in zip(PALETTE, (f"{kind}{i}" for i in range(1, 5)), strict=False):
            style = "steps-post" if kind == "u" else "default"  # a command is held until the next one
            ax.plot(t, flight(frame, name)[name], color=colour, linewidth=0.8, drawstyle=style)
            if f"{name}_low" in frame.columns:
                low, high = flight(frame, f"{name}_low", f"{name}_high").values()
                ax.fill_between(t, low, high, color=colour, alpha=0.25, linewidth=0, step="post")
        for mark in marks:
            ax.axhline(mark, color=draw.LIMIT, linestyle="--", linewidth=1.0)
        ax.set_ylabel(label)
        tidy(ax)
    axes[1].set_xlabel("time in the mission [s]")
    rotors = [Line2D([], [], color=colour, label=f"rotor {i + 1}") for i, colour in enumerate(PALETTE[:4])]
    legend(figure, [*rotors, Line2D([], [], color=draw.LIMIT, linestyle="--", linewidth=1.0, label="limits of thrust")])
    return figure


def states_figure(frame: pd.DataFrame, goal: np.ndarray) -> Figure:
    """Position, velocity, Euler angles and body rates over time, targets dotted: the goal (3,), m, at rest and upright.

    Args:
        frame: with columns t and x0 to x12.

    Positions have a panel each, the other states one together. Raises InputError as `compute_figure`.
    """
    values = flight(frame, "t", *(f"x{i}" for i in range(13)))
    t, x = values["t"], np.stack([values[f"x{i}"] for i in range(13)])
    figure = Figure(figsize=(9.8, 4.6), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True)
    for i, ax in enumerate(grid[0]):
        _lines(ax, t, x[i : i + 1], PALETTE[i : i + 1], float(goal[i]))
        ax.set_ylabel(f"position {POSITION_AXES[i]} [m]")
    below = {
        "velocity [m/s]": x[3:6],
        "Euler angles [deg]": np.rad2deg(euler_angles(x[6:10])),
        "body rates [rad/s]": x[10:13],
    }
    for ax, (label, shown) in zip(grid[1], below.items(), strict=True):
        _lines(ax, t, shown, PALETTE[:3], 0.0)
        ax.set(ylabel=label, xlabel="time in the mission [s]")
    for ax in grid.flat:
        tidy(ax)
    names = ("x, roll", "y, pitch", "z, yaw")
    lines = [Line2D([], [], color=colour, label=name) for colour, name in zip(PALETTE, names, strict=False)]
    legend(figure, [*lines, Line2D([], [], color=INK, linestyle=":", label="target")])
    return figure


def tracking_figure(frame: pd.DataFrame, part: Literal["both", "violation", "time"] = "both") -> Figure:
    """Largest violation of the tracking problems (N) and the tracker's time (ms) in every control step.

    Args:
        frame: with columns t, tracking_violation and tracker_seconds; a time is that of all solves of a control step.
        part: a panel each, or one of them alone.

    Violations below 1e-16 N, zero included, are drawn there, times below a microsecond there. Raises InputError as
    `compute_figure`.
    """
    values = flight(frame, "t", "tracking_violation", "tracker_seconds")
    series = {
        "violation": (np.maximum(values["tracking_violation"], FLOOR), "violation [N]"),
        # The first step may have compiled a kernel: on a linear axis all others would lie on its end.
        "time": (1e3 * np.maximum(values["tracker_seconds"], LEAST_TIME), "tracker's time\nper control step [ms]"),
    }
    shown = [series[name] for name in (series if part == "both" else (part,))]
    figure, axes = panels(len(shown), 1, (7.2, 2.4))
    for ax, (y, label) in zip(axes, shown, strict=True):
        ax.plot(values["t"], y, color=PALETTE[0], linewidth=1.2, drawstyle="steps-post")
        ax.set(yscale="log", ylabel=label)
        tidy(ax)
    axes[-1].set_xlabel("time in the mission [s]")
    return figure


def outcomes_figure(trials: pd.DataFrame) -> Figure:
    """Shares of the four ends of missions, a bar per solver, a panel per (scenario, model).

    Args:
        trials: with columns scenario, model, solver and outcome, a name of `Outcome`; missions without one don't count.

    Counts are written into the bars, n behind them. Raises InputError for an unknown outcome.
    """
    unknown = set(trials["outcome"].dropna()) - set(Outcome.__members__)
    if unknown:
        raise InputError("trials.outcome", f"one of {', '.join(Outcome.__members__)}", sorted(unknown)[0])
    tasks = list(tasks_of(trials))
    most = max(rows["solver"].nunique() for _, rows in tasks)
    figure, axes = panels(len(tasks), 2, (5.4, 1.0 + 0.42 * most))
    for ax, (title, rows) in zip(axes, tasks, strict=True):
        solvers = list(dict.fromkeys(rows["solver"]))
        for i, solver in enumerate(solvers):
            _stack(ax, i, rows.loc[rows["solver"] == solver, "outcome"].dropna())
        ax.set_yticks(range(len(solvers)), solvers)
        ax.set(ylim=(len(solvers) - 0.4, -0.6), xlim=(0, 1), xlabel="missions")
        ax.xaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
        tidy(ax, title, grid="x")
    legend(figure, [Patch(color=colour, label=end.name) for end, colour in ENDS.items()])
    return figure


def euler_angles(q: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (3, T), rad, from quaternions (4, T), scalar first: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_quat(q.T, scalar_first=True).as_euler("ZYX")[:, ::-1].T


def check_plans(plans: np.ndarray, rows: int) -> None:
    """Raise InputError unless plans are (K, N+1, 3) with at least `rows` rows."""
    if plans.ndim != 3 or plans.shape[2] != len(POSITION) or len(plans) < rows:
        raise InputError("plans", f"shape (K, N+1, 3) with K at least {rows}", plans.shape)


def _metres(ax: Axes, course: Course) -> None:
    """A right axis in metres, if all obstacles have the same radius."""
    radii = np.unique(course.reaches.round(9))
    if len(radii) == 1:
        r = float(radii[0])
        there, back = (lambda share: np.asarray(share) * r), (lambda length: np.asarray(length) / r)
        metres = ax.secondary_yaxis("right", functions=(there, back))
        metres.set_ylabel("distance [m]", fontsize=TEXT, color=INK)
        metres.tick_params(labelsize=SMALL, colors=INK)


def _lines(ax: Axes, t: np.ndarray, values: np.ndarray, colours: Sequence[str], target: float) -> None:
    ax.axhline(target, color=INK, linestyle=":", linewidth=1.2)
    for series, colour in zip(values, colours, strict=True):
        ax.plot(t, series, color=colour, linewidth=1.1)


def _stack(ax: Axes, y: int, outcomes: pd.Series) -> None:
    """One horizontal bar: the shares of the ends in the order of ENDS."""
    n, left = len(outcomes), 0.0
    for end, colour in ENDS.items():
        count = int((outcomes == end.name).sum())
        if count:
            ax.barh(y, count / n, 0.72, left, color=colour)
        if count and count / n >= NARROW_BAR:
            ink = INK if end is Outcome.TIMEOUT else "white"
            ax.text(left + count / n / 2, y, str(count), ha="center", va="center", fontsize=SMALL, color=ink)
        left += count / n if n else 0.0
    ax.text(1.01, y, f"n = {n}", va="center", fontsize=SMALL, color=INK)
