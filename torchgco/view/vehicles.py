"""Which body stands for a vehicle on the page, and which of its states turn it.

`VEHICLES[Boat] = Look("car", heading=2)` shows a model of your own. A model that isn't listed is a dart: it turns with
states that are called `qw`, `qx`, `qy`, `qz` or `heading`, else it points to where it goes. A vehicle with a `Body` is
drawn as that, and turned by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from torchgco.dynamics import Bicycle, Dynamics, QuadrotorPlanning, QuadrotorPlant, QuadrotorThrusts, Unicycle
from torchgco.dynamics.names import states_of
from torchgco.obstacles.attitude import QUATERNION
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.problem.problem import Problem
from torchgco.view.shapes import NOT_TURNED, turns

HEADING = "heading"
NO_WAY = 1e-9  # m: a way that is shorter has no direction


@dataclass(frozen=True)
class Look:
    """A body and the states that turn it.

    Args:
        body: "ball" (in the plane a disc), "car", "quadrotor" or "dart".
        quaternion: states of the unit quaternion [w, x, y, z] from the body to space.
        heading: the state of the angle about z, rad.
        along: the position, where nothing else turns the body: it points along the way, at rest as before or after.
    """

    body: Literal["ball", "car", "quadrotor", "dart"] = "ball"
    quaternion: slice | None = None
    heading: int | None = None
    along: slice | None = None

    def attitude(self, X: np.ndarray) -> np.ndarray | None:
        """Quaternions (..., 4) of states X (..., n); None where nothing turns the body."""
        if self.quaternion is not None:
            return X[..., self.quaternion]
        if self.along is not None:
            return _pointing(X[..., self.along])
        if self.heading is None:
            return None
        return _about_z(X[..., self.heading])


VEHICLES: dict[type[Dynamics], Look] = {
    QuadrotorPlanning: Look("quadrotor", quaternion=slice(6, 10)),
    QuadrotorPlant: Look("quadrotor", quaternion=slice(6, 10)),
    QuadrotorThrusts: Look("quadrotor", quaternion=slice(6, 10)),
    Unicycle: Look("car", heading=2),
    Bicycle: Look("car", heading=2),
}


def look_of(dynamics: Dynamics) -> Look:
    """How a model's vehicle looks."""
    for kind, look in VEHICLES.items():
        if isinstance(dynamics, kind):
            return look
    names = [component.name for component in states_of(dynamics)]
    if QUATERNION[0] in names and tuple(names[(k := names.index(QUATERNION[0])) : k + 4]) == QUATERNION:
        return Look("dart", quaternion=slice(k, k + 4))
    if HEADING in names:
        return Look("dart", heading=names.index(HEADING))
    return Look() if dynamics.position is None else Look("dart", along=dynamics.position)


def _pointing(p: np.ndarray) -> np.ndarray:
    """Quaternions (K, 4) of bodies without roll that point along a way p (K, d); x, where it leads nowhere."""
    steps = np.diff(p, axis=0, append=p[-1:])
    steps = np.concatenate((steps, np.zeros((len(p), 3 - p.shape[1]))), axis=1)
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) > NO_WAY)
    if len(moving) == 0:
        return np.tile(NOT_TURNED, (len(p), 1))
    last = np.searchsorted(moving, np.arange(len(p)), side="right") - 1
    x, y, z = steps[moving[np.maximum(last, 0)]].T
    yaw, pitch = 0.5 * np.arctan2(y, x), -0.5 * np.arctan2(z, np.hypot(x, y))
    turn = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.stack((turn[0] * turn[2], -turn[1] * turn[3], turn[0] * turn[3], turn[1] * turn[2]), axis=-1)


@dataclass(frozen=True)
class Shape:
    """What stands for a vehicle with a `Body`: the box that its balls cover, else the balls.

    Args:
        balls: (P, 4) centers in the vehicle's frame, z = 0 in the plane, and radii, m.
        box: lower and upper corner there, (2, d), m; None: none is known.
        reach: the radius of the ball about the position that holds all, m.
    """

    balls: np.ndarray
    box: np.ndarray | None
    reach: float

    def packed(self) -> dict[str, Any]:
        """As the page reads it."""
        box = None if self.box is None else np.round(self.box, 4).tolist()
        return {"balls": np.round(self.balls, 4).tolist(), "box": box}


def shape_of(problem: Problem) -> Shape | None:
    """The body of a problem's vehicle, without parts that turn by themselves; None where it is a ball."""
    if (body := VehicleBody.of(problem)) is None:
        return None
    offsets = body.offsets
    radii = body.radii[: len(offsets)]
    balls = np.column_stack((offsets, np.zeros((len(offsets), 3 - offsets.shape[1])), radii))
    return Shape(balls, body.box, float((np.linalg.norm(offsets, axis=1) + radii).max()))


def turned(body: VehicleBody, X: np.ndarray) -> np.ndarray:
    """Quaternions (K, 4) by which a body is turned in states X (K, n)."""
    axes = body.rotations(X).swapaxes(-1, -2)
    quaternions = turns(axes)
    if quaternions is None:
        return np.tile(NOT_TURNED, (len(axes), 1))
    return quaternions if quaternions.ndim == 2 else _about_z(quaternions)


def _about_z(angle: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of turns by angles (...), rad."""
    zero = np.zeros(angle.shape)
    return np.stack((np.cos(0.5 * angle), zero, zero, np.sin(0.5 * angle)), axis=-1)
