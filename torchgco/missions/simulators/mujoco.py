"""MuJoCo as a plant: the rotor commands fly a quadrotor of MJCF, written from an `Airframe` or of a user's file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.extras import imported
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.simulators.each import EachPlant
from torchgco.obstacles.attitude import rotation

THIN = 0.1  # of a radius: heights and thicknesses that are drawn
FOLDERS = "meshdir", "texturedir", "assetdir"  # attributes of a compiler, relative to the file
ROTOR_CORNERS = (
    (1, 1),
    (1, -1),
    (-1, -1),
    (-1, 1),
)  # signs of x and y of the rotors: front left, then clockwise from above


def mjcf(airframe: Airframe, timestep: float = 0.005, mass: float | None = None) -> str:
    """The text of a model with one free body, four sites at its rotors and four actuators that push there.

    Controls are thrusts in newtons within the airframe's limits; a first-order filter of its time constant is between
    them and the rotors. The torque against a rotor's turning is in its actuator's gear. What is drawn has no mass and
    touches nothing. The drags aren't in it: MuJoCo's damping of a free joint is one number for all six axes, so
    `MujocoPlant` sets them in the compiled model.

    Args:
        airframe: mass, inertia, arm, rotors.
        timestep: of the simulation, s.
        mass: kg, another one than the airframe's.
    """
    h, k = airframe.arm / math.sqrt(2.0), airframe.rotor_torque
    root = ElementTree.Element("mujoco", model="torchgco quadrotor")
    _add(root, "option", timestep=timestep, integrator="RK4", gravity=(0, 0, -airframe.gravity))
    body = _add(_add(root, "worldbody"), "body", name="vehicle")
    _add(body, "freejoint", name="free")
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = airframe.inertia
    weight = airframe.mass if mass is None else mass
    _add(body, "inertial", pos=(0, 0, 0), mass=weight, fullinertia=(xx, yy, zz, xy, xz, yz))
    actuators = _add(root, "actuator")
    drawn = {"contype": 0, "conaffinity": 0, "group": 2}
    for i, (x, y) in enumerate(ROTOR_CORNERS, 1):
        corner, spin = (x * h, y * h, 0), k if i % 2 else -k
        _add(body, "site", name=f"rotor{i}", pos=corner)
        _add(body, "geom", type="capsule", fromto=(0, 0, 0, *corner), size=THIN * airframe.arm, **drawn)
        _add(body, "geom", type="cylinder", pos=corner, size=(0.4 * airframe.arm, THIN**2 * airframe.arm), **drawn)
        _add(
            actuators, "general", name=f"thrust{i}", site=f"rotor{i}", gear=(0, 0, 1, 0, 0, spin), ctrllimited="true",
            ctrlrange=(airframe.thrust_min, airframe.thrust_max), dyntype="filter",
            dynprm=airframe.rotor_time_constant,
        )  # fmt: skip
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def files_named(path: Path) -> list[Path]:
    """The files that a file of MJCF names, and those that these name: includes, meshes, textures; that are there."""
    files, left = list[Path](), [path]
    while left:
        file = left.pop()
        try:
            root = ElementTree.parse(file).getroot()
        except (OSError, ElementTree.ParseError):  # no XML: a mesh, say
            continue
        compilers = [dict(compiler.attrib) for compiler in root.iter("compiler")]
        folders = ["", *(attributes[name] for attributes in compilers for name in FOLDERS if name in attributes)]
        for name in dict.fromkeys(named for element in root.iter() if (named := element.attrib.get("file"))):
            places = (file.parent / folder / name for folder in folders)
            new = [candidate for candidate in places if candidate.is_file() and candidate not in (path, *files)]
            files, left = [*files, *new], [*left, *new]
    return files


def _add(parent: ElementTree.Element, tag: str, /, **values: object) -> ElementTree.Element:
    """An element with attributes; numbers as the shortest text that reads as the same float64."""
    return ElementTree.SubElement(parent, tag, {key: _text(value) for key, value in values.items()})


def _text(value: object) -> str:
    return " ".join(map(_text, value)) if isinstance(value, tuple) else str(value)


LONGEST_STEP = 0.005  # s, of a time step of MuJoCo in a model that we write
SIDEWAYS = 1e-6  # share of a thrust that an actuator may push across the body's z axis
QUARTER_ROUND = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # a quarter turn about z


@dataclass(frozen=True)
class MujocoPlant(EachPlant):
    """A quadrotor in MuJoCo.

    Without `model` it is the vehicle of the mission (`mjcf`), whose thrusts follow their commands as a first-order lag.
    A file of a user's says mass, inertia, rotors and limits itself. It has one free body, to which all others are
    welded, a `timestep` that divides dt, and four actuators without bias, with `dyntype` none, filter or filterexact.
    Each of these pushes along the body's z axis, one in each quadrant around the centre of mass, where opposite ones
    turn the same way. Contacts are switched off: obstacles are the mission's, which judges contact.

    MuJoCo's motors take newtons: a commanded speed asks for the thrust that the vehicle's coefficient gives at it.
    Positions and velocities are those of the centre of mass. Where the front left rotor turns so that its torque is
    negative, the body's axes are turned by 90 degrees about z, and the rotors are counted from there.

    Args:
        model: path of a file of MJCF; None: written from the airframe.
        airframe, mass_error, thrust_error, drag: as of `RotorPlant`; with a file the errors are 0, as it has its own.

    Raises:
        InputError: as `RotorPlant`, where MuJoCo isn't installed, and a file that isn't as said.
    """

    model: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _mujoco()
        if self.names_own("model"):
            self._quadrotor((0.0, 0.0, 0.0))

    @property
    def files(self) -> list[Path]:
        """What is read beside `model` itself: includes and meshes that it names."""
        return [] if self.model is None else files_named(Path(self.model).expanduser())

    def _quadrotor(self, deviation: tuple[float, float, float]) -> _Quadrotor:
        if self.model is None:
            return _written(self.frame, deviation[0], deviation[2], self.dt)
        path = Path(self.model).expanduser()
        try:
            changed = path.stat().st_mtime_ns
        except OSError as error:
            raise InputError("plant.model", "a file of MJCF", f"{path}: {error.strerror}") from None
        return _read(path, changed, self.dt)

    def one(self, x: np.ndarray, u: np.ndarray, force: np.ndarray, deviation: tuple[float, float, float]) -> np.ndarray:
        """See `EachPlant`."""
        thrusts = (1.0 + deviation[1]) * self.frame.thrust_coefficient * u * np.abs(u)
        return self._quadrotor(deviation).step(x, thrusts, force)


class _Quadrotor:
    """A compiled model of one free body with four rotors, and its state; `order` has the actuators of our rotors."""

    def __init__(self, model: Any, dt: float) -> None:
        lib = self.lib = _mujoco()
        self.model, self.data = model, lib.MjData(model)
        model.opt.disableflags |= int(lib.mjtDisableBit.mjDSBL_CONTACT)
        self.steps = round(dt / model.opt.timestep)
        if self.steps < 1 or not math.isclose(self.steps * model.opt.timestep, dt, rel_tol=1e-9):
            raise InputError("plant.model", f"a timestep that divides {dt} s", f"{model.opt.timestep} s")
        if (model.nq, model.nv, model.nu) != (7, 6, 4) or model.na not in (0, 4):
            got = f"{model.nq} coordinates, {model.nu} actuators with {model.na} states"
            raise InputError("plant.model", "one free body (7 coordinates), and 4 actuators with 0 or 4 states", got)
        if (
            model.na
            and not np.isin(model.actuator_dyntype, (lib.mjtDyn.mjDYN_FILTER, lib.mjtDyn.mjDYN_FILTEREXACT)).all()
        ):
            raise InputError("plant.model", "actuators with dyntype none, filter or filterexact", "another")
        if np.any(model.actuator_biastype != lib.mjtBias.mjBIAS_NONE):
            raise InputError("plant.model", "actuators without bias", "one with")
        self.body = int(model.jnt_bodyid[0])
        lib.mj_forward(model, self.data)
        frame = self.data.xmat[self.body].reshape(3, 3)
        self.center = frame.T @ (self.data.subtree_com[self.body] - self.data.xpos[self.body])
        limited = model.actuator_ctrllimited.astype(bool)
        self.low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
        self.high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
        wrenches = np.stack([self._wrench(i, self.high[i] if limited[i] else 1.0) for i in range(4)])
        self.order, self.gains, self.turned = _rotors(wrenches)

    def _wrench(self, i: int, control: float) -> np.ndarray:
        """Force and torque (6,) about the centre of mass, in the body's axes, for a unit of control `i`."""
        lib, model, data = self.lib, self.model, self.data
        lib.mj_resetData(model, data)
        data.qpos[:] = (0, 0, 0, 1, 0, 0, 0)
        (data.act if model.na else data.ctrl)[i] = control
        lib.mj_forward(model, data)
        force, torque = data.qfrc_actuator[:3] / control, data.qfrc_actuator[3:] / control
        return np.concatenate((force, torque - np.cross(self.center, force)))

    def step(self, x: np.ndarray, thrusts: np.ndarray, push: np.ndarray) -> np.ndarray:
        """The state (17,) after dt, for thrusts (4,) that are commanded, N, and a force (3,) on the body."""
        lib, model, data, order = self.lib, self.model, self.data, self.order
        q, w = x[6:10], x[10:13]
        if self.turned:
            q, w = _product(q, (QUARTER_ROUND[0], 0.0, 0.0, -QUARTER_ROUND[3])), np.array((-w[1], w[0], w[2]))
        q = q / np.linalg.norm(q)
        lib.mj_resetData(model, data)  # also what MuJoCo would start its next step from: a step has the state alone
        arm = rotation(q) @ self.center
        data.qpos[:3], data.qpos[3:] = x[:3] - arm, q
        data.qvel[:3], data.qvel[3:] = x[3:6] - rotation(q) @ np.cross(w, self.center), w
        data.ctrl[order] = thrusts / self.gains
        if model.na:
            data.act[order] = x[13:] / self.gains
        data.xfrc_applied[self.body, :3] = push
        lib.mj_step(model, data, nstep=self.steps)
        return self._state(data)

    def _state(self, data: Any) -> np.ndarray:
        q, w = data.qpos[3:] / np.linalg.norm(data.qpos[3:]), data.qvel[3:].copy()
        R = rotation(q)
        p, v = data.qpos[:3] + R @ self.center, data.qvel[:3] + R @ np.cross(w, self.center)
        controls = data.act if self.model.na else np.clip(data.ctrl, self.low, self.high)
        if self.turned:
            q, w = _product(q, QUARTER_ROUND), np.array((w[1], -w[0], w[2]))
        return np.concatenate((p, v, q, w, self.gains * controls[self.order]))


