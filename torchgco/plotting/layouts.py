"""Layouts as maps with the trajectories flown through them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.base.errors import InputError
from torchgco.plotting.bodies import ABOVE, Plane
from torchgco.plotting.grid import grid, put_head
from torchgco.plotting.maps import draw_map
from torchgco.plotting.scene import Arrays, Pass, Scene, contacts, flown, passes, scene_of, view
from torchgco.plotting.style import INK, SMALL, TITLE, solver_colours, solver_dash, tasks_of

STONE, EDGE = "#CFC8BA", "#A39B8B"
SIDE: Plane = (0, 2)
TALLEST = 1.5  # heights of a panel as a share of its width
TRAIL = 1.0  # s of a moving obstacle's way that are drawn
# Shares of the way from start to goal: how near obstacles are that a cut misses, how far moving ones that are left out,
# and what hasn't moved.
NEAR, FAR, STILL = 0.05, 0.15, 0.01
INFEASIBLE, SHORT = "infeasible", "feasible, short of the goal"


@dataclass(frozen=True)
class Flight:
    """One solver's trajectory through one layout."""

    path: np.ndarray  # (N+1, d) m
    end: str  # "" at the goal, else INFEASIBLE or SHORT
    contacts: np.ndarray  # (C, d) m
    still: bool  # it stays at the start


def layout_grid(
    layouts: Arrays,
    trajectories: Arrays,
    trials: pd.DataFrame,
    columns: int | None = None,
    rows: int = 3,
) -> Figure:
    """Maps of the first columns x rows layouts with each solver's trajectories; in space also their side views.

    Args:
        layouts: arrays of a layout file: centers (L, M, d) and radii (L, M) in metres, and, where present, velocities
            (L, M, d), boxes, start and goal ((n,) or (L, n)), vehicle_radius, goal_radius, dt, layout (L,) ids.
        trajectories: states X (L, N+1, n) by solver, positions first, nan where there is none; the first solver is the
            one under study, drawn over the others.
        trials: with columns scenario, model, layout, solver, feasible, reached.
        columns: default: 4 in the plane, 3 in space.

    Obstacles are filled as they are and outlined at the vehicle's radius from their sides, as the vehicle is drawn as a
    point. In space each is cut at the height (in the side view: at the y) that the first solver has at its x; those
    that this cut misses are dotted where they are near. A moving obstacle is drawn where it comes closest to the first
    solver's trajectory, if it comes near. Crosses mark contact, at the knots and between them.

    Raises:
        InputError: the trajectories don't fit the layouts, or one has no row in `trials`.
    """
    count = len(layouts["radii"])
    paths = {solver: np.asarray(states, dtype=float) for solver, states in trajectories.items()}
    for solver, states in paths.items():
        if states.ndim != 3 or len(states) != count:
            raise InputError(f"trajectories.{solver}", f"shape ({count}, N+1, n)", states.shape)
    scene = scene_of(layouts)
    columns = columns or (4 if scene.dimension == 2 else 3)
    count = min(count, columns * rows)
    flights = flights_of(scene, {solver: states[:count] for solver, states in paths.items()}, trials)
    boxes = views(scene, flights, count, min(columns, count))
    planes = (ABOVE,) if scene.dimension == 2 else (ABOVE, SIDE)
    figure, axes = grid(boxes, count, min(columns, count), planes)
    drawn: set[str] = set()
    for i in range(count):
        drawn |= draw_layout(dict(zip(planes, axes[i], strict=True)), scene, i, flights)
        axes[i][0].set_title(f"layout {scene.ids[i]}", fontsize=TITLE, loc="left", color=INK)
    put_head(figure, _title(trials), _handles(scene, flights, drawn))
    return figure


def draw_layout(axes: Mapping[Plane, Axes], scene: Scene, i: int, flights: Mapping[str, list[Flight]]) -> set[str]:
    """Draw layout i from one side or several; returns the kinds of drawn shapes and marks, for the legend."""
    here, drawn = {solver: row[i] for solver, row in flights.items()}, set()
    path = _leading(scene, i, [flight.path for flight in here.values()])
    lead = passes(scene, i, path)
    for plane, ax in axes.items():
        drawn |= draw_obstacles(ax, scene, i, lead, plane)
        if scene.map is not None:
            draw_map(ax, scene.map, flown(path), plane, scene.margin, {"facecolor": STONE, "edgecolor": EDGE})
            drawn |= {"own", "grown"} if scene.margin > 0 else {"own"}
        drawn |= _paths(ax, scene, i, here, plane)
        draw_targets(ax, scene, i, plane)
    return drawn


