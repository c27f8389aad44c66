"""A plant by other authors: the rotor commands fly in the first-principles model of the package `drone-models`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation  # before drone_models, which would import SciPy in its array API mode
from torch import Tensor

from torchgco.base.extras import imported
from torchgco.dynamics.base import rk4
from torchgco.dynamics.quadrotor import Airframe, within_limits
from torchgco.missions.plant import RotorPlant, column

# Body torques of the four rotors about x, y and z, in units of arm / sqrt(2) and of the rotors' own torque.
MIXING = np.array([[1.0, -1.0, -1.0, 1.0], [-1.0, -1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0]])
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])  # xyzw
XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]  # the package's order of a quaternion from ours, and ours from the package's

Number = float | np.ndarray


@dataclass(frozen=True)
class DroneModelsPlant(RotorPlant):
    """The vehicle of `RotorPlant` in the equations of drone-models, Runge-Kutta steps of the rotors' speeds in rpm.

    Forces, torques and rotors are the package's, float64 in NumPy; of its rates we don't take the quaternion's: version
    0.1.0 evaluates it for another order of the components than the one that it takes. As in `RotorPlant`, commands are
    cut off, and every step ends with limited thrusts and a renormalised quaternion.

    Args:
        airframe, mass_error, thrust_error, drag: as of `RotorPlant`.

    Raises:
        InputError: as `RotorPlant`, and where drone-models isn't installed.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        _dynamics()

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        states, command, push = (tensor.detach().cpu().double() for tensor in (x, self.frame.reachable(u), force))
        errors = [column(tensor, states) for tensor in (self.mass_error, self.thrust_error, self.drag)]
        b = self.frame.thrust_coefficient * (1.0 + errors[1])
        parameters = parameters_of(self.frame, *(error.numpy() for error in errors))

        def rates(z: Tensor) -> Tensor:
            return torch.from_numpy(self._rates(z.numpy(), command.numpy(), push.numpy(), parameters))

        with np.errstate(all="ignore"):  # vehicles that have diverged stay in the batch until the control period ends
            pose, q, w, F = states.split((6, 4, 3, 4), dim=-1)
            speed = (F.clamp(min=0.0) / b).sqrt()
            z = rk4(rates, torch.cat((pose, q[:, XYZW], w, speed), dim=-1), self.dt)
        pose, q, w, speed = z.split((6, 4, 3, 4), dim=-1)
        return within_limits(torch.cat((pose, q[:, WXYZ], w, b * speed * speed.abs()), dim=-1), self.frame).to(x)

    def _rates(self, z: np.ndarray, command: np.ndarray, push: np.ndarray, parameters: dict[str, Any]) -> np.ndarray:
        """z' of z = [p, v, q (xyzw), w, rotor speeds (rpm)] (B, 17)."""
        _, v, q, w, speed = np.split(z, (3, 6, 10, 13), axis=-1)
        yaw_drag = np.zeros_like(w)
        yaw_drag[:, 2] = -self.frame.rotational_drag * w[:, 2]
        unit = _unit(q)
        unit = np.where(np.isnan(unit), UPRIGHT, unit)  # SciPy refuses a batch with a NaN; q is NaN after the step
        in_world = Rotation.from_quat(unit).apply(yaw_drag)
        p_dot, _, v_dot, w_dot, speed_dot = _dynamics()(
            z[:, :3], unit, v, w, command, speed, dist_f=push, dist_t=in_world, **parameters
        )
        vector, scalar = q[:, :3], q[:, 3:]
        turning = scalar * w + np.cross(vector, w), -(vector * w).sum(axis=-1, keepdims=True)
        return np.concatenate((p_dot, v_dot, 0.5 * turning[0], 0.5 * turning[1], w_dot, speed_dot), axis=-1)


def parameters_of(
    frame: Airframe, mass_error: Number = 0.0, thrust_error: Number = 0.0, drag: Number = 0.0
) -> dict[str, Any]:
    """The package's parameters of a vehicle, rotors in our order; its errors and drag are numbers or columns (B, 1)."""
    J, b = np.array(frame.inertia), np.asarray(frame.thrust_coefficient * (1.0 + thrust_error))
    none = np.zeros_like(b)
    return {
        "mass": frame.mass * (1.0 + mass_error),
        "L": frame.arm / math.sqrt(2.0),
        "prop_inertia": frame.rotor_inertia,
        "gravity_vec": np.array([0.0, 0.0, -frame.gravity]),
        "J": J,
        "J_inv": np.linalg.inv(J),
        "rpm2thrust": np.stack((none, none, b)),
        "rpm2torque": np.stack((none, none, frame.rotor_torque * b)),
        "mixing_matrix": MIXING,
        "drag_matrix": -np.asarray(drag + frame.drag)[..., None] * np.eye(3),
        "rotor_dyn_coef": np.array([1.0, 0.0, 1.0, 0.0]) / frame.rotor_time_constant,
    }


def _unit(q: np.ndarray) -> np.ndarray:
    """Quaternions of length 1; NaN for those without a finite length above 0."""
    length = np.sqrt((q**2).sum(axis=-1, keepdims=True))
    return q / np.where((length > 0) & (length < np.inf), length, np.nan)


@cache
def _dynamics() -> Callable[..., tuple[np.ndarray, ...]]:
    """The package's function.

    Its import demands SCIPY_ARRAY_API=1 for other arrays than NumPy's, and sets it; the environment is left as it was.
    """
    before = os.environ.get("SCIPY_ARRAY_API")
    os.environ["SCIPY_ARRAY_API"] = "1"
    try:
        return imported("drone_models.first_principles", "plants", "plant", "drone-models").dynamics
    finally:
        if before is None:
            del os.environ["SCIPY_ARRAY_API"]
        else:
            os.environ["SCIPY_ARRAY_API"] = before