def _rotors(wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Actuators of our rotors 1 to 4, newtons of each per unit of control, and whether the axes are turned.

    Args:
        wrenches: forces and torques (4, 6) about the centre of mass, per unit of control.

    Raises:
        InputError: they aren't those of four rotors that steer about all axes.
    """
    forces, torques = wrenches[:, :3], wrenches[:, 3:]
    lift = forces[:, 2]
    if not bool((lift > 0).all()) or bool((np.abs(forces[:, :2]) > SIDEWAYS * lift[:, None]).any()):
        raise InputError(
            "plant.model", "actuators that push along the body's z axis", f"forces {forces.round(6).tolist()}"
        )
    x, y, yaw = -torques[:, 1] / lift, torques[:, 0] / lift, torques[:, 2] / lift
    by_corner = [np.flatnonzero((x * a > 0) & (y * b > 0)) for a, b in ROTOR_CORNERS]
    if any(len(actuators) != 1 for actuators in by_corner):
        places = list(zip(x.round(3).tolist(), y.round(3).tolist(), strict=True))
        raise InputError("plant.model", "one rotor in each quadrant around the centre of mass", f"rotors at {places} m")
    order = np.concatenate(by_corner)
    signs = np.sign(yaw[order])
    turned = bool(signs[0] < 0)
    if not np.array_equal(signs, np.array((1, -1, 1, -1)) * (-1 if turned else 1)):
        wanted = "opposite rotors that turn the same way, and neighbours the other way"
        raise InputError(
            "plant.model", wanted, f"yaw torques {yaw[order].round(6).tolist()} m, clockwise from front left"
        )
    if turned:  # the rear left one is at the front left of the turned axes
        order = np.roll(order, 1)
    return order, lift[order], turned


@lru_cache(maxsize=256)
def _written(frame: Airframe, mass_error: float, drag: float, dt: float) -> _Quadrotor:
    text = mjcf(frame, dt / math.ceil(dt / LONGEST_STEP - 1e-9), frame.mass * (1.0 + mass_error))
    try:
        model = _mujoco().MjModel.from_xml_string(text)
    except ValueError as error:
        raise InputError("vehicle", "an airframe that MuJoCo takes", _line(error)) from None
    model.dof_damping[:] = [*[frame.drag + drag] * 3, 0.0, 0.0, frame.rotational_drag]
    return _Quadrotor(model, dt)


@lru_cache(maxsize=16)
def _read(path: Path, changed: int, dt: float) -> _Quadrotor:
    try:
        model = _mujoco().MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError("plant.model", "a file of MJCF that MuJoCo compiles", _line(error)) from None
    return _Quadrotor(model, dt)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _product(a: Any, b: Any) -> np.ndarray:
    """The quaternion a b, scalars first."""
    return np.concatenate(
        ([a[0] * b[0] - np.dot(a[1:], b[1:])], a[0] * np.array(b[1:]) + b[0] * np.array(a[1:]) + np.cross(a[1:], b[1:]))
    )


def _mujoco() -> Any:
    """The package."""
    return imported("mujoco", "mujoco", "plant", "MuJoCo")
