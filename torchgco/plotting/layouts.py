"""Layouts as maps with the trajectories flown through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from torchgco.base.errors import InputError
from torchgco.obstacles.base import Obstacles
from torchgco.plotting.around import around_words
from torchgco.plotting.bodies import ABOVE, SIDE, Ball, Plane, Solid
from torchgco.plotting.gates import draw_gates
from torchgco.plotting.maps import draw_map, map_handles
from torchgco.plotting.scene import Arrays, Pass, Scene, contacts, distances, flown, leaving, passes, scene_of, view
from torchgco.plotting.style import DASHES, EDGE, INK, SMALL, TITLE, grid, put_head, solver_colours, tasks_of
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.plotting.ways import Way, Ways

ROCK = "#CFC8BA"
TALLEST = 1.5  # heights of a panel as a share of its width
TRAIL = 1.0  # s of a moving obstacle's way that are drawn
# Shares of the way from start to goal: how near obstacles are that a cut misses, how far moving ones that are left out,
# and what hasn't moved.
NEAR_SHARE, FAR_SHARE, STILL = 0.05, 0.15, 0.01
INFEASIBLE, SHORT = "infeasible", "feasible, short of the goal"
MARKED = {
    "contact": "contact", "passed": "passes a gate", "short": SHORT, "infeasible": "infeasible without contact",
    "away": "leaves the picture",
}  # fmt: skip


@dataclass(frozen=True)
class DrawnFlight:
    """One solver's trajectory through one layout, along the path that is judged."""

    path: np.ndarray  # (T, d) m
    end: str  # "" at the goal, else INFEASIBLE or SHORT
    contacts: np.ndarray  # (C, d) m
    still: bool  # it stays at the start
    way: Way


def layout_grid(
    layouts: Arrays,
    trajectories: Ways,
    trials: pd.DataFrame,
    columns: int | None = None,
    rows: int = 3,
    body: VehicleBody | None = None,
    position: slice | None = None,
    obstacles: Sequence[Sequence[Obstacles]] | None = None,
) -> Figure:
    """Maps of the first columns x rows layouts with each solver's trajectories; in space also their side views.

    Args:
        layouts: arrays of a layout file: centers (L, M, d) and radii (L, M) in metres, and, where present, velocities
            (L, M, d), boxes, start and goal ((n,) or (L, n)), vehicle_radius, goal_radius, dt, layout (L,) ids.
        trajectories: one for each layout by solver, nan where there is none; the first solver is the one under study,
            drawn over the others.
        trials: with columns scenario, model, layout, solver, feasible, reached.
        columns: default: 4 in the plane, 3 in space.
        body: of the vehicle, in the place of vehicle_radius: the first solver's is drawn at some times; None: a ball.
        position: its place in states; None: they begin with it.
        obstacles: those of the problems that were solved, a batch of one for each layout; None: the layouts' own.

    Obstacles are filled as they are and outlined at the vehicle's radius from their sides, as the vehicle is drawn as a
    point. In space each is cut at the height (in the side view: at the y) that the first solver has at its x; those
    that this cut misses are dotted where they are near. A moving obstacle is drawn where it comes closest to the first
    solver's trajectory, if it comes near, outlined in that solver's colour. Crosses mark contact, with the map too, of
    flights that aren't feasible, small discs where gates are passed. The line below counts flights that reach the goal
    around all obstacles instead of between them, where there are some.

    Raises:
        InputError: the trajectories don't fit the layouts, or one has no row in `trials`.
    """
    count = len(layouts["radii"])
    for solver, ways in trajectories.items():
        if len(ways) != count:
            raise InputError(f"trajectories.{solver}", f"{count} trajectories, one for each layout", len(ways))
    scene = scene_of(layouts, body, position, obstacles)
    columns = columns or (4 if scene.dimension == 2 else 3)
    count = min(count, columns * rows)
    flights = flights_of(scene, {solver: ways[:count] for solver, ways in trajectories.items()}, trials)
    boxes = views(scene, flights, count, min(columns, count))
    planes = (ABOVE,) if scene.dimension == 2 else (ABOVE, SIDE)
    figure, axes = grid(boxes, count, min(columns, count), planes)
    drawn: set[str] = set()
    for i in range(count):
        drawn |= draw_layout(dict(zip(planes, axes[i], strict=True)), scene, i, flights)
        axes[i][0].set_title(f"layout {scene.ids[i]}", fontsize=TITLE, loc="left", color=INK)
    reached = {name: [(i, flown(x.path)) for i, x in enumerate(row) if not x.end] for name, row in flights.items()}
    put_head(figure, _title(trials), _handles(scene, flights, drawn), around_words(scene, reached))
    return figure


