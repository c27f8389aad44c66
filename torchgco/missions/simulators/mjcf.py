"""A quadrotor as MJCF, the format of MuJoCo's models, written from an `Airframe`."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

from torchgco.dynamics.quadrotor import Airframe

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
