"""A mission in unknown space from above: what the vehicle knows of the world, over what there is."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.base.errors import InputError
from torchgco.missions.log import MissionLog, SeenLog
from torchgco.plotting import trajectory as draw
from torchgco.plotting.course import VEHICLE_COLOUR, Course, draw_contacts, handles
from torchgco.plotting.style import INK, PALETTE, legend, tidy

CELLS = ("unknown", "known to be free", "known to be occupied")
SHADES = ListedColormap(["#9A9A9A", "#F4F4F4", "#3B3B3B"])


def seen_figure(log: MissionLog, b: int, course: Course, step: int, reach: float = np.nan) -> Figure:
    """One control step of mission b: its map at the vehicle's height, obstacles, the way flown, the safe plan.

    Args:
        course: obstacles and goal of the mission.
        step: from 0.
        reach: range of the sensor, m, drawn as a circle; NaN: none.

    Raises:
        InputError: a log without a sensor, or a step that wasn't flown.
    """
    seen = _seen(log, b, step)
    low, high = seen.corner, seen.corner + seen.resolution * np.array(seen.shape)
    width = 9.0
    figure = Figure(figsize=(width, 0.9 + width * (high[1] - low[1]) / (high[0] - low[0])), layout="constrained")
    _draw(figure.subplots(), log, b, course, step, seen.state(step), reach)
    touched = len(course.contacts(_track(log, b, int(log.steps()[b]) - 1), log.period)) > 0
    legend(figure, [*_handles(), *handles(course, touched)])
    return figure


def _seen(log: MissionLog, b: int, step: int) -> SeenLog:
    if not log.seen:
        raise InputError("log", "a mission with a sensor", "no map")
    if not 0 <= step < int(log.steps()[b]):
        raise InputError("step", f"one of the {int(log.steps()[b])} control steps that mission {b} flew", step)
    return log.seen[b]


def _handles() -> list[Artist]:
    """Entries of the legend."""
    cells = [Patch(facecolor=SHADES(i), edgecolor=INK, label=label) for i, label in enumerate(CELLS)]
    rim = Patch(facecolor="none", edgecolor=PALETTE[0], label="obstacle as it is")
    lines = {"flown": INK, "safe plan, to where it rests": PALETTE[2]}
    return [*cells, rim, *(Line2D([], [], color=colour, label=label) for label, colour in lines.items())]


def _track(log: MissionLog, b: int, step: int) -> np.ndarray:
    """The positions (step + 1, 3) flown up to a control step, m."""
    return log.x[b, : step + 1, 0, :3].numpy()


def _draw(ax: Axes, log: MissionLog, b: int, course: Course, step: int, state: np.ndarray, reach: float) -> None:
    seen, track = log.seen[b], _track(log, b, step)
    low, high = seen.corner, seen.corner + seen.resolution * np.array(seen.shape)
    place, t = track[-1], step * log.period
    level = int(np.clip((place[2] - low[2]) / seen.resolution, 0, seen.shape[2] - 1))
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    ax.imshow(state[:, :, level].T, origin="lower", extent=extent, cmap=SHADES, vmin=0, vmax=2, interpolation="nearest")
    sections = [body.section(draw.ABOVE, float(place[2]), t=t) for body in course.bodies]
    rims = [section for section in sections if section is not None]
    ax.add_collection(PolyCollection(rims, facecolors="none", edgecolors=PALETTE[0], linewidths=0.8))
    plan = seen.safe[step]
    ax.plot(*track[:, :2].T, color=INK, lw=1.2)
    ax.plot(*plan[:, :2].T, color=PALETTE[2], lw=1.6)
    ax.plot(*plan[-1, :2], "s", color=PALETTE[2], ms=4)
    ax.add_patch(Circle((place[0], place[1]), course.vehicle_radius, color=VEHICLE_COLOUR, zorder=5))
    ax.add_patch(Circle((course.goal[0], course.goal[1]), course.goal_radius, fill=False, color=INK, lw=1.2))
    draw_contacts(ax, course.contacts(track, log.period), draw.ABOVE)
    if np.isfinite(reach):
        ax.add_patch(Circle((place[0], place[1]), reach, fill=False, color=VEHICLE_COLOUR, lw=0.6, ls=":"))
    ax.set_xlim(extent[:2])
    ax.set_ylim(extent[2:])
    ax.set_aspect("equal")
    tidy(ax, f"{t:.1f} s, {np.linalg.norm(log.x[b, step, 0, 3:6].numpy()):.1f} m/s", grid=None)