def draw_layout(axes: Mapping[Plane, Axes], scene: Scene, i: int, flights: Mapping[str, list[DrawnFlight]]) -> set[str]:
    """Draw layout i from one side or several; returns the kinds of drawn shapes and marks, for the legend."""
    here, drawn = {solver: row[i] for solver, row in flights.items()}, set()
    path, clock = _leading(scene, i, list(here.values()))
    leads = {solver_colours(flights)[next(iter(flights), "")] if flights else EDGE: passes(scene, i, path, clock)}
    for plane, ax in axes.items():
        drawn |= draw_obstacles(ax, scene, i, leads, plane)
        drawn |= draw_others(ax, scene.others(i), flown(path), plane)
        if (field := scene.map_of(i)) is not None:
            drawn |= draw_map(ax, field, flown(path), plane, scene.margin, (ROCK, EDGE))
        drawn |= _paths(ax, scene, i, here, plane)
        draw_targets(ax, scene, i, plane)
    return drawn


def flights_of(scene: Scene, trajectories: Ways, trials: pd.DataFrame) -> dict[str, list[DrawnFlight]]:
    """The trajectories, one for each of the first layouts by solver, with the verdicts on them."""
    table = trials.drop_duplicates(["solver", "layout"]).set_index(["solver", "layout"])
    verdicts = table[["feasible", "reached"]].astype("boolean").fillna(False)
    by_solver: dict[str, list[DrawnFlight]] = {}
    for solver, ways in trajectories.items():
        by_solver[solver] = []
        for i, way in enumerate(ways):
            if (solver, scene.ids[i]) not in verdicts.index:
                raise InputError("trials", f"a row of {solver} for layout {scene.ids[i]}", "none")
            row = verdicts.loc[(solver, scene.ids[i])]
            end = "" if row["reached"] else SHORT if row["feasible"] else INFEASIBLE
            path = way.X[:, scene.position or slice(scene.dimension)]
            moved = np.linalg.norm(flown(path) - scene.start[i], axis=-1).max(initial=0.0)
            still = len(flown(path)) > 1 and bool(moved < STILL * _way(scene, i))
            touched = path[:0] if row["feasible"] else contacts(scene, i, path, way.clock, way.X)
            by_solver[solver].append(DrawnFlight(path, end, touched, still, way))
    return by_solver


def _way(scene: Scene, i: int) -> float:
    """The distance from start to goal, m; nan where unknown."""
    return float(np.linalg.norm(scene.goal[i] - scene.start[i]))


def views(scene: Scene, flights: Mapping[str, list[DrawnFlight]], count: int, columns: int) -> list[np.ndarray]:
    """Lower and upper corners (2, d), m, of the maps in each row of panels; x is the same in all rows."""
    boxes = []
    for first in range(0, count, columns):
        shown = range(first, min(first + columns, count))
        here = [row[i] for row in flights.values() for i in shown]
        whole = [flown(flight.path) for flight in here if not flight.end]
        if scene.body is not None:
            whole += [scene.body.extent(flight.way.X[: len(flown(flight.path))]) for flight in here if not flight.end]
        boxes.append(view(scene, shown, whole, [flown(flight.path) for flight in here if flight.end]))
    low, high = min(box[0, 0] for box in boxes), max(box[1, 0] for box in boxes)
    tallest = max(float(np.ptp(box, axis=0)[1:].max()) for box in boxes)
    wider = max(0.0, 0.5 * (tallest / TALLEST - (high - low)))
    for box in boxes:
        box[:, 0] = low - wider, high + wider
    return boxes


def _leading(scene: Scene, i: int, flights: list[DrawnFlight]) -> tuple[np.ndarray, np.ndarray]:
    """The path (K, d) that says where obstacles are cut: the first solver's, or the first that leaves the start; and
    the times (K,) there, s.

    Where none does, it is the straight line to the goal, at once.
    """
    for flight in flights:
        if len(flown(flight.path)) > 1 and np.ptp(flown(flight.path), axis=0).max() > 0:
            return flight.path, flight.way.clock
    return np.linspace(scene.start[i], scene.goal[i], 100), np.zeros(100)


