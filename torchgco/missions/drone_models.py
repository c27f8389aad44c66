"""A plant by other authors: the rotor commands fly in the first-principles model of the package `drone-models`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation  # before drone_models, which would import SciPy in its array API mode
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Seconds, check_options
from torchgco.base.tree import PerElement
from torchgco.dynamics.quadrotor import GRAVITY, Airframe
from torchgco.missions.plant import check_vehicle

# Body torques of the four rotors about x, y and z, in units of arm / sqrt(2) and of the rotors' own torque.
MIXING = np.array([[1.0, -1.0, -1.0, 1.0], [-1.0, -1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0]])
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])  # xyzw
XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]  # the package's order of a quaternion from ours, and ours from the package's


@dataclass(frozen=True)
class DroneModelsPlant(PerElement):
    """The vehicle of `RotorPlant` in the equations of drone-models, Runge-Kutta steps of the rotors' speeds in rpm.

    Forces, torques and rotors are the package's, float64 in NumPy; of its rates we don't take the quaternion's: version
    0.1.0 evaluates it for another order of the components than the one that it takes. As in `RotorPlant`, every step
    ends with limited thrusts and a renormalised quaternion.

    Args:
        airframe: as the planner knows it.
        mass_error, thrust_error: share by which mass and thrust coefficient differ from the airframe's, number or (B,).
        drag: force against the velocity, N s/m, a number or (B,).

    Raises:
        InputError: drone-models isn't installed, non-positive dt, a mass or thrust coefficient that isn't above 0, a
            negative drag, a parameter that is neither a finite number nor (B,).
    """

    airframe: Airframe = Airframe()
    dt: Seconds = 0.01
    mass_error: float | Tensor = 0.0
    thrust_error: float | Tensor = 0.0
    drag: float | Tensor = 0.0

    per_element: ClassVar[tuple[str, ...]] = ("mass_error", "thrust_error", "drag")

    def __post_init__(self) -> None:
        check_options(self, "plant")
        check_vehicle(self.mass_error, self.thrust_error, self.drag)
        _dynamics()

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        b = self.airframe.thrust_coefficient * (1.0 + _column(self.thrust_error))
        states, command, push = (part.detach().cpu().double().numpy() for part in (x, u, force))
        parameters = self._parameters(b)

        def rates(z: np.ndarray) -> np.ndarray:
            return self._rates(z, command, push, parameters)

        with np.errstate(all="ignore"):  # vehicles that have diverged stay in the batch until the control period ends
            pose, q, w, F = np.split(states, (6, 10, 13), axis=-1)
            speed = np.sqrt(np.maximum(F, 0.0) / b)
            z = _rk4(rates, np.concatenate((pose, q[:, XYZW], w, speed), axis=-1), self.dt)
            pose, q, w, speed = np.split(z, (6, 10, 13), axis=-1)
            F = np.clip(b * speed * np.abs(speed), self.airframe.thrust_min, self.airframe.thrust_max)
            x_next = np.concatenate((pose, _unit(q)[:, WXYZ], w, F), axis=-1)
        return torch.from_numpy(x_next).to(x)

    def _rates(self, z: np.ndarray, command: np.ndarray, push: np.ndarray, parameters: dict[str, Any]) -> np.ndarray:
        """z' of z = [p, v, q (xyzw), w, rotor speeds (rpm)] (B, 17)."""
        _, v, q, w, speed = np.split(z, (3, 6, 10, 13), axis=-1)
        yaw_drag = np.zeros_like(w)
        yaw_drag[:, 2] = -self.airframe.rotational_drag * w[:, 2]
        unit = _unit(q)
        unit = np.where(np.isnan(unit), UPRIGHT, unit)  # SciPy refuses a batch with a NaN; q is NaN after the step
        in_world = Rotation.from_quat(unit).apply(yaw_drag)
        p_dot, _, v_dot, w_dot, speed_dot = _dynamics()(
            z[:, :3], unit, v, w, command, speed, dist_f=push, dist_t=in_world, **parameters
        )
        vector, scalar = q[:, :3], q[:, 3:]
        turning = scalar * w + np.cross(vector, w), -(vector * w).sum(axis=-1, keepdims=True)
        return np.concatenate((p_dot, v_dot, 0.5 * turning[0], 0.5 * turning[1], w_dot, speed_dot), axis=-1)

    def _parameters(self, b: np.ndarray) -> dict[str, Any]:
        """The package's parameters for thrust coefficients b (B or 1, 1), N/rpm^2."""
        frame = self.airframe
        J, none = np.array(frame.inertia), np.zeros_like(b)
        return {
            "mass": frame.mass * (1.0 + _column(self.mass_error)),
            "L": frame.arm / math.sqrt(2.0),
            "prop_inertia": 0.0,
            "gravity_vec": np.array([0.0, 0.0, -GRAVITY]),
            "J": J,
            "J_inv": np.linalg.inv(J),
            "rpm2thrust": np.stack((none, none, b)),
            "rpm2torque": np.stack((none, none, frame.rotor_torque * b)),
            "mixing_matrix": MIXING,
            "drag_matrix": -_column(self.drag)[..., None] * np.eye(3),
            "rotor_dyn_coef": np.array([1.0, 0.0, 1.0, 0.0]) / frame.rotor_time_constant,
        }


def _column(value: float | Tensor) -> np.ndarray:
    """A number or (B,) as (1 or B, 1)."""
    return torch.as_tensor(value, dtype=torch.float64).detach().cpu().reshape(-1, 1).numpy()


def _unit(q: np.ndarray) -> np.ndarray:
    """Quaternions of length 1; NaN for those without a finite length above 0."""
    length = np.sqrt((q**2).sum(axis=-1, keepdims=True))
    return q / np.where((length > 0) & (length < np.inf), length, np.nan)


def _rk4(rates: Callable[[np.ndarray], np.ndarray], z: np.ndarray, dt: float) -> np.ndarray:
    k1 = rates(z)
    k2 = rates(z + 0.5 * dt * k1)
    k3 = rates(z + 0.5 * dt * k2)
    k4 = rates(z + dt * k3)
    return z + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@cache
def _dynamics() -> Callable[..., tuple[np.ndarray, ...]]:
    """The package's function.

    Its import demands SCIPY_ARRAY_API=1 for other arrays than NumPy's, and sets it; the environment is left as it was.
    """
    before = os.environ.get("SCIPY_ARRAY_API")
    os.environ["SCIPY_ARRAY_API"] = "1"
    try:
        from drone_models.first_principles import dynamics
    except ImportError as error:
        raise InputError("plant", "drone-models (`pip install torchgco[plants]`)", error) from error
    finally:
        if before is None:
            del os.environ["SCIPY_ARRAY_API"]
        else:
            os.environ["SCIPY_ARRAY_API"] = before
    return dynamics
