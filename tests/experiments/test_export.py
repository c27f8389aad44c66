"""`torchgco-export`: single trajectories as the study kept them, missions as they were flown."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from tests.experiments.commands import HOLD
from tests.experiments.test_view import MISSION
from torchgco.base.errors import InputError
from torchgco.experiments.reports import bags, export
from torchgco.missions.outcome import STATES


def test_single_trajectories(run, tmp_path, capsys) -> None:
    code, _, err = run("scenario=yard", *HOLD, "study.figures=false", "hydra.run.dir=study")
    assert code == 0, err
    folder = tmp_path / "study"
    assert export.main([str(folder), "--layout", "2", "0"]) == 0 and "2 files" in capsys.readouterr().out
    assert sorted(path.name for path in (folder / "export").iterdir()) == ["hold-0.csv", "hold-2.csv"]
    table = pd.read_csv(folder / "export" / "hold-2.csv")
    with np.load(folder / "solutions.npz") as held:
        U = held["U"][held["solver"].tolist().index("hold"), held["layout"].tolist().index(2)]
    heads = ["t [s]", "x [m]", "y [m]", "heading [rad]", "speed [m/s]", "vx [m/s]", "vy [m/s]", "ax [m/s^2]"]
    assert list(table.columns[:8]) == heads
    np.testing.assert_allclose(table[["acceleration [m/s^2]", "turn rate [rad/s]"]].to_numpy()[:-1], U, atol=1e-12)
    assert export.main([str(folder), "--rate", "50", "--output", str(tmp_path / "out")]) == 0
    fine = pd.read_csv(tmp_path / "out" / "hold-2.csv")
    np.testing.assert_allclose(fine["t [s]"], np.arange(len(fine)) / 50, atol=1e-12)
    np.testing.assert_allclose(fine["t [s]"].iloc[-1], table["t [s]"].iloc[-1], atol=0.02)


@pytest.mark.slow
def test_missions_as_they_were_flown(run, tmp_path) -> None:
    code, _, err = run(*MISSION)
    assert code == 0, err
    assert export.main([str(tmp_path / "flown"), "--solver", "hold"]) == 0
    log = pd.read_parquet(tmp_path / "flown" / "time_steps.parquet")
    for number in (0, 1):
        table = pd.read_csv(tmp_path / "flown" / "export" / f"hold-{number}.csv")
        own = log[log["mission"] == number]
        x = own[[f"x{i}" for i in range(STATES)]].to_numpy()
        np.testing.assert_allclose(table.iloc[:, 1 : STATES + 1], x, atol=1e-9)
        np.testing.assert_allclose(table["thrust [N]"], x[:, 13:].sum(1), atol=1e-9)
        np.testing.assert_allclose(table["rotor 1 [rpm]"], own["u1"], atol=1e-6)
        change = (x[2:, 5] - x[:-2, 5]) / (own["t"].to_numpy()[2:] - own["t"].to_numpy()[:-2])
        np.testing.assert_allclose(table["az [m/s^2]"][1:-1], change, atol=1e-9)
    (tmp_path / "flown" / "time_steps.parquet").unlink()  # as of studies of many missions: control steps
    assert export.main([str(tmp_path / "flown"), "--rate", "40"]) == 0
    coarse = pd.read_csv(tmp_path / "flown" / "export" / "hold-1.csv")
    np.testing.assert_allclose(np.diff(coarse["t [s]"]), 0.025, atol=1e-12)
    q = coarse[["qw", "qx", "qy", "qz"]].to_numpy()
    np.testing.assert_allclose((q**2).sum(1), 1.0, atol=1e-12)


@pytest.mark.slow
def test_bags_of_missions(run, tmp_path) -> None:
    """Read back: the path and the trajectory are the columns of the CSV, in ROS's order and axes."""
    store = pytest.importorskip("rosbags.typesys").get_typestore(import_module("rosbags.typesys").Stores.ROS2_HUMBLE)
    code, _, err = run(*MISSION)
    assert code == 0, err
    for kind in ("sqlite3", "mcap"):  # the second takes the place of the first
        assert export.main([str(tmp_path / "flown"), "--bag", kind, "--layout", "1", "--rate", "50"]) == 0
    assert export.main([str(tmp_path / "flown"), "--layout", "1", "--rate", "50"]) == 0
    table = pd.read_csv(tmp_path / "flown" / "export" / "hold-1.csv")
    with import_module("rosbags.rosbag2").Reader(tmp_path / "flown" / "export" / "hold-1") as bag:
        read = [(c.topic, at, store.deserialize_cdr(raw, c.msgtype)) for c, at, raw in bag.messages()]
    found = {topic: [message for name, _, message in read if name == topic] for topic, *_ in read}
    assert [at for topic, at, _ in read if topic == "/odometry"] == [20_000_000 * k for k in range(len(table))]
    (path,), (trajectory,) = found["/path"], found["/trajectory"]
    p = np.array([[pose.pose.position.x, pose.pose.position.y, pose.pose.position.z] for pose in path.poses])
    np.testing.assert_allclose(p, table[["x [m]", "y [m]", "z [m]"]], atol=1e-12)
    point, row = trajectory.points[7], table.iloc[7]
    turn = Rotation.from_quat(row[["qx", "qy", "qz", "qw"]].to_numpy(float))
    assert Rotation.from_quat([getattr(point.transforms[0].rotation, axis) for axis in "xyzw"]).approx_equal(turn, 1e-9)
    assert path.header.frame_id == "map" and point.time_from_start.nanosec == 140_000_000
    body = found["/odometry"][7].twist.twist
    for vector, heads, by in (
        (point.velocities[0].linear, ["vx [m/s]", "vy [m/s]", "vz [m/s]"], None),
        (point.accelerations[0].linear, ["ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"], None),
        (point.velocities[0].angular, ["wx [rad/s]", "wy [rad/s]", "wz [rad/s]"], turn),
        (body.linear, ["vx [m/s]", "vy [m/s]", "vz [m/s]"], turn.inv()),
        (body.angular, ["wx [rad/s]", "wy [rad/s]", "wz [rad/s]"], None),
    ):
        wanted = row[heads].to_numpy(float, copy=True)
        wanted = wanted if by is None else by.apply(wanted)
        np.testing.assert_allclose([vector.x, vector.y, vector.z], wanted, atol=1e-9)


