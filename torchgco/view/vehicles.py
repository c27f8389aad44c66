"""Which body stands for a vehicle on the page, and which of its states turn it.

`VEHICLES[Boat] = Look("car", heading=2)` shows a model of your own with a heading; models that aren't listed are a
ball, or a disc in the plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchgco.dynamics import Dynamics, QuadrotorPlanning, QuadrotorPlant, QuadrotorThrusts, Unicycle


@dataclass(frozen=True)
class Look:
    """A body and the states that turn it.

    Args:
        body: "ball" (in the plane a disc), "car" or "quadrotor".
        quaternion: states of the unit quaternion [w, x, y, z] from the body to space.
        heading: the state of the angle about z, rad.
    """

    body: Literal["ball", "car", "quadrotor"] = "ball"
    quaternion: slice | None = None
    heading: int | None = None

    def attitude(self, X: np.ndarray) -> np.ndarray | None:
        """Quaternions (..., 4) of states X (..., n); None where nothing turns the body."""
        if self.quaternion is not None:
            return X[..., self.quaternion]
        if self.heading is None:
            return None
        half, zero = 0.5 * X[..., self.heading], np.zeros(X.shape[:-1])
        return np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)


VEHICLES: dict[type[Dynamics], Look] = {
    QuadrotorPlanning: Look("quadrotor", quaternion=slice(6, 10)),
    QuadrotorPlant: Look("quadrotor", quaternion=slice(6, 10)),
    QuadrotorThrusts: Look("quadrotor", quaternion=slice(6, 10)),
    Unicycle: Look("car", heading=2),
}


def look_of(dynamics: Dynamics) -> Look:
    """How a model's vehicle looks."""
    return next((look for kind, look in VEHICLES.items() if isinstance(dynamics, kind)), Look())
