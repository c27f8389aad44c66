"""Small files that promise much, each with what reads it; and a way to measure that within limits."""

from __future__ import annotations

import json
import multiprocessing
import resource
import sqlite3
import struct
import time
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.maps.files import samples
from torchgco import InputError
from torchgco.experiments.config.build import compose_config
from torchgco.experiments.reports.finished import Study
from torchgco.experiments.results.folder import read_trials
from torchgco.experiments.results.identity import Manifest, digest, settings_of
from torchgco.experiments.results.limits import read_npz
from torchgco.maps import read
from torchgco.scenarios import Layouts

SECONDS, BYTES = 10, 2**30  # within which a file is refused
SAFETY = 4 * BYTES  # of memory that a reader can take at most while it is tried
Read = Callable[[], Any]


def zipped(name: str, size: int, shape: str = "(3,)") -> bytes:
    """A zip file with one npy array, which it says to be of `size` bytes."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    data = zlib.compress(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(10**6))[2:-4]
    about = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0, 0, len(data), size, len(name), 0)
    local = b"PK\x03\x04" + about + name.encode() + data
    central = b"PK\x01\x02" + struct.pack("<H", 20) + about + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name.encode()
    return local + central + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)


def run(folder: Path, **changed: Any) -> Path:
    """A folder with the study.json of a finished study, the given keys of its vehicle changed, and one layout."""
    config = compose_config(["solver=hold", "scenario=walls"])
    held = {"version": "0", **config}
    held["model"]["vehicle"] |= changed
    (folder / "study.json").write_bytes(Manifest(held, {"hold": settings_of(config)}, {0: "a"}).to_json())
    (folder / "done").write_text("{}")
    Layouts(np.zeros((1, 1, 3)), np.full((1, 1), 0.1)).save(folder / "layouts.npz")
    names = ("scenario", "layout", "seed", "model", "solver", "layout_digest", "settings_digest", "best_from")
    pq.write_table(pa.table({name: ["a"] for name in names}), folder / "trials.parquet")
    return folder


def run_with(name: str, data: bytes, folder: Path) -> Read:
    (run(folder) / name).write_bytes(data)
    return lambda: Study.read(folder)


def deep_settings(folder: Path) -> Read:
    """A checksum that is right, as far as it can be made."""
    held = json.loads((run(folder) / "study.json").read_text())
    del held["checksum"]
    radius: Any = 0.3
    for _ in range(250):
        radius = [radius]
    held["configuration"]["model"]["vehicle"]["radius"] = radius
    (folder / "study.json").write_text(json.dumps({**held, "checksum": digest(held)}))
    return lambda: Study.read(folder)


def rows(folder: Path) -> Read:
    column = pa.nulls(2 * 10**7, pa.int8())
    pq.write_table(pa.table({str(i): column for i in range(8)}), folder / "trials.parquet")
    return lambda: read_trials(folder / "trials.parquet")


def texts(folder: Path) -> Read:
    """One long text in every row, held once."""
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(4000, np.int32)), ["a" * 2**20])
    pq.write_table(pa.table({"scenario": column}), folder / "trials.parquet", compression="zstd")
    return lambda: read_trials(folder / "trials.parquet")


def long_pages(folder: Path) -> Read:
    """Pages of texts, each longer than the footer says."""
    path, text = folder / "trials.parquet", pa.array(["a" * 300_000_000])
    table = pa.table({str(i): text for i in range(4)})
    pq.write_table(table, path, compression="zstd", use_dictionary=False, write_statistics=False)
    raw = path.read_bytes()
    at = len(raw) - 8 - struct.unpack("<I", raw[-8:-4])[0]
    about = pq.read_metadata(path).row_group(0)
    foot = raw[at:]
    for size in (about.total_byte_size, about.column(0).total_uncompressed_size):
        foot = foot.replace(varint(size), varint(100, len(varint(size))))
    path.write_bytes(raw[:at] + foot)
    return lambda: read_trials(path)


def varint(number: int, length: int = 1) -> bytes:
    """A whole number as Thrift packs it, in so many bytes or more."""
    left, held = 2 * number, []
    while left or len(held) < length:
        held.append(left & 127)
        left >>= 7
    return bytes([*(one | 128 for one in held[:-1]), held[-1]])


def empty_layouts(folder: Path) -> Read:
    np.savez(run(folder) / "layouts.npz", centers=np.zeros((10**12, 0, 3)), radii=np.zeros((10**12, 0)))
    return lambda: Study.read(folder)


def far_points(folder: Path) -> Read:
    """A map of two points, and of distances at 10^8 places."""
    held = {"map_points": np.array([[0.0] * 3, [50.0] * 3]), "map_radius": np.array(0.1)}
    np.savez(run(folder) / "layouts.npz", centers=np.zeros((1, 0, 3)), radii=np.zeros((1, 0)), **held)
    return lambda: Study.read(folder)


def solutions(folder: Path) -> Read:
    (folder / "solutions.npz").write_bytes(zipped("U.npy", 2**32 - 1))
    return lambda: read_npz(folder / "solutions.npz")


def map_of(name: str, data: bytes, folder: Path, **options: Any) -> Read:
    (folder / "plan.pgm").write_bytes(samples.SAMPLES["plan.pgm"][0])
    (folder / name).write_bytes(data)
    return lambda: read(folder / name, **options)


def png() -> bytes:
    data = samples.png(np.zeros((1, 1), np.uint8))
    head = b"IHDR" + struct.pack(">IIBBBBB", 2**30, 2**30, 8, 0, 0, 0, 0)
    return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]


def packed_points() -> bytes:
    """LZF packs 264 zeros in three bytes; as many points as are read, and no right end."""
    count, size = 2**23, 12 * 2**23
    body = b"\x00\x00" + b"\xe0\xff\x00" * (size // 264)
    head = samples.pcd("binary_compressed").split(b"DATA")[0].replace(b" 40\n", b" %d\n" % count)
    return head + b"DATA binary_compressed\n" + struct.pack("<II", len(body), size) + body


def tree() -> bytes:
    """Nodes that promise children without end."""
    data = samples.SAMPLES["tree.bt"][0]
    return data[: data.index(b"data\n") + 5].replace(b"size 34", b"size 99999999") + b"\xaa\xaa" * 10**6


def bag(packed: str, size: int, folder: Path) -> Read:
    """A bag of ROS 1 whose chunk unpacks to zeros."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    writer = Writer(folder / "a.bag")
    writer.set_compression(Writer.CompressionFormat[packed])
    pack = writer.compressor
    writer.compressor = lambda _: pack(bytes(size))
    with writer:
        store = get_typestore(Stores.ROS1_NOETIC)
        connection = writer.add_connection("/map", "nav_msgs/msg/OccupancyGrid", typestore=store)
        writer.write(connection, 1, b"")
    return lambda: read(folder / "a.bag")


