"""A trajectory as a bag of ROS 2, by the library `rosbags`: a path, a trajectory and odometry.

Positions, velocities and accelerations are in the frame `map`, whose axes are the problem's. Vehicles in the plane stay
at z = 0 and turn by their heading; those without an attitude don't turn.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from torchgco.base.errors import InputError
from torchgco.base.extras import imported
from torchgco.obstacles.attitude import QUATERNION
from torchgco.problem.times import RATE_OF_POSITION, SECOND_RATE, TIME_COLUMN

Storage = Literal["mcap", "sqlite3"]
FRAME, BODY = "map", "base_link"
SPINS = tuple(f"w{axis} [rad/s]" for axis in "xyz")
HEADING_COLUMN = "heading [rad]"
NANO = 10**9


def write_bag(folder: Path, columns: Mapping[str, np.ndarray], position: Sequence[str], storage: Storage) -> None:
    """Write a trajectory as the bag (a folder) `folder`, in the place of one that lies there.

    Topics: /path, nav_msgs/Path; /trajectory, trajectory_msgs/MultiDOFJointTrajectory, with velocities and
    accelerations in the world's axes; /odometry, nav_msgs/Odometry for each sample, with velocities in the body's axes.

    Args:
        columns: samples (T,) by label, as `Solution.trajectories` and `torchgco-export` name them.
        position: the labels of the position, one to three.

    Raises:
        InputError: no position, without rosbags, another folder in that place.
    """
    if not position:
        raise InputError("--bag", "a vehicle with a position", "one without")
    rosbag2, typesys = (imported(f"rosbags.{name}", "ros", "--bag") for name in ("rosbag2", "typesys"))
    if folder.exists():
        if not (folder / "metadata.yaml").is_file():
            raise InputError("--output", "a folder whose bags are rosbags", folder)
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    made = _Messages(store.types, columns, position)
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()]) as bag:
        for topic, messages in (
            ("/path", made.path()),
            ("/trajectory", made.trajectory()),
            ("/odometry", made.odometry()),
        ):
            connection = bag.add_connection(topic, messages[0][1].__msgtype__, typestore=store)
            for nanoseconds, message in messages:
                bag.write(connection, nanoseconds, store.serialize_cdr(message, message.__msgtype__))


class _Messages:
    """The messages of a trajectory, with their times in ns."""

    def __init__(self, types: Mapping[str, Any], columns: Mapping[str, np.ndarray], position: Sequence[str]) -> None:
        self.types = types
        t = np.asarray(columns[TIME_COLUMN], float)
        self.nanoseconds = [round(value * NANO) for value in t.tolist()]
        self.p = _stacked(columns, position)
        self.q = _attitudes(columns, len(t))
        self.v = _or_slope(columns, "m/s", (RATE_OF_POSITION, "v{}"), self.p, t)
        self.a = _or_slope(columns, "m/s^2", (SECOND_RATE, "a{}"), self.v, t)
        self.w = _stacked(columns, SPINS) if SPINS[0] in columns else _turning(columns, t)  # in the body's axes
        self.w_world = _turned(self.q, self.w)
        self.turning = _slope(self.w_world, t)

    def _of(self, name: str, *values: Any) -> Any:
        return self.types[name](*values)

    def _header(self, nanoseconds: int) -> Any:
        stamp = self._of("builtin_interfaces/msg/Time", *divmod(nanoseconds, NANO))
        return self._of("std_msgs/msg/Header", stamp, FRAME)

    def _vector(self, values: np.ndarray) -> Any:
        return self._of("geometry_msgs/msg/Vector3", *values.tolist())

    def _attitude(self, k: int) -> Any:
        w, x, y, z = self.q[k].tolist()
        return self._of("geometry_msgs/msg/Quaternion", x, y, z, w)

    def _pose(self, k: int) -> Any:
        return self._of(
            "geometry_msgs/msg/Pose", self._of("geometry_msgs/msg/Point", *self.p[k].tolist()), self._attitude(k)
        )

    def _twist(self, linear: np.ndarray, angular: np.ndarray) -> Any:
        return self._of("geometry_msgs/msg/Twist", self._vector(linear), self._vector(angular))

    def path(self) -> list[tuple[int, Any]]:
        poses = [
            self._of("geometry_msgs/msg/PoseStamped", self._header(stamp), self._pose(k))
            for k, stamp in enumerate(self.nanoseconds)
        ]
        return [(self.nanoseconds[0], self._of("nav_msgs/msg/Path", self._header(self.nanoseconds[0]), poses))]

    def trajectory(self) -> list[tuple[int, Any]]:
        first, points = self.nanoseconds[0], []
        for k, stamp in enumerate(self.nanoseconds):
            transform = self._of("geometry_msgs/msg/Transform", self._vector(self.p[k]), self._attitude(k))
            motion = [self._twist(self.v[k], self.w_world[k])], [self._twist(self.a[k], self.turning[k])]
            since = self._of("builtin_interfaces/msg/Duration", *divmod(stamp - first, NANO))
            points.append(self._of("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint", [transform], *motion, since))
        whole = self._of("trajectory_msgs/msg/MultiDOFJointTrajectory", self._header(first), [BODY], points)
        return [(first, whole)]

    def odometry(self) -> list[tuple[int, Any]]:
        body = self.q * [1.0, -1.0, -1.0, -1.0]
        v, unknown, messages = _turned(body, self.v), np.zeros(36), []
        for k, stamp in enumerate(self.nanoseconds):
            pose = self._of("geometry_msgs/msg/PoseWithCovariance", self._pose(k), unknown)
            twist = self._of("geometry_msgs/msg/TwistWithCovariance", self._twist(v[k], self.w[k]), unknown)
            messages.append((stamp, self._of("nav_msgs/msg/Odometry", self._header(stamp), BODY, pose, twist)))
        return messages


def _stacked(columns: Mapping[str, np.ndarray], labels: Sequence[str]) -> np.ndarray:
    """(T, 3) of up to three columns; 0 in the place of others."""
    arrays = [np.asarray(columns[label], float) for label in labels]
    return np.stack([*arrays, *[np.zeros_like(arrays[0])] * (3 - len(arrays))], axis=1)


def _or_slope(
    columns: Mapping[str, np.ndarray], unit: str, names: Sequence[str], values: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """The columns of the first of these names that is there, (T, 3); without any, how `values` change."""
    for name in names:
        known = [label for axis in "xyz" if (label := f"{name.format(axis)} [{unit}]") in columns]
        if known:
            return _stacked(columns, known)
    return _slope(values, t)


def _slope(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.gradient(values, t, axis=0) if len(t) > 1 else np.zeros_like(values)


def _attitudes(columns: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """Unit quaternions (T, 4), scalar first."""
    q = np.zeros((count, 4))
    q[:, 0] = 1.0
    if QUATERNION[0] in columns:
        q = np.stack([np.asarray(columns[name], float) for name in QUATERNION], axis=1)
        q = q / np.linalg.norm(q, axis=1, keepdims=True)
    elif HEADING_COLUMN in columns:
        half = 0.5 * np.asarray(columns[HEADING_COLUMN], float)
        q[:, 0], q[:, 3] = np.cos(half), np.sin(half)
    return q


def _turning(columns: Mapping[str, np.ndarray], t: np.ndarray) -> np.ndarray:
    """Rates (T, 3), rad/s, of a vehicle that turns by its heading."""
    rates = np.zeros((len(t), 3))
    if HEADING_COLUMN in columns:
        rates[:, 2] = _slope(np.asarray(columns[HEADING_COLUMN], float), t)
    return rates


def _turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors v (T, 3) turned by unit quaternions (T, 4)."""
    return Rotation.from_quat(q, scalar_first=True).apply(v)
