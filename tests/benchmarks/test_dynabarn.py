"""DynaBARN's worlds: how the cylinders' motion is read and continued, and that the plan and the drive see the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.outside.barn import BODY, DT, VEHICLE
from benchmarks.outside.dynabarn import (
    BEGINS,
    KINDS,
    STAGES,
    START,
    Drive,
    Motion,
    begins,
    beyond,
    data,
    motions,
    planned,
    problem,
)  # fmt: skip
from benchmarks.outside.dynabarn_data import RADIUS, followed, listed
from torchgco import judge

CYLINDER = "<radius>0.5000</radius><radius>0.5000</radius><plugin name='{name}' filename='{name}.so'/>"
CODE = """
  10: mov    rax,QWORD PTR [rip+0x4370]        # 17000 <x>
  11: mov    QWORD PTR [rbp-0xb0],rax
  12: movsd  xmm0,QWORD PTR [rbp-0xb0]
  13: call   f910 <gazebo::common::PoseAnimation::PoseAnimation(std::string, double, bool, double)@plt>
  14: pxor   xmm0,xmm0
  15: call   f5c0 <gazebo::common::PoseAnimation::CreateKeyFrame(double)@plt>
  16: pxor   xmm0,xmm0
  17: movsd  QWORD PTR [rbp-0x60],xmm0
  18: movsd  xmm0,QWORD PTR [rip+0x4305]        # 17008 <x>
  19: movsd  QWORD PTR [rbp-0x80],xmm0
  1a: movsd  xmm0,QWORD PTR [rip+0x4300]        # 17010 <x>
  1b: movsd  QWORD PTR [rbp-0x88],xmm0
  1c: lea    rcx,[rbp-0x60]
  1d: lea    rdx,[rbp-0x80]
  1e: lea    rsi,[rbp-0x88]
  1f: call   f9a0 <ignition::math::v4::Vector3<double>::Vector3(double const&, double const&, double const&)@plt>
"""


def test_a_worlds_plugins_are_listed_and_other_worlds_refused() -> None:
    assert listed(CYLINDER.format(name="obs_3") + CYLINDER.format(name="obs_12")) == ["obs_3.so", "obs_12.so"]
    for text in (
        CYLINDER.format(name="a").replace("0.5", "0.4"),
        CYLINDER.format(name="a") * 2 + "<radius>0.5</radius>",
    ):
        with pytest.raises(ValueError, match="expected a plugin for each cylinder"):
            listed(text)


def test_what_a_plugin_hands_to_its_animation_is_followed() -> None:
    length, rows = followed(CODE, {0x17000: 33.5, 0x17008: -10.0, 0x17010: -8.67}.__getitem__)
    assert length == 33.5 and rows.tolist() == [[0.0, -8.67, -10.0]]


def test_the_shipped_motions_cross_the_yard_from_border_to_border() -> None:
    rows, cylinders = data()
    assert cylinders.shape[0] == 60 and (cylinders >= 0).sum(axis=1).min() == 5 and (cylinders >= 0).sum() == 963
    speeds = {kind: 0.0 for kind in KINDS}
    for kind, worlds in KINDS.items():
        for one in (one for world in worlds for one in motions(world)):
            assert one.t[0] == 0.0 and (np.diff(one.t) > 0).all()
            assert np.abs(one.p[[0, -1]]).max(axis=1) == pytest.approx([10.0, 10.0])
            moves = np.linalg.norm(np.diff(one.p, axis=0), axis=1)
            speeds[kind] = max(speeds[kind], float((moves / np.diff(one.t)).max()))
    assert speeds["easy"] < 1.0 < speeds["medium"] < 1.5 < speeds["hard"] < 2.0 and len(rows) == 469


def test_between_rows_a_cylinder_moves_on_the_simulators_cubic() -> None:
    """Hermite's matrix as its source has it, with slopes of half of what lies between the neighbours."""
    one = Motion(np.array([0.0, 1.0, 3.0]), np.array([[0.0, 10.0], [1.0, 2.0], [4.0, -10.0]]))
    matrix = np.array([[2, -2, 1, 1], [-3, 3, -2, -1], [0, 0, 1, 0], [1, 0, 0, 0]], dtype=float)
    slopes = [0.5 * (one.p[1] - one.p[0]), 0.5 * (one.p[2] - one.p[0]), 0.5 * (one.p[2] - one.p[1])]
    for t, i, s in ((0.25, 0, 0.25), (1.0, 1, 0.0), (2.5, 1, 0.75)):
        expected = np.array([s**3, s**2, s, 1.0]) @ matrix @ np.stack([*one.p[i : i + 2], *slopes[i : i + 2]])
        np.testing.assert_allclose(one.at(np.array([t, t + 3.0])), np.stack([expected] * 2), rtol=0, atol=1e-12)


def test_what_is_planned_among_covers_what_is_driven_among() -> None:
    """At every millisecond a cylinder lies within the disc of one of its crossings, which moves evenly by stages."""
    t = DT * np.arange(STAGES + 1)
    fine = np.linspace(0.0, t[-1], 100 * STAGES + 1)
    for world in (3, 25, 41, 59):
        begin = float(begins(world, 1, seed=5)[0])
        for one in motions(world):
            covered = np.zeros(len(fine), dtype=bool)
            for places, strays in one.crossings(begin + t):
                even = np.stack([np.interp(fine, t, places[:, i]) for i in (0, 1)], axis=-1)
                covered |= np.linalg.norm(even - one.at(begin + fine), axis=1) <= strays + 0.005
            assert covered.all(), world


def test_a_cylinder_waits_beyond_the_side_that_it_comes_through() -> None:
    assert beyond(np.array([-10.0, 4.0])).tolist() == [-40.0, 4.0]
    assert beyond(np.array([2.0, 10.0])).tolist() == [2.0, 40.0]
    assert beyond(np.array([10.0, -3.0])).tolist() == [10.0, -33.0], "not through the robot's start"


def test_runs_begin_by_world_and_seed_alone() -> None:
    assert begins(7, 3, 0).tolist() == begins(7, 5, 0)[:3].tolist() != begins(8, 3, 0).tolist()
    assert (begins(7, 100, 0) < BEGINS).all() and begins(7, 1, 0) != begins(7, 1, 1)


def test_a_vehicle_at_rest_isnt_hit_at_its_start_and_doesnt_arrive() -> None:
    posed = problem([(0, 3.0)])
    U = torch.zeros(1, STAGES, 2, dtype=torch.float64)
    driven = Drive.of(0, 3.0, U[0].numpy())
    assert np.isinf(driven.seconds) and not driven.arrived and not judge(posed, U).reached.any()
    nearest = min(np.linalg.norm(one.at(3.0 + np.arange(0, 20, 0.001)) - START[:2], axis=1).min() for one in motions(0))
    assert driven.clearance == pytest.approx(nearest - RADIUS - BODY, abs=1e-9) and VEHICLE > BODY


@pytest.mark.slow
def test_worlds_of_each_kind_from_end_to_end() -> None:
    drives, whole = planned([(0, 10.0), (25, 10.0), (45, 10.0)], "gco", seed=0)
    assert [one.arrived for one in drives] == [True] * 3 and whole.all()