def db3(folder: Path) -> Read:
    path = folder / "a.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("create table topics(id integer, name text, type text, serialization_format text)")
        columns = "id integer, topic_id integer, timestamp integer, data blob as (zeroblob(900000000))"
        database.execute(f"create table messages({columns})")
        database.execute("insert into messages values (1, 1, 1)")
        database.execute("insert into topics values (1, '/map', 'nav_msgs/msg/OccupancyGrid', 'cdr')")
        database.commit()
    return lambda: read(path)


LAUGHS = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [%s]\n" % (n, n, b",".join([b"*%c" % (n - 1)] * 9)) for n in range(ord("b"), ord("k"))
)
BOMBS: dict[str, Callable[[Path], Read]] = {
    "layouts.npz that names 4 GB": partial(run_with, "layouts.npz", zipped("centers.npy", 2**32 - 1)),
    "layouts.npz, 10^12 layouts without obstacles": empty_layouts,
    "layouts.npz, two points 87 m from each other": far_points,
    "layouts.npz, an array of 8 TB": partial(run_with, "layouts.npz", zipped("centers.npy", 10**6, f"({10**12},)")),
    "study.json, 100,000 lists": partial(run_with, "study.json", b"[" * 10**5),
    "done, 100,000 lists": partial(run_with, "done", b"[" * 10**5),
    "study.json, 250 lists in a list": deep_settings,
    "study.json, 10^9 stages": lambda folder: partial(Study.read, run(folder, stages=10**9)),
    "trials.parquet, 160 million cells": rows,
    "trials.parquet, a text of 1 MB in 4,000 rows": texts,
    "trials.parquet, pages of 1.2 GB that name 100 bytes": long_pages,
    "solutions.npz that names 4 GB": solutions,
    "yaml of a map, aliases of aliases": partial(map_of, "a.yaml", samples.yaml("plan.pgm") + LAUGHS),
    "yaml of a map, 4,000 lists": partial(map_of, "a.yaml", samples.yaml("plan.pgm") + b"more: " + b"[" * 4000),
    "png of 2^60 pixels": partial(map_of, "a.png", png(), resolution=1.0),
    "npz of a map that names 4 GB": partial(map_of, "a.npz", zipped("occupied.npy", 2**32 - 1)),
    "npy of 32 TB": partial(
        map_of, "a.npy", samples.npy(np.zeros((4, 3))).replace(b"(4, 3), }" + b" " * 12, b"(4000000000000, 3), }"),
        radius=1.0,
    ),
    "pcd, 2^23 points packed": partial(map_of, "a.pcd", packed_points(), radius=1.0),
    "ply of 2 x 10^9 points": partial(
        map_of, "a.ply", samples.ply("binary_little_endian").replace(b"vertex 4", b"vertex 2000000000"), radius=1.0
    ),
    "OctoMap, nodes without end": partial(map_of, "a.bt", tree()),
    "bag of ROS 1, a chunk of 1 GB": partial(bag, "LZ4", 10**9),
    "bag of ROS 1, 100 MB of zeros": partial(bag, "BZ2", 10**8),
    "db3, a message of 900 MB": db3,
}  # fmt: skip


def attempt(name: str, folder: Path) -> tuple[str, float, float, int]:
    """The line that refuses a file, seconds of the processor, MB of memory, and bytes of the folder."""
    work = BOMBS[name](folder)
    size = sum(path.stat().st_size for path in folder.iterdir())
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def refuse() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (2 * SECONDS, 2 * SECONDS))
        held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (used + SAFETY, used + SAFETY))
        began, told = time.process_time(), "read"
        try:
            work()
        except InputError as error:
            told = str(error)
        except BaseException as error:
            told = f"{type(error).__name__}: {error}"[:300]
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held
        sender.send((told, time.process_time() - began, grown * 1024 / 1e6))

    child = context.Process(target=refuse)
    child.start()
    sender.close()
    try:
        told, seconds, memory = receiver.recv()
    except EOFError:
        told, seconds, memory = "killed by the limits", float("inf"), float("inf")
    child.join()
    return told, seconds, memory, size
