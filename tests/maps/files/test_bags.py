"""Bags of ROS 1 and 2, as the library `rosbags` writes them, and damaged ones."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fuzz.tally import accepted_or_refused
from tests.maps.files import bags
from tests.maps.files.samples import POINTS, ROOM
from torchgco import InputError
from torchgco.maps import OccupancyGrid, PointCloud, read
from torchgco.maps.files.bags import mcap, ros1, sqlite
from torchgco.maps.files.bags.container import GRIDS, Message
from torchgco.maps.files.bags.messages import decoded
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
    with pytest.raises(InputError, match=r"messages of sensor_msgs/PointCloud2 or .*: std_msgs/String"):
        read(bags.write(tmp_path, kind, ("/said",)))


def test_folders(tmp_path: Path) -> None:
    path = bags.write(tmp_path, "folder")
    (path / "more.db3").write_bytes(b"")
    with pytest.raises(InputError, match="one mcap or db3 file, or the path of one of them"):
        read(path, topic="/map")
    with pytest.raises(InputError, match="a file that ends with"):
        read(tmp_path, topic="/map")


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
    (tmp_path / name).write_bytes(data[:8] + b"".join(kept) + data[-8:])
    assert read(tmp_path / name, topic="/map").is_occupied.sum() == ROOM.sum()


def test_chunks_unpack_to_what_they_say(tmp_path: Path) -> None:
    """A chunk of a few bytes may hold a gigabyte: no more is unpacked than its header says, and that is limited."""
    packed = bz2.compress(bytes(10**7))
    for size, said in (
        (1000, "1,000 bytes in the chunk at byte 9, got .*more"),
        (2**31, "at most 536,870,912 bytes"),
    ):
        with pytest.raises(InputError, match=said):
            ros1.unpack(Source(tmp_path / "a.bag"), memoryview(packed), "bz2", size, 9)


def test_records_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1, "MOST_RECORDS", 4)
    monkeypatch.setattr(mcap, "MOST_RECORDS", 4)
    for kind in ("bag", "mcap"):
        with pytest.raises(InputError, match="at most 4 records"):
            read(bags.write(tmp_path, kind), topic="/map")


def test_tables_of_sqlite_that_compute_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views aren't read, and columns that are computed can't be large."""
    monkeypatch.setattr(sqlite, "MOST_MESSAGE", 10_000)
    with sqlite3.connect(tmp_path / "view.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id FROM c"
        database.execute(f"CREATE VIEW messages AS {endless}")
    with sqlite3.connect(tmp_path / "column.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("INSERT INTO topics VALUES (1, '/map', 'nav_msgs/msg/OccupancyGrid', 'cdr')")
        large = "data BLOB GENERATED ALWAYS AS (zeroblob(20000))"
        database.execute(f"CREATE TABLE messages (id INTEGER, topic_id INTEGER, timestamp INTEGER, {large})")
        database.execute("INSERT INTO messages VALUES (1, 1, 1)")
    for name, said in (("view.db3", "other tables"), ("column.db3", "too big")):
        with pytest.raises(InputError, match=said):
            read(tmp_path / name)


@pytest.mark.parametrize("name", ["a b.db3", "a%20?b#c.db3"])
def test_names_of_files_are_no_addresses(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(bags.bag("db3")[1])
    assert read(tmp_path / name, topic="/map").is_occupied.sum() == ROOM.sum()


def grid_message(ros1: bool = False, **changed: Any) -> Message:
    """A grid of one row of three cells, as ROS 2 writes it, or ROS 1."""
    given = {
        "resolution": 0.1,
        "width": 3,
        "height": 1,
        "turn": (0.0, 0.0, 0.0, 1.0),
        "cells": bytes([0, 50, 255]),
        **changed,
    }
    place = (1.0, 2.0, 0.0, *given["turn"])
    info = (0, 0, given["resolution"], given["width"], given["height"])
    cells = given["cells"]
    if ros1:
        data = struct.pack("<III", 1, 2, 3) + struct.pack("<I", 3) + b"map" + struct.pack("<IIfII", *info)
        return Message(GRIDS, data + struct.pack("<7d", *place) + struct.pack("<I", len(cells)) + cells, "ros1")
    order = given.get("order", "<")
    data = struct.pack(f"{order}iII", 1, 2, 4) + b"map\0" + struct.pack(f"{order}iIfII", *info)
    data += bytes(-len(data) % 8) + struct.pack(f"{order}7d", *place) + struct.pack(f"{order}I", len(cells)) + cells
    return Message(GRIDS, bytes([0, order == "<", 0, 0]) + data, "cdr")


@pytest.mark.parametrize("message", [grid_message(), grid_message(True), grid_message(order=">")])
def test_grids_written_by_hand(message: Message, tmp_path: Path) -> None:
    grid = decoded(Source(tmp_path), message)
    assert isinstance(grid, OccupancyGrid) and grid.origin.tolist() == [1, 2] and grid.resolution == 0.1
    np.testing.assert_array_equal(grid.occupied[:, 0], [0, 0.5, np.nan])


@pytest.mark.parametrize(("changed", "said"), [
    ({"turn": (0.5, 0.5, 0.5, 0.5)}, "turned about z alone"),
    ({"turn": (0.0, 0.0, 0.0, 2.0)}, "a unit quaternion"),
    ({"turn": (np.nan, 0.0, 0.0, 1.0)}, "a unit quaternion"),
    ({"width": 4}, "4 x 1 cells"),
    ({"width": 2**31, "height": 2**31}, "at most 134,217,728 cells"),
    ({"cells": bytes([0, 101, 255])}, "cells from 0 to 100"),
    ({"resolution": 0.0}, "a resolution > 0 m"),
    ({"resolution": float("nan")}, "a resolution > 0 m"),
])  # fmt: skip
def test_wrong_grids(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        decoded(Source(tmp_path), grid_message(**changed))


def test_a_quaternion_of_zeros_is_no_turn(tmp_path: Path) -> None:
    grid = decoded(Source(tmp_path), grid_message(turn=(0.0, 0.0, 0.0, 0.0)))
    assert isinstance(grid, OccupancyGrid) and grid.shape == (3, 1)