def test_a_bag_of_a_vehicle_in_the_plane(tmp_path) -> None:
    """It stays at z = 0 and turns by its heading; in the body's axes it drives ahead. No other folder is replaced."""
    typesys = pytest.importorskip("rosbags.typesys")
    t = np.linspace(0.0, 1.0, 101)
    columns = {"t [s]": t, "x [m]": np.sin(t), "y [m]": 1 - np.cos(t), "heading [rad]": t}
    bags.write_bag(tmp_path / "bag", columns, ["x [m]", "y [m]"], "mcap")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with import_module("rosbags.rosbag2").Reader(tmp_path / "bag") as bag:
        read = [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in bag.messages() if c.topic == "/odometry"]
    twist, pose = read[50].twist.twist, read[50].pose.pose
    np.testing.assert_allclose([twist.linear.x, twist.linear.y, twist.angular.z], [1, 0, 1], atol=1e-3)
    assert (pose.position.z, pose.orientation.z) == (0.0, pytest.approx(np.sin(0.25)))
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="--output: expected a folder whose bags are rosbags"):
        bags.write_bag(tmp_path / "other", columns, ["x [m]"], "mcap")
    with pytest.raises(InputError, match="--bag: expected a vehicle with a position"):
        bags.write_bag(tmp_path / "none", columns, [], "mcap")


def test_velocities_in_the_vehicles_axes_are_not_the_worlds(tmp_path) -> None:
    """A model may have states named vx and vy: where the position's rates are there, too, they count."""
    typesys = pytest.importorskip("rosbags.typesys")
    columns = {name: np.full(3, value) for name, value in (
        ("x [m]", 0.0), ("y [m]", 0.0), ("heading [rad]", 0.5 * np.pi), ("vx [m/s]", 2.0), ("vy [m/s]", 0.0),
        ("dx/dt [m/s]", 0.0), ("dy/dt [m/s]", 2.0))} | {"t [s]": np.arange(3.0)}  # fmt: skip
    bags.write_bag(tmp_path / "bag", columns, ["x [m]", "y [m]"], "mcap")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with import_module("rosbags.rosbag2").Reader(tmp_path / "bag") as bag:
        read = [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in bag.messages() if c.topic == "/odometry"]
    twist = read[1].twist.twist
    np.testing.assert_allclose([twist.linear.x, twist.linear.y], [2.0, 0.0], atol=1e-12)


def test_attitudes_between_samples_turn_the_short_way() -> None:
    """Whatever signs a simulator gives its quaternions, of which q and -q are the same attitude."""
    t, half = np.arange(5) / 10, 0.1 * np.arange(5)
    x = np.zeros((5, 17))
    x[:, 6], x[:, 9] = np.cos(half), np.sin(half)
    x[2:4, 6:10] *= -1.0
    log = pd.DataFrame({"t": t} | {f"x{i}": x[:, i] for i in range(17)} | {f"u{i}": 0.0 * t for i in range(1, 5)})
    found = export._flown(log, 20.0)
    turned = 2 * np.arctan2(found["qz"], found["qw"])
    np.testing.assert_allclose(np.sin(turned), np.sin(2.0 * found["t [s]"]), atol=1e-3)


def test_a_mistake_gets_one_line(run, tmp_path, capsys) -> None:
    code, _, err = run("scenario=yard", *HOLD, "study.figures=false", "hydra.run.dir=study")
    assert code == 0, err
    for words, line in (
        (["study", "--layout", "77"], "--layout: expected among 0, 1"),
        (["study", "--solver", "gco"], "--solver: expected among hold of the study, got gco"),
        (["study", "--rate", "0"], "--rate: expected a number above 0"),
        (["study", "--output", "study/study.json"], "--output: expected a folder"),
        (["elsewhere"], "RUN: expected the folder of a study"),
        (["study", "--speed"], "command line: expected RUN and the options of --help"),
    ):
        assert export.main([str(tmp_path / words[0]), *words[1:]] if words[0] != "elsewhere" else words) == 2
        told = capsys.readouterr().err
        assert line in told and told.count("\n") == 1
