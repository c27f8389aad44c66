"""Figures 8 to 12, A4 and A5 of paper.md: the paper's mission, flown with three planners, and two animations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from benchmarks.lib import page
from benchmarks.lib.recorded import solve
from benchmarks.paper import drawing
from benchmarks.paper.flights import Flight
from benchmarks.paper.planar_animation import Picture, planar_animation
from torchgco.plotting import missions as draw
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.course import VIEWS, flight
from torchgco.plotting.style import INK, PALETTE, SMALL, legend
from torchgco.solution import Fate

FOLLOWED = "gco_paper"  # the solver of Figures 10 to 12, A4 and A5
SNAPSHOTS = (1, 3)  # of Figure 10: guided control steps, and later ones
SAMPLES = 30  # shown of a call of MPPI
INFEASIBLE = 1e-3  # violation from which a plan counts as infeasible
BEGIN, END = 10, 20  # control steps whose medians are compared
TICKS = (5, 10, 20, 50, 100)  # ms


def figures(flights: Sequence[Flight]) -> dict[str, Callable[[], Figure]]:
    """What to draw of the missions, by the names of the files."""
    one = next(part for part in flights if part.name == FOLLOWED)
    return {
        "figure-08": lambda: times(flights),
        "figure-09": lambda: draw.distance_figure({part.name: part.fine for part in flights}, one.course),
        "figure-10": lambda: snapshots(one),
        "figure-11": lambda: draw.commands_figure(one.fine),
        "figure-12": lambda: states(one),
        "figure-A4": lambda: draw.tracking_figure(one.frame, "violation"),
        "figure-A5": lambda: draw.tracking_figure(one.frame, "time"),
    }


def times(flights: Sequence[Flight]) -> Figure:
    """Figure 8: processor times in every control step, with the planner's median in the titles."""
    figure = draw.compute_figure({part.name: part.frame for part in flights}, flights[0].period)
    for ax, part in zip(figure.axes, flights, strict=True):
        ax.set_title(f"{part.name}: median of the planner {1e3 * _median(part):.0f} ms", loc="left")
        ax.set_ylabel("processor time [ms]")
        ax.yaxis.set_major_locator(FixedLocator(TICKS))
        ax.yaxis.set_major_formatter(ScalarFormatter())
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_ylim(TICKS[0], max(1.1 * TICKS[-1], ax.get_ylim()[1]))
    return figure


def snapshots(part: Flight) -> Figure:
    """Figure 10: guided control steps with MPPI's samples and result, then later ones."""
    guided = [step for step, call in enumerate(part.sampled) if call is not None]
    last, (first, later) = len(part.frame) - 1, SNAPSHOTS
    after = np.linspace(max(guided, default=0) + 1, 0.8 * last, later).round().astype(int).tolist()
    steps = sorted({min(step, last) for step in (*guided[:first], *after)})
    figure = draw.snapshots_figure(part.frame, part.plans, part.course, steps, part.period)
    for i, step in enumerate(steps):
        call = part.sampled[step]
        for ax, plane in zip(figure.axes[2 * i : 2 * i + 2], VIEWS, strict=True):
            if call is not None:
                drawing.draw_samples(ax, call.samples(SAMPLES), plane)
                drawing.draw_plan(ax, call.plan[:, call.problem.position].numpy(), plane)
    held = figure.legends[0].legend_handles
    figure.legends[0].remove()
    legend(figure, [*(handle for handle in held if handle is not None), *drawing.handles("samples", "plan")])
    return figure


def states(part: Flight) -> Figure:
    """Figure 12: states over time, with names in each panel of several lines."""
    figure = draw.states_figure(part.fine, part.course.goal)
    figure.legends[0].remove()
    for ax, names in zip(figure.axes[3:], ("xyz", ("roll", "pitch", "yaw"), "xyz"), strict=True):
        lines = [Line2D([], [], color=colour) for colour in PALETTE[:3]]
        ax.legend(lines, list(names), fontsize=SMALL, frameon=False)
    legend(figure, [Line2D([], [], color=INK, linestyle=":", label="target")])
    return figure


def _median(part: Flight, rows: slice = slice(None)) -> float:
    """Of the planner's time in some control steps, s."""
    return float(part.frame["planner_seconds"].iloc[rows].median())


SHOWN = (  # of the rows of `table`
    "outcome", "flight time (s)", "smallest distance / (r_obs + r_veh)", "steps with guidance",
    "plans flown with a violation above 1e-3", "largest violation of a plan", "planner's processor time, median (ms)",
    "tracker's processor time per control step, median (ms)",
)  # fmt: skip


