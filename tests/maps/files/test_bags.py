"""Bags of ROS 1 and 2, and damaged ones."""

from __future__ import annotations

import sqlite3
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.fuzz.tally import accepted_or_refused
from tests.maps.files import bags
from tests.maps.files.bags import StoragePlugin, Stores, Writer1, Writer2, get_typestore
from tests.maps.files.samples import POINTS, ROOM
from torchgco import InputError
from torchgco.maps import OccupancyGrid, PointCloud, read
from torchgco.maps.files import bags as maps_of_bags
from torchgco.maps.files.bags import GRID, cloud_of, grid_of
from torchgco.maps.files.source import Source


@pytest.mark.parametrize("kind", bags.KINDS)
def test_the_last_grid_of_a_topic(kind: str, tmp_path: Path) -> None:
    """The room's frame is turned by a quarter: its x is the world's y, its y the world's -x."""
    grid = read(bags.write(tmp_path, kind), topic="/map")
    assert isinstance(grid, OccupancyGrid) and grid.resolution == 0.05 and grid.shape == (4, 6)
    np.testing.assert_allclose(grid.origin, [-1.2, 2.0])
    assert grid.occupied[tuple(grid.cell([-1 - 0.075, 2.125]))] == 1  # the post: cell (2, 1) of the room
    assert np.isnan(grid.occupied[tuple(grid.cell([-1 - 0.075, 2.075]))]) and grid.is_unknown.sum() == 1
    assert grid.is_occupied.sum() == ROOM.sum()


@pytest.mark.parametrize("kind", bags.KINDS)
def test_the_cloud_of_a_topic(kind: str, tmp_path: Path) -> None:
    cloud = read(bags.write(tmp_path, kind), topic="/points", radius=0.1)
    assert isinstance(cloud, PointCloud)
    np.testing.assert_array_equal(cloud.points, POINTS)


@pytest.mark.parametrize("kind", bags.KINDS)
def test_the_only_topic_with_maps_need_not_be_named(kind: str, tmp_path: Path) -> None:
    path = bags.write(tmp_path, kind, ("/points", "/said")) if kind != "folder" else bags.write(tmp_path, kind)
    if kind != "folder":
        assert isinstance(read(path, radius=0.1), PointCloud)
    with pytest.raises(InputError, match=r"one of the topics with maps of .*: .*/points, got /said") as error:
        read(path, radius=0.1, topic="/said", field="scenario")
    assert error.value.field == "scenario.topic"


@pytest.mark.parametrize("kind", bags.KINDS)
def test_several_topics_with_maps_are_named(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="/map, /points, got None"):
        read(bags.write(tmp_path, kind))


@pytest.mark.parametrize("kind", [kind for kind in bags.KINDS if kind != "folder"])
def test_bags_without_maps(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"messages of sensor_msgs/msg/PointCloud2 or .*: std_msgs/msg/String"):
        read(bags.write(tmp_path, kind, ("/said",)))


def test_folders(tmp_path: Path) -> None:
    path = bags.write(tmp_path, "folder")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    with pytest.raises(InputError, match=r"a bag of ROS 1, .*key is missing"):
        read(path, topic="/map")
    with pytest.raises(InputError, match="a file that ends with"):
        read(tmp_path, topic="/map")


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", [kind for kind in bags.KINDS if kind != "folder"])
def test_damaged_bags(kind: str, tmp_path: Path) -> None:
    name, data = bags.bag(kind)
    rng = np.random.default_rng(zlib.crc32(kind.encode()))
    cut = [data[: int(length)] for length in np.linspace(0, len(data) - 1, 60)]
    changed = []
    for _ in range(200):
        held = bytearray(data)
        for at in rng.integers(0, len(held), rng.integers(1, 30)):
            held[at] = rng.choice([held[at] ^ 1 << rng.integers(8), rng.integers(256), 0, 255])
        changed.append(bytes(held))
    for damaged in cut + changed:
        (tmp_path / name).write_bytes(damaged)
        for topic in ("/map", "/points"):
            radius = 0.1 if topic == "/points" else None
            accepted_or_refused("damaged bags", lambda t=topic, r=radius: read(tmp_path / name, topic=t, radius=r))


@pytest.mark.parametrize("ending", [".bag", ".mcap", ".db3"])
def test_other_bytes(ending: str, tmp_path: Path) -> None:
    for data in (b"", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0" + bytes(200), bytes(1000)):
        (tmp_path / f"a{ending}").write_bytes(data)
        with pytest.raises(InputError):
            read(tmp_path / f"a{ending}")


def test_mcap_without_an_index(tmp_path: Path) -> None:
    """Neither summary nor message indices: the chunks are looked through."""
    name, data = bags.bag("mcap zstd")
    kept, at = [], 8
    while at < len(data) - 8:
        kind, length = struct.unpack("<BQ", data[at : at + 9])
        if kind in (1, 6):  # header and chunks
            kept.append(data[at : at + 9 + length])
        at += 9 + length
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    (tmp_path / name).write_bytes(data[:8] + b"".join(kept) + footer + data[-8:])
    assert read(tmp_path / name, topic="/map").is_occupied.sum() == ROOM.sum()


@pytest.mark.skipif(sys.platform != "linux", reason="nothing limits memory")
def test_a_bag_takes_no_more_memory_than_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps_of_bags, "BAG_MEMORY", 2**26)
    path = tmp_path / "a.bag"
    with Writer1(path) as bag:
        connection = bag.add_connection("/map", GRID, typestore=get_typestore(Stores.ROS1_NOETIC))
        bag.write(connection, 10**9, bytes(2**28))
    with pytest.raises(InputError, match="MemoryError"):
        read(path)


