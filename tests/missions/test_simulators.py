"""Plants of other simulators: what is written for them, their agreement with our own, files of users, refusals."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from tests.missions.missions import mission, varied
from tests.missions.test_plants import random_states
from torchgco import Airframe, InputError
from torchgco.missions import RotorPlant
from torchgco.missions.simulators.crazyflow import CrazyflowPlant
from torchgco.missions.simulators.mujoco import ROTOR_CORNERS, MujocoPlant, files_named, mjcf
from torchgco.missions.simulators.rotorpy import RotorpyPlant, parameters_of

OWN = Airframe(mass=1.2, arm=0.15, thrust_max=4.5, drag=0.2, rotor_time_constant=0.07)
USERS = """<mujoco><compiler autolimits="true"/><option timestep="0.005" gravity="0 0 -9.81"/><worldbody>
  <body name="drone" pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .02" pos="0 0 .04" mass="{mass}"/>
    <site name="a" pos="-.14 -.18 .05"/><site name="b" pos="-.14 .18 .05"/>
    <site name="c" pos=".14 .18 .05"/><site name="d" pos=".14 -.18 .05"/></body></worldbody>
  <actuator><motor site="a" ctrlrange="0 9" gear="0 0 2 0 0 {0}"/><motor site="b" ctrlrange="0 9" gear="0 0 2 0 0 {1}"/>
    <motor site="c" ctrlrange="0 9" gear="0 0 2 0 0 {2}"/><motor site="d" ctrlrange="0 9" gear="0 0 2 0 0 {3}"/>
  </actuator></mujoco>"""

MODULES = {
    MujocoPlant: "mujoco",
    RotorpyPlant: "rotorpy.vehicles.multirotor",
    CrazyflowPlant: "crazyflow.sim.sim",
}
each_simulator = pytest.mark.parametrize("make", MODULES)


def needs(make: type) -> None:
    """Skip where the simulator can't be had."""
    if make is CrazyflowPlant and os.environ.get("SCIPY_ARRAY_API") != "1":
        pytest.skip("Python was started without SCIPY_ARRAY_API=1")
    pytest.importorskip(MODULES[make])


def numbers(element: ElementTree.Element, key: str) -> list[float]:
    return [float(word) for word in element.attrib[key].split()]


