"""Small bags of each container and compression, written by the library `rosbags`."""

from __future__ import annotations

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from tests.maps.files.samples import POINTS, ROOM

rosbags = pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

KINDS = ("bag", "bag bz2", "bag lz4", "mcap", "mcap zstd", "db3", "folder")
GRID, CLOUD = "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/PointCloud2"


def messages(types: Any, ros1: bool, **changed: Any) -> dict[str, list[Any]]:
    """Messages by topic: a grid of nothing, then the room turned by a quarter; a cloud of two rows; and a word."""
    header = dict(stamp=types["builtin_interfaces/msg/Time"](5, 6), frame_id="map", **({"seq": 1} if ros1 else {}))
    head = types["std_msgs/msg/Header"](**header)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](-1.0, 2.0, 0.0),
        types["geometry_msgs/msg/Quaternion"](*changed.get("turn", (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))),
    )
    info = types["nav_msgs/msg/MapMetaData"](types["builtin_interfaces/msg/Time"](1, 2), 0.05, 6, 4, pose)
    room = np.where(ROOM[::-1], 100, 0).astype(np.int8)
    room[1, 1] = -1  # the second cell from the left and below
    grids = [types[GRID](head, info, cells.ravel()) for cells in (np.zeros_like(room), room)]
    layout = np.dtype(
        {"names": ["z", "x", "y"], "formats": ["<f8", "<f4", "<f4"], "offsets": [0, 8, 12], "itemsize": 20}
    )
    points = np.zeros((2, 2), layout)
    for axis, values in zip("xyz", POINTS.T, strict=True):
        points[axis] = values.reshape(2, 2)
    rows = np.zeros((2, 50), np.uint8)  # rows are longer than their points
    rows[:, :40] = points.view(np.uint8).reshape(2, 40)
    kinds = {"z": 8, "x": 7, "y": 7}
    fields = [types["sensor_msgs/msg/PointField"](name, layout.fields[name][1], kinds[name], 1) for name in kinds]
    cloud = types[CLOUD](head, 2, 2, fields, False, 20, 50, rows.ravel(), True)
    return {"/map": grids, "/points": [cloud], "/said": [types["std_msgs/msg/String"]("hello")]}


ALL = ("/map", "/points", "/said")
FOLDER = Path(mkdtemp(prefix="bags-"))
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)


def bag(kind: str, topics: tuple[str, ...] = ALL) -> tuple[str, bytes]:
    """Name and bytes of the one file of a bag."""
    return _bag(kind, topics)


@cache
def _bag(kind: str, topics: tuple[str, ...]) -> tuple[str, bytes]:
    place = FOLDER / f"{kind}{'-'.join(topics)}".replace("/", "").replace(" ", "-")
    ros1 = kind.startswith("bag")
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        writer: Any = Writer1(place.with_suffix(".bag"))
        if kind != "bag":
            writer.set_compression(getattr(Writer1.CompressionFormat, kind.split()[1].upper()))
    else:
        plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
        writer = Writer2(place, version=9, storage_plugin=plugin)
        if kind == "mcap zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        time = 10**9
        for topic, sent in messages(store.types, ros1).items():
            if topic in topics:
                connection = writer.add_connection(topic, sent[0].__msgtype__, typestore=store)
                for message in sent:
                    data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, message.__msgtype__)
                    time += 10**8
                    writer.write(connection, time, data)
    path = place.with_suffix(".bag") if ros1 else next(p for p in place.iterdir() if p.suffix in (".mcap", ".db3"))
    return path.name, path.read_bytes()


def write(target: Path, kind: str, topics: tuple[str, ...] = ALL) -> Path:
    """A bag in this folder; its path."""
    name, data = bag("db3" if kind == "folder" else kind, topics)
    if kind == "folder":
        shutil.copytree(FOLDER / name.removesuffix(".db3"), target / "bag")
        return target / "bag"
    (target / name).write_bytes(data)
    return target / name