def draw_obstacles(ax: Axes, scene: Scene, i: int, leads: Mapping[str, list[Pass]], plane: Plane) -> set[str]:
    """Draw a layout's obstacles; returns the kinds of drawn shapes, for the legend.

    Args:
        leads: where each of some trajectories passes them, by its colour. Obstacles at rest are cut where the first
            passes, moving ones drawn where each comes closest to them, dashed in its colour, with the vehicle as
            large as it is then: what lies between the two is their distance.
    """
    kinds = set[str]()
    for first, (colour, lead) in enumerate(leads.items()):
        drawn: dict[str, list[np.ndarray]] = {"near": [], "own": [], "grown": [], "moving": [], "vehicle": []}
        for body, pass_ in zip(scene.bodies[i], lead, strict=True):
            if (body.moving and _is_far(scene, i, pass_)) or (first > 0 and not body.moving):
                continue
            shape, grown = _shapes(body, scene, pass_, plane)
            near = pass_.distance < NEAR_SHARE * _way(scene, i)
            if shape is not None:
                drawn["moving" if body.moving else "own"].append(shape)
            if grown is not None and scene.margin > 0 and not body.moving:
                drawn["grown"].append(grown)
            if near and (shape if body.moving else grown) is None:
                drawn["near"].append(body.outline(0.0, plane, pass_.t))
            if body.moving and (grown is not None or near):
                kinds.add("moving")
                _draw_motion(ax, body, pass_, plane, colour)
                drawn["vehicle"].append(Ball(pass_.place, scene.margin, np.zeros(scene.dimension)).outline(0.0, plane))
        looks: dict[str, dict[str, Any]] = {
            "near": {"facecolor": "none", "edgecolor": EDGE, "linewidth": 0.7, "linestyle": ":"},
            "own": {"facecolor": ROCK, "linewidth": 0.0},
            "grown": {"facecolor": "none", "edgecolor": EDGE, "linewidth": 0.6},
            # Several trajectories pass a moving obstacle at several places, which may overlap.
            "moving": {"facecolor": (*to_rgb(ROCK), 0.35), "edgecolor": colour, "linewidth": 0.9, "linestyle": "--"},
            "vehicle": {"facecolor": (*to_rgb(colour), 0.25), "edgecolor": colour, "linewidth": 0.9},
        }
        for zorder, (kind, shapes) in enumerate(drawn.items()):
            if shapes:
                ax.add_collection(PolyCollection(shapes, zorder=0.2 + 0.1 * zorder, **looks[kind]), autolim=False)
                kinds.add(kind)
    return kinds


def draw_others(ax: Axes, others: Sequence[Obstacles], lead: np.ndarray, plane: Plane) -> set[str]:
    """Fill where obstacles of other kinds than balls and boxes are at t = 0; returns the kind, where any is seen.

    Args:
        lead: (K, d), at whose mean height, or y, they are cut in space.
    """
    drawn = set[str]()
    box = np.transpose([ax.get_xlim(), ax.get_ylim()])
    hidden = np.delete(np.arange(lead.shape[1]), plane)
    depth = float(lead[:, hidden[0]].mean()) if len(hidden) and len(lead) else 0.0
    for other in others:
        x, y, apart = distances(other, box, plane, depth)
        if bool((apart < 0).any()):
            ax.contourf(x, y, apart, levels=[-np.inf, 0.0], colors=[ROCK], zorder=0.3)
            drawn.add("others")
    return drawn


def moving_corners(scene: Scene, i: int, path: np.ndarray, clock: np.ndarray) -> list[np.ndarray]:
    """Lower and upper corners (2, d), m, of the moving obstacles where `draw_obstacles` draws them for a path."""
    boxes = []
    for body, pass_ in zip(scene.bodies[i], passes(scene, i, path, clock), strict=True):
        if body.moving and not _is_far(scene, i, pass_):
            corners = body.corners + body.at(pass_.t) - body.at(0.0)
            boxes.append(np.stack([corners.min(0) - body.radius, corners.max(0) + body.radius]))
    return boxes


def _is_far(scene: Scene, i: int, pass_: Pass) -> bool:
    """Whether a flight stays so far from an obstacle that moves that this isn't drawn."""
    return pass_.distance > FAR_SHARE * _way(scene, i)


def _shapes(body: Solid, scene: Scene, pass_: Pass, plane: Plane) -> list[np.ndarray | None]:
    """A body, and the same grown by the vehicle's radius: outlines, or cuts in space, None where there is nothing."""
    if scene.dimension == 2:
        return [body.outline(margin, plane, pass_.t) for margin in (0.0, scene.margin)]
    depth = float(np.delete(pass_.place, plane)[0])
    return [body.section(plane, depth, margin, pass_.t) for margin in (0.0, scene.margin)]


