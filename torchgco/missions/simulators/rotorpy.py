"""RotorPy as a plant: the rotor commands fly in its model of a multirotor, with aerodynamics of rotors and body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.extras import imported
from torchgco.dynamics.quadrotor import RADIANS, Airframe
from torchgco.missions.drone_models import WXYZ, XYZW
from torchgco.missions.simulators.each import EachPlant
from torchgco.missions.simulators.mujoco import ROTOR_CORNERS

ODE_SOLVER = {"method": "RK45", "rtol": 1e-6, "atol": 1e-9}  # the package's own tolerance is 1e-3 of a step


@dataclass(frozen=True)
class RotorpyPlant(EachPlant):
    """A quadrotor in RotorPy.

    Without `parameters` it is the vehicle of the mission: rotors that lag in speed, and the drag of rotors that equals
    the vehicle's where these carry the weight. RotorPy has no drag on the yaw rate but that of the rotors' own motion.

    Args:
        parameters: one of RotorPy's own vehicles, "crazyflie" or "hummingbird", or the name of a module with
            `quad_params` as theirs; None: those of the airframe.
        airframe, mass_error, thrust_error, drag: as of `RotorPlant`; with `parameters` the errors are 0.

    Raises:
        InputError: as `RotorPlant`, where RotorPy isn't installed, and parameters of other vehicles than quadrotors
            whose rotors begin at the front left and go clockwise.
    """

    parameters: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _multirotor()
        if self.names_own("parameters"):
            _named(str(self.parameters))

    def one(self, x: np.ndarray, u: np.ndarray, force: np.ndarray, deviation: tuple[float, float, float]) -> np.ndarray:
        """See `EachPlant`."""
        vehicle, weight = _written(self.frame, *deviation) if self.parameters is None else _named(self.parameters)
        vehicle.weight = weight + force  # the package's wind is a velocity of the air
        state = {
            "x": x[:3], "v": x[3:6], "q": x[6:10][XYZW], "w": x[10:13], "wind": np.zeros(3),
            "rotor_speeds": np.sqrt(x[13:].clip(min=0.0) / vehicle.k_eta),
        }  # fmt: skip
        after = vehicle.step(state, {"cmd_motor_speeds": u * RADIANS}, self.dt)
        thrusts = vehicle.k_eta * after["rotor_speeds"] ** 2
        return np.concatenate((after["x"], after["v"], after["q"][WXYZ], after["w"], thrusts))


def parameters_of(
    frame: Airframe, mass_error: float = 0.0, thrust_error: float = 0.0, drag: float = 0.0
) -> dict[str, Any]:
    """The package's parameters of a vehicle; arguments as of `RotorpyPlant`."""
    h, per_speed = frame.arm / math.sqrt(2.0), frame.thrust_coefficient * (1.0 + thrust_error) / RADIANS**2
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = frame.inertia
    low, high = (math.sqrt(limit / per_speed) for limit in (frame.thrust_min, frame.thrust_max))
    hover = math.sqrt(frame.hover_thrust / per_speed)
    return {
        "mass": frame.mass * (1.0 + mass_error), "num_rotors": 4,
        "Ixx": xx, "Iyy": yy, "Izz": zz, "Ixy": xy, "Ixz": xz, "Iyz": yz,
        "rotor_pos": {f"r{i}": np.array([a * h, b * h, 0.0]) for i, (a, b) in enumerate(ROTOR_CORNERS, 1)},
        "rotor_directions": np.array([1, -1, 1, -1]), "rotor_speed_min": low, "rotor_speed_max": high,
        "k_eta": per_speed, "k_m": frame.rotor_torque * per_speed, "tau_m": frame.rotor_time_constant,
        **dict.fromkeys(("k_d", "k_z"), (frame.drag + drag) / (4.0 * hover)),
    }  # fmt: skip


@lru_cache(maxsize=256)
def _written(frame: Airframe, *deviation: float) -> tuple[Any, np.ndarray]:
    vehicle = _multirotor()(parameters_of(frame, *deviation), integrator_kwargs=ODE_SOLVER)
    return vehicle, np.array([0.0, 0.0, -vehicle.mass * frame.gravity])


@cache
def _named(name: str) -> tuple[Any, np.ndarray]:
    """A vehicle of the package's own, or of a module, and its weight, N."""
    last: Exception | None = None
    for path in (f"rotorpy.vehicles.{name}_params", name):
        try:
            parameters = import_module(path).quad_params
            vehicle = _multirotor()(parameters, integrator_kwargs=ODE_SOLVER)
        except (ImportError, AttributeError, KeyError, ValueError, TypeError) as error:
            last = last or error
            continue
        places, signs = vehicle.rotor_geometry[:, :2], np.asarray(vehicle.rotor_dir)
        if (
            places.shape != (4, 2)
            or not np.array_equal(np.sign(places), ROTOR_CORNERS)
            or signs.tolist() != [1, -1, 1, -1]
        ):
            wanted = "four rotors from the front left clockwise, which turn by 1, -1, 1, -1"
            raise InputError("plant.parameters", wanted, f"rotors at {places.tolist()}, {signs.tolist()}")
        return vehicle, vehicle.weight.copy()
    raise InputError("plant.parameters", "crazyflie, hummingbird, or a module with quad_params", f"{name} ({last})")


def _multirotor() -> Any:
    """The package's class."""
    return imported("rotorpy.vehicles.multirotor", "rotorpy", "plant", "RotorPy").Multirotor