def table(flights: Sequence[Flight]) -> pd.DataFrame:
    """A column per planner, a row per quantity."""
    own = next(_median(part) for part in flights if part.name == "gco")
    return pd.DataFrame({part.name: _column(part, own) for part in flights})


def _column(part: Flight, own: float) -> dict[str, str]:
    """The quantities of a flight; `own` is the median of the planner's time with gco, s."""
    frame, fine, row = part.frame, part.fine, part.row
    t = flight(fine, "t")["t"]
    near = part.course.nearness(fine[["x0", "x1", "x2"]].to_numpy(), t)
    tracked = 1e3 * frame["tracker_seconds"]
    thrust = fine[["f1", "f2", "f3", "f4"]].to_numpy()
    return {
        "outcome": part.end.outcome.name,
        "flight time (s)": f"{part.end.flight_time:.2f}",
        "smallest distance / (r_obs + r_veh)": f"{near.min():.3f}",
        "control steps": f"{len(frame)}",
        "steps with guidance": f"{int((frame['guided'] > 0).sum())}",
        "violation accepted in a new plan": "any" if np.isinf(part.tolerance) else f"{part.tolerance:g}",
        "shifted plans": f"{row['shifted_plans']}",
        "plans flown with a violation above 1e-3": f"{int((frame['violation'] > INFEASIBLE).sum())}",
        "largest violation of a plan": f"{frame['violation'].max():.1e}",
        "planner's processor time, first step (ms)": f"{1e3 * frame['planner_seconds'].iloc[0]:.0f}",
        "planner's processor time, median (ms)": f"{1e3 * _median(part):.0f}",
        f"the same, median of the first {BEGIN} steps (ms)": f"{1e3 * _median(part, slice(BEGIN)):.0f}",
        f"the same, median of the last {END} steps (ms)": f"{1e3 * _median(part, slice(-END, None)):.0f}",
        "the same, median as a multiple of gco's": f"{_median(part) / own:.1f}",
        "tracker's processor time per control step, median (ms)": f"{tracked.median():.1f}",
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
    return page.markdown(["", *rows.columns], rows.reset_index().to_numpy())


def animate(flights: Sequence[Flight], outputs: Path) -> None:
    """The mission with gco, and how gco frees a planar vehicle."""
    one = next(part for part in flights if part.name == "gco")
    mission_animation(one.frame, one.plans, one.course, one.period, outputs / "mission.gif", "gco")
    free(outputs / "freeing.gif")


def free(path: Path) -> Path:
    """Animate one solve by gco: where it is caught, candidates along paths, the proposal, and the result."""
    _, solution, layouts = solve(0)
    assert solution.search is not None and solution.search.caught is not None
    first, caught = solution.search.comparisons[0], solution.search.caught[1][:, :, :2].numpy()
    fate = first.fate[0]
    pictures = [Picture("1  AL-iLQR is caught", caught, seconds=1.5)]
    every = first.tracked[0, fate != Fate.ABSENT, :, :2].numpy()
    for count in range(6, len(every), 6):
        pictures.append(Picture(f"2  {len(every)} candidates track paths", every[:count], caught, 0.1))
    pictures.append(Picture(f"2  {len(every)} candidates track paths", every, caught, 1.2))
    sets = first.relaxed[0, fate >= Fate.RELAXED, :, :2].numpy()
    pictures.append(Picture(f"3  relaxed: {len(sets)} are sound", sets, seconds=1.5))
    few = first.refined[0, first.cost[0].isfinite(), :, :2].numpy()
    pictures.append(Picture(f"4  refined: {len(few)} end feasible", few, seconds=1.5))
    proposal = first.refined[0, fate == Fate.PROPOSED, :, :2].numpy()
    pictures.append(Picture("5  the cheapest is the proposal", proposal, few, 1.5))
    final = solution.X[:1, :, :2].numpy()
    pictures.append(Picture("6  solved on from there: the result", final, caught, 2.5))
    assert layouts.start is not None and layouts.goal is not None
    assert layouts.vehicle_radius is not None and layouts.goal_radius is not None
    start, goal = (np.broadcast_to(x, (1, x.shape[-1]))[0, :2] for x in (layouts.start, layouts.goal))
    margin, scene = layouts.vehicle_radius, (layouts.centers[0], layouts.radii[0] + layouts.vehicle_radius)
    return planar_animation(pictures, *scene, (start, goal), path, margin, layouts.goal_radius)