def flights_of(scene: Scene, paths: Mapping[str, np.ndarray], trials: pd.DataFrame) -> dict[str, list[Flight]]:
    table = trials.drop_duplicates(["solver", "layout"]).set_index(["solver", "layout"])
    verdicts = table[["feasible", "reached"]].astype("boolean").fillna(False)
    found: dict[str, list[Flight]] = {}
    for solver, states in paths.items():
        found[solver] = []
        for i, X in enumerate(states):
            if (solver, scene.ids[i]) not in verdicts.index:
                raise InputError("trials", f"a row of {solver} for layout {scene.ids[i]}", "none")
            row = verdicts.loc[(solver, scene.ids[i])]
            end = "" if row["reached"] else SHORT if row["feasible"] else INFEASIBLE
            path = X[:, : scene.dimension]
            moved = np.linalg.norm(flown(path) - scene.start[i], axis=-1).max(initial=0.0)
            still = len(flown(path)) > 1 and bool(moved < STILL * _way(scene, i))
            found[solver].append(Flight(path, end, contacts(scene, i, path), still))
    return found


def _way(scene: Scene, i: int) -> float:
    """The distance from start to goal, m; nan where unknown."""
    return float(np.linalg.norm(scene.goal[i] - scene.start[i]))


def views(scene: Scene, flights: Mapping[str, list[Flight]], count: int, columns: int) -> list[np.ndarray]:
    """Lower and upper corners (2, d), m, of the maps in each row of panels; x is the same in all rows."""
    boxes = []
    for first in range(0, count, columns):
        shown = range(first, min(first + columns, count))
        here = [row[i] for row in flights.values() for i in shown]
        whole = [flown(flight.path) for flight in here if not flight.end]
        boxes.append(view(scene, shown, whole, [flown(flight.path) for flight in here if flight.end]))
    low, high = min(box[0, 0] for box in boxes), max(box[1, 0] for box in boxes)
    tallest = max(float(np.ptp(box, axis=0)[1:].max()) for box in boxes)
    wider = max(0.0, 0.5 * (tallest / TALLEST - (high - low)))
    for box in boxes:
        box[:, 0] = low - wider, high + wider
    return boxes


def _leading(scene: Scene, i: int, paths: list[np.ndarray]) -> np.ndarray:
    """The path (K, d) that says where obstacles are cut: the first solver's, or the first that leaves the start.

    Where none does, it is the straight line to the goal.
    """
    for path in paths:
        if len(flown(path)) > 1 and np.ptp(flown(path), axis=0).max() > 0:
            return path
    return np.linspace(scene.start[i], scene.goal[i], 100)


def draw_obstacles(ax: Axes, scene: Scene, i: int, lead: list[Pass], plane: Plane) -> set[str]:
    """Draw a layout's obstacles; returns the kinds of drawn shapes, for the legend."""
    own, grown, near = [], [], []
    moving = False
    for body, place in zip(scene.bodies[i], lead, strict=True):
        if body.moving and place.distance > FAR * _way(scene, i):
            continue
        if scene.dimension == 2:
            cut = [body.outline(margin, plane, place.t) for margin in (0.0, scene.margin)]
        else:
            at = float(np.delete(place.place, plane)[0])
            cut = [body.section(plane, at, margin, place.t) for margin in (0.0, scene.margin)]
        own += [shape for shape in cut[:1] if shape is not None]
        grown += [shape for shape in cut[1:] if shape is not None and scene.margin > 0]
        if cut[1] is None and place.distance < NEAR * _way(scene, i):
            near.append(body.outline(0.0, plane, place.t))
        if body.moving and (cut[1] is not None or place.distance < NEAR * _way(scene, i)):
            moving = True
            way = body.at(np.array([max(0.0, place.t - TRAIL), place.t]))[:, plane]
            ax.plot(*way.T, color=EDGE, linewidth=0.9, zorder=1)
            look: dict[str, Any] = {"ha": "center", "va": "center", "clip_on": True, "zorder": 5}
            ax.text(float(way[-1, 0]), float(way[-1, 1]), f"{place.t:.1f}", fontsize=SMALL - 2, color=INK, **look)
    looks: dict[str, dict[str, Any]] = {
        "near": {"facecolor": "none", "edgecolor": EDGE, "linewidth": 0.7, "linestyle": ":"},
        "own": {"facecolor": STONE, "linewidth": 0.0},
        "grown": {"facecolor": "none", "edgecolor": EDGE, "linewidth": 0.6},
    }
    shapes = {"near": near, "own": own, "grown": grown}
    for zorder, (kind, held) in enumerate(shapes.items()):
        if held:
            ax.add_collection(PolyCollection(held, zorder=0.2 + 0.1 * zorder, **looks[kind]), autolim=False)
    return {kind for kind, held in shapes.items() if held} | ({"moving"} if moving else set())