def _draw_motion(ax: Axes, body: Solid, pass_: Pass, plane: Plane, colour: str) -> None:
    """A moving body's last second, the time when it is passed, and the vehicle's centre then."""
    way = body.at(np.array([max(0.0, pass_.t - TRAIL), pass_.t]))[:, plane]
    ax.plot(*way.T, color=colour, linewidth=0.9, zorder=1)
    center = pass_.place[list(plane)]
    ax.plot(*center, color=colour, zorder=5, marker="o", markersize=2.5, linestyle="none")
    look: dict[str, Any] = {"ha": "center", "va": "center", "clip_on": True, "zorder": 5}
    ax.text(float(way[-1, 0]), float(way[-1, 1]), f"{pass_.t:.1f} s", fontsize=SMALL - 2, color=colour, **look)


def moving_handles(whose: str, colour: str) -> list[Artist]:
    """The legend's entries of moving obstacles, drawn when some trajectory passes them."""
    look: dict[str, Any] = {"edgecolor": colour, "linewidth": 0.9}
    passed = Patch(facecolor=(*to_rgb(ROCK), 0.35), linestyle="--", label=f"moving obstacle as {whose} passes", **look)
    vehicle = Patch(facecolor=(*to_rgb(colour), 0.25), label="and the vehicle then", **look)
    return [passed, vehicle, Line2D([], [], color=colour, linewidth=0.9, label="the obstacle's last second")]


def _paths(ax: Axes, scene: Scene, i: int, flights: Mapping[str, DrawnFlight], plane: Plane) -> set[str]:
    """Draw the flights, the first over the others; returns the kinds of drawn marks, for the legend."""
    colours, drawn = solver_colours(flights), set()
    for level, (solver, flight) in enumerate(reversed(list(flights.items()))):
        look: dict[str, Any] = {"color": colours[solver], "zorder": 3 + level / len(flights)}
        path = flown(flight.path)
        if not flight.still:
            # The first is the thinnest: one of the same course shows at its sides.
            wide = 1.6 if level == len(flights) - 1 else 2.2
            ax.plot(*path[:, plane].T, linewidth=wide, linestyle=DASHES[colours[solver]], **look)
            if scene.body is not None and level == len(flights) - 1:
                scene.body.draw(ax, flight.way.X[: len(path)], plane, colours[solver], 2.0)
                drawn.add("body")
        away = leaving(np.transpose([ax.get_xlim(), ax.get_ylim()]), path[:, plane])
        ended = _ended(flight, away is not None)
        # A solver that returned nothing has its mark at the start.
        last = path[-1:] if len(path) else scene.start[i][None]
        marks = {"contact": flight.contacts, "passed": flight.way.crossings} | {
            kind: last for kind in ended if kind == "infeasible" or (kind == "short" and not flight.still)
        }
        if away is not None:
            drawn.add("away")
            ax.plot(*away[0][:, None], **look | {"zorder": 6, "clip_on": False}, **marker("away", away[1]))
        for kind, places in marks.items():
            if len(places):
                drawn.add(kind)
                ax.plot(*places[:, plane].T, **look | {"zorder": 4 + level / len(flights)}, **marker(kind))
    return drawn


