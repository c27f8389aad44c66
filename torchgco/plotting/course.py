"""The obstacles, gates and the goal of a mission, and one instant of it from above or from the side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from torchgco.base.errors import InputError
from torchgco.maps.distance import DistanceField
from torchgco.obstacles.base import ADMITTED
from torchgco.plotting import trajectory as draw
from torchgco.plotting.bodies import Ball, Solid
from torchgco.plotting.gates import Outline, draw_gates
from torchgco.plotting.maps import draw_map, map_handles
from torchgco.plotting.scene import Scene, contacts, view
from torchgco.plotting.style import INK, PALETTE
from torchgco.plotting.vehicle_body import VehicleBody

VEHICLE_COLOUR = PALETTE[5]
VIEWS: tuple[draw.Plane, draw.Plane] = (draw.ABOVE, draw.SIDE)
POSITION = ("x0", "x1", "x2")
DRAWN_STATES = tuple(f"x{i}" for i in range(13))  # of the plant: those that place it and turn it come first
CONTACT: dict[str, Any] = {
    "marker": "X", "color": draw.CROSS, "markeredgecolor": "white", "markersize": 9, "linestyle": "none",
}  # fmt: skip


@dataclass(frozen=True)
class Course:
    """The obstacles of one layout, and the goal; lengths in metres.

    Args:
        bodies: see `bodies.bodies`.
        goal: (3,).
        goal_radius: within which the goal counts as reached.
        vehicle_radius: r_veh; of a vehicle with a body that of the ball about its position that the body holds.
        map: of the same space, or None.
        gates: see `gates.outlines`.
        body: of the vehicle; None: it is a ball.

    A `track` has the positions (T, 3), m, of a vehicle that is a ball, or the states (T, 13) of one with a body.

    Raises:
        InputError: a goal of another shape.
    """

    bodies: tuple[Solid, ...]
    goal: np.ndarray
    goal_radius: float
    vehicle_radius: float = 0.36
    map: DistanceField | None = None
    gates: tuple[Outline, ...] = ()
    body: VehicleBody | None = None

    def __post_init__(self) -> None:
        if np.shape(self.goal) != (3,):
            raise InputError("course.goal", "shape (3,)", np.shape(self.goal))

    def track(self, frame: pd.DataFrame) -> np.ndarray:
        """The track of a frame with columns x0 to x2, or of a vehicle with a body x0 to x12."""
        columns = POSITION if self.body is None else DRAWN_STATES
        return np.stack(tuple(flight(frame, *columns).values()), axis=-1)

    @property
    def reaches(self) -> np.ndarray:
        """r_obs + r_veh of each obstacle, (M,), or of each ball of a body, (P M,).

        Of a box, r_obs is the radius that rounds it, of a map, the last one, 0.
        """
        radii = [self.vehicle_radius] if self.body is None else self.body.radii.tolist()
        return np.concatenate([self._reaches(radius) for radius in radii])

    def _reaches(self, radius: float) -> np.ndarray:
        reaches = [body.radius + radius for body in self.bodies]
        return np.array(reaches if self.map is None else [*reaches, radius])

    def distances(self, positions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distances (M, T) of positions (T, 3) at times t (T,), s, from centres, from sides of boxes, the map."""
        distances = [body.distance(positions, t) for body in self.bodies]
        distances += [] if self.map is None else [self.map.distance(positions).numpy()]
        return np.array(distances).reshape(len(distances), len(t))

    def infeasible(self, positions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Which positions (T, 3) at times t (T,), s, lie more than a millimetre inside an obstacle grown by r_veh."""
        return np.any(self.distances(positions, t) < self._reaches(self.vehicle_radius)[:, None] - ADMITTED, axis=0)

    def nearness(self, track: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Smallest of `distances` as a share of r_obs + r_veh, (T,), at times t (T,), s; inf without obstacles."""
        balls = [track] if self.body is None else list(self.body.balls(track).swapaxes(0, 1))
        away = np.concatenate([self.distances(ball, t) for ball in balls])
        return (away / self.reaches[:, None]).min(axis=0, initial=np.inf)

    def contacts(self, track: np.ndarray, period: float) -> np.ndarray:
        """Places (C, 3) where a track of control steps of `period` seconds touches an obstacle or the map."""
        return contacts(self._scene(track[:1]), 0, track[:, :3], period * np.arange(len(track)), track)

    def _scene(self, start: np.ndarray) -> Scene:
        fields = (self.bodies,), start[:, :3], self.goal[None], self.vehicle_radius, self.goal_radius
        return Scene(*fields, np.zeros(1), self.map, body=self.body)

    def limits(self, track: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of a box around goal, gates and track, a little wider where obstacles are."""
        reach = self.vehicle_radius if self.body is None else self.body.reach
        ways = [track[:, :3] + side * reach for side in (-1.0, 1.0)]
        ways += [corners + side * radius for corners, radius in self.gates for side in (-1.0, 1.0)]
        low, high = view(self._scene(track[:1]), [0], ways, [])
        return low, high


def draw_still(ax: Axes, course: Course, plane: draw.Plane) -> None:
    """What looks alike at all times: gates, and spheres at rest."""
    draw_gates(ax, list(course.gates), plane)
    _draw_bodies(ax, course, [body for body in course.bodies if _is_still(body)], 0.0, 0.0, plane)


def draw_instant(
    ax: Axes, course: Course, t: float, track: np.ndarray, plan: np.ndarray, period: float, plane: draw.Plane
) -> None:
    """Other obstacles at time t, s, the track flown so far with the vehicle at its end, and the plan (N+1, 3).

    Spheres are shown whole; boxes, capsules and maps are cut where the vehicle is, as they may be higher or wider than
    the view.

    Args:
        period: of the plan's knots, s; knots inside an obstacle at their own time are crossed.
    """
    changing = [body for body in course.bodies if not _is_still(body)]
    _draw_bodies(ax, course, changing, t, float(np.delete(track[-1], plane)[0]), plane)
    if course.map is not None:
        draw_map(ax, course.map, track[-1:, :3], plane, course.vehicle_radius, (draw.STONE, draw.EDGE))
    draw.draw_ends(ax, track[0, :3], course.goal, course.goal_radius, plane)
    ax.plot(*track[:, plane].T, color=INK, linewidth=1.4, zorder=3)
    infeasible = course.infeasible(plan, t + period * np.arange(len(plan)))
    draw.draw_trajectory(ax, plan, infeasible, plane, every=2, size=7.0)
    draw_contacts(ax, course.contacts(track, period), plane)
    look: dict[str, Any] = {"facecolor": VEHICLE_COLOUR, "edgecolor": INK, "linewidth": 0.8, "zorder": 6}
    if course.body is not None:
        ax.add_collection(PolyCollection(course.body.outlines(track[-1:], plane), **look), autolim=False)
        return
    ax.add_patch(Circle((float(track[-1, plane[0]]), float(track[-1, plane[1]])), course.vehicle_radius, **look))


def draw_contacts(ax: Axes, places: np.ndarray, plane: draw.Plane) -> None:
    """Mark places (C, 3) where the vehicle touched something."""
    ax.plot(*places[:, plane].T, **CONTACT, zorder=7)


def handles(course: Course, touched: bool) -> list[Artist]:
    """Entries of a legend: the contacts, where there are any, and what a map doesn't know."""
    entries: list[Artist] = [Line2D([], [], label="contact", **CONTACT)] if touched else []
    return [*entries, *map_handles(course.map)]


def _is_still(body: Solid) -> bool:
    return isinstance(body, Ball) and not body.moving


def _draw_bodies(ax: Axes, course: Course, bodies: Sequence[Solid], t: float, depth: float, plane: draw.Plane) -> None:
    """Obstacles at time t, s, filled, and outlined at the vehicle's radius; `depth` is its hidden coordinate, m."""
    full: dict[str, Any] = {"facecolor": draw.STONE, "linewidth": 0.5, "alpha": 0.6}
    grown: dict[str, Any] = {"facecolor": "none", "linewidth": 0.7, "linestyle": "--"}
    for margin, look in ((0.0, full), (course.vehicle_radius, grown)):
        shapes = [
            body.outline(margin, plane, t) if isinstance(body, Ball) else body.section(plane, depth, margin, t)
            for body in bodies
        ]
        if seen := [shape for shape in shapes if shape is not None]:
            ax.add_collection(PolyCollection(seen, edgecolor=draw.EDGE, zorder=0, **look), autolim=False)


def flight(frame: pd.DataFrame, *columns: str) -> dict[str, np.ndarray]:
    """Columns of a frame as arrays, by name.

    Raises:
        InputError: a missing column, no row, or rows of several missions.
    """
    missing = [name for name in columns if name not in frame.columns]
    if missing or frame.empty:
        raise InputError("frame", f"rows with columns {', '.join(columns)}", f"no {', '.join(missing) or 'rows'}")
    if "mission" in frame.columns and frame["mission"].nunique() > 1:
        raise InputError("frame", "rows of one mission", f"{frame['mission'].nunique()} missions")
    return {name: frame[name].to_numpy(dtype=float) for name in columns}