def _paths(ax: Axes, scene: Scene, i: int, flights: Mapping[str, Flight], plane: Plane) -> set[str]:
    """Draw the flights, the first over the others; returns the kinds of drawn marks, for the legend."""
    colours, drawn = solver_colours(flights), set()
    for level, (solver, flight) in enumerate(reversed(list(flights.items()))):
        look: dict[str, Any] = {"color": colours[solver], "zorder": 3 + level / len(flights)}
        path = flown(flight.path)
        if not flight.still:
            # The first is the thinnest: one of the same course shows at its sides.
            wide = 1.6 if level == len(flights) - 1 else 2.2
            ax.plot(*path[:, plane].T, linewidth=wide, linestyle=solver_dash(solver), **look)
        marks = {"contact": flight.contacts}
        # A solver that returned nothing has its mark at the start.
        last = path[-1:] if len(path) else scene.start[i][None]
        if flight.end == SHORT and not flight.still:
            marks["short"] = last
        if flight.end == INFEASIBLE and len(flight.contacts) == 0:
            marks["infeasible"] = last
        for kind, places in marks.items():
            if len(places):
                drawn.add(kind)
                ax.plot(*places[:, plane].T, **look | {"zorder": 4 + level / len(flights)}, **_marker(kind))
    return drawn


def _marker(kind: str) -> dict[str, Any]:
    """The look of a mark, the same on the map and in the legend."""
    shapes: dict[str, dict[str, Any]] = {
        "contact": {"marker": "X", "markeredgecolor": "white", "markeredgewidth": 0.6, "markersize": 7},
        "short": {"marker": "o", "markerfacecolor": "white", "markersize": 5.5},
        "infeasible": {"marker": "D", "markeredgecolor": "white", "markersize": 6},
    }
    return {"linestyle": "none", **shapes[kind]}


def draw_targets(ax: Axes, scene: Scene, i: int, plane: Plane) -> None:
    """The start under the flights' marks, the goal over them."""
    start, goal = scene.start[i][list(plane)], scene.goal[i][list(plane)]
    look: dict[str, Any] = {"color": INK, "linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.5}
    ax.plot(*start, marker="s", markersize=5, zorder=2.5, **look)
    ax.plot(*goal, marker="*", markersize=10, zorder=6, **look)
    if np.isfinite(scene.goal_radius):
        ring: dict[str, Any] = {"fill": False, "color": INK, "linestyle": "--", "linewidth": 0.8}
        ax.add_patch(Circle((goal[0], goal[1]), scene.goal_radius, **ring))


def _title(trials: pd.DataFrame) -> str:
    tasks = [title for title, _ in tasks_of(trials)]
    seeds = trials["seed"].unique() if "seed" in trials else []
    return ", ".join([*tasks[:1], *(f"seed {seed}" for seed in seeds[:1])]) if len(tasks) == 1 else ""


def _handles(scene: Scene, flights: Mapping[str, list[Flight]], drawn: set[str]) -> list[Artist]:
    """Entries of the legend, for what is drawn alone."""
    handles: list[Artist] = []
    colours = solver_colours(flights)
    for solver, row in flights.items():
        still = all(flight.still for flight in row)
        look: dict[str, Any] = {"linestyle": "none" if still else solver_dash(solver), "linewidth": 1.6}
        handles.append(
            Line2D([], [], color=colours[solver], label=f"{solver}: stays at the start" if still else solver, **look)
        )
    disc = " and its radius" if np.isfinite(scene.goal_radius) else ""
    point: dict[str, Any] = {"color": INK, "linestyle": "none"}
    handles.append(Line2D([], [], marker="s", markersize=5, label="start", **point))
    handles.append(Line2D([], [], marker="*", markersize=10, label=f"goal{disc}", **point))
    words = {"contact": "contact", "short": SHORT, "infeasible": "infeasible without contact"}
    handles += [
        Line2D([], [], color=INK, label=label, **_marker(kind)) for kind, label in words.items() if kind in drawn
    ]
    first = next(iter(flights), "the flight")
    where = f", cut at the height (below: at the y) of {first}" if scene.dimension == 3 else ""
    outline: dict[str, Any] = {"facecolor": "none", "edgecolor": EDGE}
    shapes: dict[str, Artist] = {
        "own": Patch(facecolor=STONE, label=f"obstacle{where}"),
        "grown": Patch(label="plus the vehicle's radius", **outline),
        "near": Patch(linestyle=":", label=f"near {first}, missed by this cut", **outline),
        "moving": Line2D(
            [], [], color=EDGE, linewidth=0.9, label=f"its last second; number: time [s] when {first} passes"
        ),
    }
    return [*handles, *(handle for kind, handle in shapes.items() if kind in drawn)]
