"""crazyflow as a plant: the rotor commands fly in its first-principles model, which JAX compiles."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.extras import imported
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.drone_models import WXYZ, XYZW, parameters_of
from torchgco.missions.simulators.each import EachPlant

FREQUENCY = 500  # Hz, the package's own, at least
FROM_FRONT_LEFT = [3, 0, 1, 2]  # the package counts rotors clockwise, too, from the front right one
ARRAY_API = "SCIPY_ARRAY_API"


@dataclass(frozen=True)
class CrazyflowPlant(EachPlant):
    """A quadrotor in crazyflow, by Runge-Kutta steps in JAX's precision, float32 where it isn't set otherwise.

    Without `drone_model` it is the vehicle of the mission, whose rotors lag in speed. Positions go in as 0 and come out
    as displacements, so that they stay float64; the package's floor at z = 0 is left out. It has no drag on yaw rates.

    Args:
        drone_model: one of the package's own vehicles, such as "cf2x_L250" or "cf21B_500", whose commands are cut off
            to its limits of thrust; None: that of the airframe.
        airframe, mass_error, thrust_error, drag: as of `RotorPlant`; with a `drone_model` the errors are 0.

    Raises:
        InputError: as `RotorPlant`, where crazyflow isn't installed, where Python wasn't started with SCIPY_ARRAY_API=1
            in its environment, and for a vehicle that the package hasn't.
    """

    drone_model: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _package()
        if self.names_own("drone_model"):
            _named(str(self.drone_model))

    def one(self, x: np.ndarray, u: np.ndarray, force: np.ndarray, deviation: tuple[float, float, float]) -> np.ndarray:
        """See `EachPlant`."""
        name = self.drone_model
        made, (low, high) = _written(self.frame, *deviation) if name is None else _named(name)
        _, per_speed, per_square = made["rpm2thrust"]
        rotors = (np.sqrt(per_speed**2 + 4.0 * per_square * x[13:].clip(min=0.0)) - per_speed) / (2.0 * per_square)
        state = {"quat": x[6:10][XYZW], "vel": x[3:6], "ang_vel": x[10:13], "rotor_vel": rotors, "force": force}
        p, v, q, w, rotors = _steps(self.dt)(state, u.clip(low, high), made)
        return np.concatenate((x[:3] + p, v, q[WXYZ], w, per_speed * rotors + per_square * rotors**2))


@lru_cache(maxsize=256)
def _written(frame: Airframe, *deviation: float) -> tuple[dict[str, Any], tuple[float, float]]:
    return parameters_of(frame, *deviation), frame.rotor_speeds


@cache
def _named(name: str) -> tuple[dict[str, Any], tuple[float, float]]:
    """The parameters of one of the package's own vehicles, rotors in our order, and its limits in rpm."""
    models = imported("drone_models.core", "crazyflow", "plant", "drone-models")
    try:
        known = models.load_params("first_principles", name)
    except KeyError:
        from drone_models.drones import available_drones  # pyright: ignore[reportMissingImports]

        raise InputError("plant.drone_model", "one of " + ", ".join(available_drones), name) from None
    made = {key: known[key] for key in parameters_of(Airframe())}
    made["mixing_matrix"] = made["mixing_matrix"][:, FROM_FRONT_LEFT]
    _, b, c = made["rpm2thrust"]
    low, high = ((math.sqrt(b**2 + 4.0 * c * known[limit]) - b) / (2.0 * c) for limit in ("thrust_min", "thrust_max"))
    return made, (low, high)


@cache
def _steps(dt: float) -> Callable[..., list[np.ndarray]]:
    """The package's steps over dt s: a function of parts of a state, rotor commands and parameters, compiled once."""
    import jax  # pyright: ignore[reportMissingImports]

    lib, count = _package(), math.ceil(dt * FREQUENCY - 1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo's, of names in a scene that isn't saved
        sim = lib.Sim(physics="first_principles", control="rotor_vel", integrator="rk4", freq=count / dt, device="cpu")
    sim.step_pipeline = tuple(stage for stage in sim.step_pipeline if stage is not lib.clip_floor_pos)
    step, start = sim.build_step_fn(), sim.data

    @jax.jit
    def after(state: dict[str, Any], command: Any, parameters: dict[str, Any]) -> list[Any]:
        batched = lambda value: value[None, None]  # a world with a vehicle
        data = start.replace(
            states=start.states.replace(**{key: batched(value) for key, value in state.items()}),
            controls=start.controls.replace(rotor_vel=batched(command)),
            params=start.params.replace(**parameters),
        )
        end = step(data, n_steps=count).states
        return [array[0, 0] for array in (end.pos, end.vel, end.quat, end.ang_vel, end.rotor_vel)]

    return lambda *arguments: [np.asarray(array, dtype=np.float64) for array in after(*arguments)]


def _package() -> Any:
    """The package's module of its simulation."""
    if os.environ.get(ARRAY_API) != "1":
        raise InputError("plant", f"{ARRAY_API}=1 in the environment that Python starts in, for crazyflow", "none")
    return imported("crazyflow.sim.sim", "crazyflow", "plant")
