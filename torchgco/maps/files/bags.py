"""Maps in ROS's bags, read by rosbags: the last message of a topic of point clouds or grids."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.base.extras import imported
from torchgco.base.memory import limited
from torchgco.maps.files.rotated import rotated
from torchgco.maps.files.source import MOST_CELLS, MOST_POINTS, Source, check_far, finite_points, made
from torchgco.maps.grid import OccupancyGrid, values_of_ros

BAG_FILE = "a bag of ROS 1, version 2.0, or of ROS 2"
BAG_MEMORY = 3 * 2**28  # bytes while it is read: a chunk of 2**28 bytes, its messages and a cloud of these
CLOUD, GRID = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"
LEVEL = 1e-3  # largest tilt of a grid, of a quaternion's x and y
LAST = 10**9  # ns before a bag's end in which the last message is looked for first
FURTHER = 8  # times as far before the end it is looked for then
# PointField's numbers for types.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read_bag(source: Source, topic: str | None) -> OccupancyGrid | np.ndarray:
    """The last point cloud or occupancy grid of a topic, in its own frame: no transforms are applied.

    Raises:
        InputError: no such bag, a damaged one, one that takes more than `BAG_MEMORY`, no topic with maps or several,
            and a message that isn't a map.
    """
    if topic is not None and not isinstance(topic, str):
        raise InputError(f"{source.name}.topic", "the name of a topic", shown(topic))
    if set(str(source.path)) & set("?#%"):  # rosbags hands it to SQLite as an address
        source.refuse("a bag whose path has no ?, # or %", "one that has")
    ros1 = source.path.suffix.lower() == ".bag"
    reader = imported(f"rosbags.rosbag{1 if ros1 else 2}", "maps", source.field).Reader
    if not source.path.is_dir():
        source.size(BAG_FILE)
    with source.library(BAG_FILE), limited(BAG_MEMORY):
        with reader(source.path) as bag:
            name = _chosen(source, bag.connections, topic)
            connection, raw = _last(source, bag, [one for one in bag.connections if one.topic == name])
        types = imported("rosbags.typesys", "maps", source.field)
        store = types.get_typestore(types.Stores.ROS1_NOETIC if ros1 else types.Stores.ROS2_HUMBLE)
        message = (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(raw, connection.msgtype)
    return {CLOUD: cloud_of, GRID: grid_of}[connection.msgtype](source, message)


def _chosen(source: Source, connections: Iterable[Any], wanted: str | None) -> str:
    """The topic `wanted`, or the only one that has maps."""
    maps = sorted({one.topic for one in connections if one.msgtype in (CLOUD, GRID)})
    said = ", ".join(maps[:8]) + (", ..." if len(maps) > 8 else "")
    if not maps:
        others = ", ".join(sorted({one.msgtype for one in connections})[:8])
        source.refuse(f"a bag with messages of {CLOUD} or {GRID}", others or "no messages")
    if wanted is None and len(maps) == 1:
        return maps[0]
    if wanted is None or wanted not in maps:
        raise InputError(f"{source.name}.topic", f"one of the topics with maps of {source.path}: {said}", wanted)
    return wanted


def _last(source: Source, bag: Any, connections: list[Any]) -> tuple[Any, bytes]:
    """The last message of some connections: by the bag's index, from its end, so that a large bag isn't read whole."""
    found, span = None, LAST
    while found is None:
        for connection, _, raw in bag.messages(connections, start=bag.end_time - span):
            found = connection, raw
        if found is None and bag.end_time - span <= bag.start_time:
            source.refuse(f"{BAG_FILE} with messages of {connections[0].topic}", "none")
        span *= FURTHER
    return found


def grid_of(source: Source, message: Any) -> OccupancyGrid:
    """The grid of a nav_msgs/OccupancyGrid, turned by its origin's yaw."""
    info = message.info
    source.limit(info.width * info.height, MOST_CELLS, f"cells ({info.width:,} x {info.height:,})")
    try:
        values = values_of_ros(message.data, (info.height, info.width))
    except InputError as error:
        source.refuse(error.expected, error.got)
    if not 0.0 < info.resolution < math.inf:
        source.refuse("a resolution > 0 m", info.resolution)
    resolution = float(np.format_float_positional(np.float32(info.resolution)))  # 0.05, not 0.05000000074505806
    corner, yaw = np.array([info.origin.position.x, info.origin.position.y]), _yaw(source, info.origin.orientation)
    if not np.isfinite(corner).all():
        source.refuse("a finite origin", f"({corner[0]}, {corner[1]})")
    check_far(source, corner)
    if yaw:
        values, corner = rotated(source, values, corner, yaw, resolution)
    return made(source, values, corner, resolution)


def _yaw(source: Source, turn: Any) -> float:
    """The angle about z of a quaternion, rad; one of zeros, which some programs leave, is none."""
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    size = math.hypot(x, y, z, w)
    if size == 0.0:
        return 0.0
    if not abs(size - 1.0) < 0.01 or not max(abs(x), abs(y)) < LEVEL:
        source.refuse("an origin turned about z alone, a unit quaternion", f"({x:.3g}, {y:.3g}, {z:.3g}, {w:.3g})")
    return 2.0 * math.atan2(z, w)


def cloud_of(source: Source, message: Any) -> np.ndarray:
    """The points (P, 3) of a sensor_msgs/PointCloud2."""
    height, width, step, data = message.height, message.width, message.point_step, message.data
    offsets: dict[str, tuple[int, np.dtype]] = {}
    for field in message.fields:
        if field.name in ("x", "y", "z"):
            kind = np.dtype((">" if message.is_bigendian else "<") + TYPES.get(field.datatype, "V0"))
            if not 0 < kind.itemsize <= step - field.offset:
                got = f"type {field.datatype} at byte {field.offset:,}"
                source.refuse(f"{field.name} as a number within a point's {step:,} bytes", got)
            offsets[field.name] = (field.offset, kind)
    if set(offsets) != {"x", "y", "z"}:
        names = ", ".join(field.name[:20] for field in message.fields[:8])
        source.refuse("points with x, y and z", names or "no fields")
    source.limit(height * width, MOST_POINTS, f"points ({height:,} x {width:,})")
    row = step * width if height == 1 else message.row_step  # some drivers leave it out
    if not height * width or row < step * width or len(data) < (height - 1) * row + step * width:
        source.refuse(f"{height:,} rows of {width:,} points of {step:,} bytes", f"{len(data):,} bytes")
    places = (offsets[axis] for axis in ("x", "y", "z"))
    columns = [np.ndarray((height, width), kind, data, offset, (row, step)).reshape(-1) for offset, kind in places]
    return finite_points(source, columns)