def test_the_last_message_may_be_long_before_the_end(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    grids = bags.messages(store.types, False)
    with Writer2(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        map_, said = (
            bag.add_connection(topic, grids[topic][0].__msgtype__, typestore=store) for topic in ("/map", "/said")
        )
        for hours, grid in enumerate(grids["/map"]):
            bag.write(map_, hours * 10**12, store.serialize_cdr(grid, GRID))
        bag.write(said, 10**14, store.serialize_cdr(grids["/said"][0], "std_msgs/msg/String"))
    assert read(tmp_path / "bag").is_occupied.sum() == ROOM.sum()


def test_tables_of_sqlite_that_compute_without_end(tmp_path: Path) -> None:
    """Views aren't read."""
    with sqlite3.connect(tmp_path / "view.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id FROM c"
        database.execute(f"CREATE VIEW messages AS {endless}")
    with pytest.raises(InputError, match="missing tables"):
        read(tmp_path / "view.db3")


def test_names_that_sqlite_would_take_for_addresses(tmp_path: Path) -> None:
    for name in ("a b.db3", "a%20?b#c.db3"):
        (tmp_path / name).write_bytes(bags.bag("db3")[1])
    assert read(tmp_path / "a b.db3", topic="/map").is_occupied.sum() == ROOM.sum()
    with pytest.raises(InputError, match=r"has no \?, # or %"):
        read(tmp_path / "a%20?b#c.db3", topic="/map")


def grid_message(**changed: Any) -> Any:
    """A grid of one row of three cells."""
    changed = {"resolution": 0.1, "width": 3, "height": 1, "turn": (0.0, 0.0, 0.0, 1.0), "cells": [0, 50, -1]} | changed
    turn = SimpleNamespace(**dict(zip("xyzw", changed["turn"], strict=True)))
    origin = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=0.0), orientation=turn)
    info = SimpleNamespace(**{name: changed[name] for name in ("resolution", "width", "height")}, origin=origin)
    return SimpleNamespace(info=info, data=np.array(changed["cells"], np.int8))


def test_grids_written_by_hand(tmp_path: Path) -> None:
    grid = grid_of(Source(tmp_path), grid_message())
    assert isinstance(grid, OccupancyGrid) and grid.origin.tolist() == [1, 2] and grid.resolution == 0.1
    np.testing.assert_array_equal(grid.occupied[:, 0], np.array([0, 0.5, np.nan], np.float32))


@pytest.mark.parametrize(("changed", "said"), [
    ({"turn": (0.5, 0.5, 0.5, 0.5)}, "turned about z alone"),
    ({"turn": (0.0, 0.0, 0.0, 2.0)}, "a unit quaternion"),
    ({"turn": (np.nan, 0.0, 0.0, 1.0)}, "a unit quaternion"),
    ({"width": 4}, "1 x 4 whole numbers"),
    ({"width": 2**31, "height": 2**31}, "at most 134,217,728 cells"),
    ({"cells": [0, 101, -1]}, "from -1 to 100"),
    ({"cells": [0, 1, -2]}, "from -1 to 100"),
    ({"resolution": 0.0}, "a resolution > 0 m"),
    ({"resolution": float("nan")}, "a resolution > 0 m"),
])  # fmt: skip
def test_wrong_grids(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        grid_of(Source(tmp_path), grid_message(**changed))


def test_a_quaternion_of_zeros_is_no_turn(tmp_path: Path) -> None:
    grid = grid_of(Source(tmp_path), grid_message(turn=(0.0, 0.0, 0.0, 0.0)))
    assert isinstance(grid, OccupancyGrid) and grid.shape == (3, 1)


@pytest.mark.parametrize(("changed", "said"), [
    ({"point_step": 10}, "x as a number within a point's 10 bytes"),
    ({"fields": []}, "no fields"),
    ({"data": np.zeros(50, np.uint8)}, "2 rows of 2 points of 20 bytes"),
    ({"row_step": 1}, "2 rows of 2 points of 20 bytes"),
    ({"width": 2**31}, "at most 33,554,432 points"),
    ({"width": 0}, "2 rows of 0 points"),
])  # fmt: skip
def test_wrong_clouds(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    (cloud,) = bags.messages(get_typestore(Stores.ROS2_HUMBLE).types, False)["/points"]
    with pytest.raises(InputError, match=said):
        cloud_of(Source(tmp_path), replace(cloud, **changed))