def ends(scene: Scene, flights: Mapping[str, list[DrawnFlight]], boxes: list[np.ndarray], columns: int) -> list[Artist]:
    """Entries of a legend for passed gates, and the ways in which flights end short of the goal without contact.

    Args:
        boxes: corners (2, d) of the maps in each row of `columns` layouts, seen from above.
    """
    kinds = set[str]()
    for row in flights.values():
        for i, flight in enumerate(row):
            box, path = boxes[i // columns][:, ABOVE], flown(flight.path)
            kinds |= {"passed"} if len(flight.way.crossings) else set()
            if not flight.still:
                kinds |= _ended(flight, leaving(box, path[:, ABOVE]) is not None)
    return marked(kinds, scene)


def marked(kinds: set[str], scene: Scene) -> list[Artist]:
    """Entries of a legend for these marks; what isn't known to keep clear is not said to."""
    said = MARKED if scene.sized else MARKED | {"infeasible": INFEASIBLE}
    return [Line2D([], [], color=INK, label=said[kind], **marker(kind)) for kind in MARKED if kind in kinds]


def ends_shown(scene: Scene) -> list[Line2D]:
    """Entries of a legend for start and goal, where they are known."""
    point: dict[str, Any] = {"color": INK, "linestyle": "none"}
    disc = " and its radius" if np.isfinite(scene.goal_radius) else ""
    shown = (scene.start, "s", 5, "start"), (scene.goal, "*", 10, f"goal{disc}")
    return [
        Line2D([], [], marker=mark, markersize=size, label=label, **point)
        for places, mark, size, label in shown
        if np.isfinite(places).all(-1).any()
    ]


def _ended(flight: DrawnFlight, away: bool) -> set[str]:
    """The marks at the end of a flight that moves; `away`: it ends outside of the picture."""
    if away:
        return {"away"}
    if flight.end == SHORT:
        return {"short"}
    return {"infeasible"} if flight.end == INFEASIBLE and len(flight.contacts) == 0 else set()


def marker(kind: str, angle: float = 0.0) -> dict[str, Any]:
    """The look of a mark, the same on the map and in the legend; an arrow's angle, rad."""
    shapes: dict[str, dict[str, Any]] = {
        "contact": {"marker": "X", "markeredgecolor": "white", "markeredgewidth": 0.6, "markersize": 7},
        "passed": {"marker": "o", "markeredgecolor": "white", "markeredgewidth": 0.6, "markersize": 5},
        "short": {"marker": "o", "markerfacecolor": "white", "markersize": 5.5},
        "infeasible": {"marker": "D", "markeredgecolor": "white", "markersize": 6},
        "away": {"marker": (3, 0, np.rad2deg(angle) - 90.0), "markeredgecolor": "white", "markersize": 9},
    }
    return {"linestyle": "none", **shapes[kind]}


def draw_targets(ax: Axes, scene: Scene, i: int, plane: Plane) -> None:
    """The start under the flights' marks, the goal over them; gates with their numbers."""
    start, goal = scene.start[i][list(plane)], scene.goal[i][list(plane)]
    look: dict[str, Any] = {"color": INK, "linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.5}
    ax.plot(*start, marker="s", markersize=5, zorder=2.5, **look)
    ax.plot(*goal, marker="*", markersize=10, zorder=6, **look)
    if scene.gates is not None:
        balls = scene.gates[i][np.isfinite(scene.gates[i]).all(axis=1)]
        draw_gates(ax, [(ball[None, :-1], float(ball[-1])) for ball in balls], plane)
    if np.isfinite(scene.goal_radius):
        ring: dict[str, Any] = {"fill": False, "color": INK, "linestyle": "--", "linewidth": 0.8}
        ax.add_patch(Circle((goal[0], goal[1]), scene.goal_radius, **ring))


def _title(trials: pd.DataFrame) -> str:
    tasks = [title for title, _ in tasks_of(trials)]
    seeds = trials["seed"].unique() if "seed" in trials else []
    return ", ".join([*tasks[:1], *(f"seed {seed}" for seed in seeds[:1])]) if len(tasks) == 1 else ""


def _handles(scene: Scene, flights: Mapping[str, list[DrawnFlight]], drawn: set[str]) -> list[Artist]:
    """Entries of the legend, for what is drawn alone."""
    handles: list[Artist] = []
    colours = solver_colours(flights)
    for solver, row in flights.items():
        still = all(flight.still for flight in row)
        look: dict[str, Any] = {"linestyle": "none" if still else DASHES[colours[solver]], "linewidth": 1.6}
        handles.append(
            Line2D([], [], color=colours[solver], label=f"{solver}: stays at the start" if still else solver, **look)
        )
    handles += [*ends_shown(scene), *marked(drawn, scene)]
    first = next(iter(flights), "the flight")
    where = f", cut at the height (below: at the y) of {first}" if scene.dimension == 3 else ""
    outline: dict[str, Any] = {"facecolor": "none", "edgecolor": EDGE}
    shapes: dict[str, Artist] = {
        "own": Patch(facecolor=ROCK, label=f"obstacle{where}"),
        "grown": Patch(label="plus the vehicle's radius", **outline),
        "others": Patch(facecolor=ROCK, label="obstacle, plus the vehicle's radius"),
        "near": Patch(linestyle=":", label=f"near {first}, missed by this cut", **outline),
        "body": Patch(facecolor="none", edgecolor=INK, label=f"the body of {first}, at some times"),
    }
    handles += [handle for kind, handle in shapes.items() if kind in drawn]
    handles += moving_handles(first, colours.get(first, EDGE)) if "moving" in drawn else []
    return [*handles, *map_handles(scene.map)]