def test_files_that_a_model_names_are_found_in_turn(tmp_path) -> None:
    for name, text in {
        "scene.xml": '<mujoco><include file="quad.xml"/><include file="none.xml"/></mujoco>',
        "quad.xml": '<mujoco><compiler meshdir="assets"/><asset><mesh file="body.stl"/></asset></mujoco>',
        "assets/body.stl": "solid",
        "other.xml": "<mujoco/>",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = files_named(tmp_path / "scene.xml")
    assert sorted(found) == [tmp_path / "assets" / "body.stl", tmp_path / "quad.xml"]


def test_the_model_that_is_written_has_the_airframes_mass_inertia_and_rotors() -> None:
    """As wrenches of its actuators, summed here, beside the airframe's allocation."""
    root = ElementTree.fromstring(mjcf(OWN, mass=1.5))
    (inertial,), (option,) = root.iter("inertial"), root.iter("option")
    xx, yy, zz, xy, xz, yz = numbers(inertial, "fullinertia")
    assert float(inertial.attrib["mass"]) == 1.5 and numbers(inertial, "pos") == [0, 0, 0]
    assert [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] == [list(row) for row in OWN.inertia]
    assert numbers(option, "gravity") == [0, 0, -9.81]
    places = {site.attrib["name"]: numbers(site, "pos") for site in root.iter("site")}
    columns = []
    for actuator in root.iter("general"):
        gear, limits = numbers(actuator, "gear"), numbers(actuator, "ctrlrange")
        assert limits == [OWN.thrust_min, OWN.thrust_max] and numbers(actuator, "dynprm") == [0.07]
        columns.append(np.cross(places[actuator.attrib["site"]], gear[:3]) + gear[3:])
    expected = OWN.allocation(torch.zeros(1, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(np.stack(columns, axis=1), expected, rtol=1e-15, atol=1e-17)
    assert all(part.attrib["contype"] == "0" for part in root.iter("geom"))  # its mass doesn't count beside `inertial`


def test_parameters_of_rotorpy_are_the_airframes() -> None:
    given = parameters_of(OWN, mass_error=0.25, thrust_error=0.1, drag=0.3)
    assert given["mass"] == 1.5 and [np.sign(place[:2]).tolist() for place in given["rotor_pos"].values()] == [
        list(corner) for corner in ROTOR_CORNERS
    ]
    hover = math.sqrt(OWN.hover_thrust / given["k_eta"])  # rad/s
    assert given["k_eta"] == pytest.approx(1.1 * OWN.thrust_coefficient * (60 / (2 * math.pi)) ** 2)
    assert (
        4 * given["k_d"] * hover == pytest.approx(OWN.drag + 0.3) and given["k_m"] / given["k_eta"] == OWN.rotor_torque
    )
    assert given["k_eta"] * given["rotor_speed_max"] ** 2 == pytest.approx(OWN.thrust_max)


@each_simulator
def test_it_moves_as_ours_does_while_thrusts_hold(make: type) -> None:
    """A body with wind and errors; measured 1e-8, of crazyflow's float32 9e-7.

    Rotors lag in their own ways. RotorPy and crazyflow have no drag on yaw rates, and RotorPy one at the rotors.
    """
    needs(make)
    frame = replace(OWN, drag=0.0 if make is RotorpyPlant else OWN.drag, rotational_drag=0.0)
    frame = OWN if make is MujocoPlant else frame
    x, _, force = random_states(5)
    errors = {"mass_error": torch.linspace(0, 0.2, 5).double(), "thrust_error": 0.1}
    x[:, 13:] *= 0.5
    u = (x[:, 13:] / (1.1 * frame.thrust_coefficient)).sqrt()
    ours, theirs, one = x, x, x[3:4]
    for _ in range(20):
        ours = RotorPlant(frame, **errors).advance(ours, u, force)  # type: ignore[arg-type]
        theirs = make(frame, **errors).advance(theirs, u, force)
        one = make(frame, **errors).take(torch.tensor([3])).advance(one, u[3:4], force[3:4])
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-5 if make is CrazyflowPlant else 1e-6)
    assert torch.equal(one, theirs[3:4])  # the batch contract
    x[1, 4], x[2, 0] = math.nan, 1e300
    lost = make(frame).advance(x, u, force).isnan().all(1)
    assert lost.tolist() == [False, True, True, False, False]


@each_simulator
def test_a_mission_flies_there(make: type) -> None:
    needs(make)
    log, ours = (mission(plant=plant, duration=0.5).fly(varied(1)) for plant in (make(), RotorPlant()))
    assert (log.x[..., :3] - ours.x[..., :3]).abs().max() < 0.01 and not torch.equal(log.x, ours.x)


def test_rotors_follow_as_a_first_order_lag() -> None:
    pytest.importorskip("mujoco")
    x, u = random_states(1)[0], torch.tensor([[0.0, 3000.0, 4000.0, 9000.0]]).double()
    x[:, 13:] = torch.tensor([1.0, 2.0, 3.0, 2.0])
    F = MujocoPlant(OWN).advance(x, u, torch.zeros(1, 3).double())[:, 13:]
    asked = (OWN.thrust_coefficient * u.square()).clamp(OWN.thrust_min, OWN.thrust_max)
    torch.testing.assert_close(F, asked + (x[:, 13:] - asked) * math.exp(-0.01 / 0.07), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("spins", [(1, -1, 1, -1), (-1, 1, -1, 1)])
def test_a_users_model_steers_whichever_way_its_rotors_turn(tmp_path: Path, spins: tuple[int, ...]) -> None:
    """States are of the centre of mass, whose body lies off the joint; each torque turns about its own axis alone."""
    pytest.importorskip("mujoco")
    path = tmp_path / "drone.xml"
    path.write_text(USERS.format(*(0.04 * spin for spin in spins), mass=1.3))
    plant, still, hover = MujocoPlant(model=str(path)), torch.zeros(5, 3).double(), 1.3 * 9.81 / 4
    x = torch.zeros(5, 17).double()
    x[:, 6] = 1.0
    F = torch.full((5, 4), hover).double()
    for i, rotors in enumerate(([0, 3], [2, 3], [0, 2], [0, 1, 2, 3])):
        F[i, rotors] += 0.1
    u = (F / Airframe().thrust_coefficient).sqrt()
    for _ in range(10):
        x = plant.advance(x, u, still)
    torch.testing.assert_close(x[:, 13:], F)
    turning = x[:3, 10:13] / x[:3, 10:13].abs().amax(1, keepdim=True)
    torch.testing.assert_close(turning, torch.eye(3).double(), rtol=0, atol=0.02)
    assert x[3, 5] == pytest.approx(0.1 * 0.4 / 1.3, rel=1e-6, abs=1e-7) and x[4, 3:6].abs().max() < 1e-7


def test_models_and_parameters_that_are_no_quadrotor_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "drone.xml"
    good = USERS.format(1, -1, 1, -1, mass=1.3)
    for text, line in (
        (USERS.format(-1, 1, 1, -1, mass=1.3), "expected opposite rotors that turn the same way"),
        (good.replace('gear="0 0 2 0 0 1"', 'gear="0 1 2 0 0 1"'), "expected actuators that push along the body's z"),
        (good.replace("-.14 .18 .05", "-.14 -.10 .05"), "expected one rotor in each quadrant"),
        (good.replace('timestep="0.005"', 'timestep="0.003"'), "expected a timestep that divides 0.01 s, got 0.003"),
        (good.replace("<freejoint/>", ""), "expected one free body"),
        (good.replace("<freejoint/>", "<freejoin/>"), "expected a file of MJCF that MuJoCo compiles, got XML Error"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=f"plant.model: {line}"):
            MujocoPlant(model=str(path))
    with pytest.raises(InputError, match=r"plant.model: expected a file of MJCF, got .*No such file"):
        MujocoPlant(model=str(tmp_path / "none.xml"))
    path.write_text(good)
    with pytest.raises(InputError, match=r"plant.mass_error: expected 0 for a vehicle of plant.model, got 0.1"):
        MujocoPlant(model=str(path), mass_error=0.1)


def test_vehicles_of_rotorpy_by_name() -> None:
    pytest.importorskip("rotorpy.vehicles.multirotor")
    x = random_states(1)[0]
    x[:, 13:] = 0.03 * 9.81 / 4
    u = (x[:, 13:] / 2.3e-8).sqrt() * 60 / (2 * math.pi)  # the package's own coefficient, N s^2/rad^2
    F = RotorpyPlant(parameters="crazyflie").advance(x, u, torch.zeros(1, 3).double())[:, 13:]
    torch.testing.assert_close(F, x[:, 13:], rtol=1e-9, atol=0)
    with pytest.raises(InputError, match=r"plant.parameters: expected crazyflie, hummingbird, or a module"):
        RotorpyPlant(parameters="none")


@pytest.mark.parametrize("name", ["cf2x_L250", "cf21B_500"])
def test_vehicles_of_crazyflow_by_name(name: str) -> None:
    """Rotors front left, front right, rear right, rear left turn it as they do ours, at the package's numbers."""
    needs(CrazyflowPlant)
    plant = CrazyflowPlant(drone_model=name)
    mass, c1, c2 = {
        "cf2x_L250": (0.0319, -5.382196214637237e-7, 2.4582929831265485e-10),
        "cf21B_500": (0.04338, -3.133427287299859e-7, 4.407354891648379e-10),
    }[name]
    x = torch.zeros(5, 17).double()
    x[:, 6], hover = 1.0, mass * 9.81 / 4
    F = torch.full((5, 4), hover).double()
    F[0, [0, 3]], F[1, [2, 3]], F[2, [0, 2]] = 1.02 * hover, 1.02 * hover, 1.02 * hover
    x[:, 13:] = F
    u = ((c1**2 + 4 * c2 * F).sqrt() - c1) / (2 * c2)
    u[4] = 1e6
    end = plant.advance(x, u, torch.zeros(5, 3).double())
    torch.testing.assert_close(end[:4, 13:], F[:4], rtol=1e-5, atol=0)
    turning = end[:3, 10:13] / end[:3, 10:13].abs().amax(1, keepdim=True)
    torch.testing.assert_close(turning, torch.eye(3).double(), rtol=0, atol=0.02)
    assert end[3, 3:6].abs().max() < 1e-5 and end[4, 13:].max() < 0.2
    with pytest.raises(InputError, match=r"plant.drone_model: expected one of cf2x_L250, .*, got none"):
        CrazyflowPlant(drone_model="none")
    with pytest.raises(InputError, match=r"plant.drag: expected 0 for a vehicle of plant.drone_model, got 0.1"):
        CrazyflowPlant(drone_model=name, drag=0.1)


@each_simulator
def test_a_simulator_that_is_not_installed(make: type, monkeypatch) -> None:
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")
    monkeypatch.setitem(sys.modules, MODULES[make], None)
    with pytest.raises(InputError, match=r"plant: expected .* \(`pip install torchgco\[.*\]`\)"):
        make()


def test_crazyflow_says_what_it_needs_of_the_environment(monkeypatch) -> None:
    monkeypatch.delenv("SCIPY_ARRAY_API", raising=False)
    with pytest.raises(InputError, match=r"plant: expected SCIPY_ARRAY_API=1 in the environment .*, got none"):
        CrazyflowPlant()
