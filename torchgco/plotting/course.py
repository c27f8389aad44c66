"""The obstacles and the goal of a mission, and one instant of it from above or from the side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from torchgco.base.errors import InputError
from torchgco.plotting import trajectory as draw
from torchgco.plotting.style import INK, PALETTE

VEHICLE = PALETTE[5]
VIEWS: tuple[draw.Plane, draw.Plane] = (draw.ABOVE, draw.SIDE)
POSITION = ("x0", "x1", "x2")
SPACE = 0.3  # m around what a view shows


@dataclass(frozen=True)
class Course:
    """Spheres, at rest or moving, and the goal; lengths in metres.

    Args:
        centers: at t = 0, (M, 3); nan where a sphere is absent.
        inflated_radii: r_obs + r_veh, (M,); nan where a sphere is absent.
        goal: (3,).
        goal_radius: within which the goal counts as reached.
        velocities: (M, 3), m/s; None: at rest.
        vehicle_radius: r_veh.

    Raises:
        InputError: shapes that don't fit.
    """

    centers: np.ndarray
    inflated_radii: np.ndarray
    goal: np.ndarray
    goal_radius: float
    velocities: np.ndarray | None = None
    vehicle_radius: float = 0.36

    def __post_init__(self) -> None:
        M = len(self.inflated_radii)
        shapes = {"centers": (M, 3), "inflated_radii": (M,), "goal": (3,)}
        shapes |= {} if self.velocities is None else {"velocities": (M, 3)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise InputError(f"course.{name}", f"shape {shape}", np.shape(getattr(self, name)))

    def at(self, t: np.ndarray | float) -> np.ndarray:
        """Centres (..., M, 3) at times t (...), s."""
        moves = np.zeros_like(self.centers) if self.velocities is None else self.velocities
        return self.centers + np.asarray(t)[..., None, None] * moves

    def infeasible(self, positions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Which positions (T, 3) at times t (T,), s, lie more than a millimetre inside an inflated sphere."""
        return draw.inside(positions, self.at(t), self.inflated_radii)

    def nearness(self, positions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Smallest distance from a centre as a share of r_obs + r_veh, (T,), at times t (T,), s; inf without any."""
        shares = np.linalg.norm(positions[:, None] - self.at(t), axis=-1) / self.inflated_radii
        return np.where(np.isfinite(shares), shares, np.inf).min(axis=1, initial=np.inf)

    def limits(self, *points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of a box around spheres at t = 0, goal and vehicles at points (T, 3)."""
        here = np.isfinite(self.inflated_radii)
        o, r = self.centers[here], self.inflated_radii[here, None]
        ends = self.goal + self.goal_radius * np.array([[-1.0], [1.0]])
        around = [p + side * self.vehicle_radius for p in points for side in (-1.0, 1.0)]
        shown = np.concatenate((o - r, o + r, ends, *around))
        return np.nanmin(shown, axis=0) - SPACE, np.nanmax(shown, axis=0) + SPACE


def draw_instant(
    ax: Axes, course: Course, t: float, track: np.ndarray, plan: np.ndarray, period: float, plane: draw.Plane
) -> None:
    """Obstacles at time t, s, the track flown so far (T, 3) with the vehicle at its end, and the plan (N+1, 3).

    period  of the plan's knots, s; knots inside an obstacle at their own time are crossed
    """
    own = course.inflated_radii - course.vehicle_radius
    draw.draw_obstacles(ax, course.at(t), own, course.vehicle_radius, plane, opacity=0.6)
    draw.draw_ends(ax, track[0], course.goal, course.goal_radius, plane)
    ax.plot(*track[:, plane].T, color=INK, linewidth=1.4, zorder=3)
    infeasible = course.infeasible(plan, t + period * np.arange(len(plan)))
    draw.draw_trajectory(ax, plan, infeasible, plane, every=2, size=7.0)
    at = (float(track[-1, plane[0]]), float(track[-1, plane[1]]))
    ax.add_patch(Circle(at, course.vehicle_radius, facecolor=VEHICLE, edgecolor=INK, linewidth=0.8, zorder=6))


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


def positions(frame: pd.DataFrame) -> np.ndarray:
    """Positions (T, 3) of a frame, m."""
    return np.stack(tuple(flight(frame, *POSITION).values()), axis=-1)
