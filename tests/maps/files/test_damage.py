"""Any bytes are a map, or one clear line, in little time and memory."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.tally import accepted_or_refused
from tests.maps.files import samples
from torchgco import InputError
from torchgco.maps import read
from torchgco.maps.files import FORMATS

CHANGES = 200  # damaged copies of each sample


def attempt(path: Path, data: bytes, options: dict[str, float]) -> None:
    path.write_bytes(data)
    accepted_or_refused("damaged map files", lambda: read(path, **options))


@pytest.mark.parametrize("name", samples.SAMPLES)
def test_cut_at_every_length(name: str, tmp_path: Path) -> None:
    data, options = samples.SAMPLES[name]
    path = samples.write(tmp_path, name)
    for length in range(0, len(data), max(len(data) // 300, 1)):
        attempt(path, data[:length], options)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("name", samples.SAMPLES)
def test_changed_bytes(name: str, tmp_path: Path) -> None:
    data, options = samples.SAMPLES[name]
    path = samples.write(tmp_path, name)
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    for _ in range(CHANGES):
        held = bytearray(data)
        for at in rng.integers(0, len(held), rng.integers(1, 4)):
            held[at] = rng.choice([held[at] ^ 1 << rng.integers(8), rng.integers(256), 0, 255, ord("9")])
        attempt(path, bytes(held), options)


@pytest.mark.parametrize("ending", FORMATS)
def test_random_bytes(ending: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(zlib.crc32(ending.encode()))
    option = {name: 1.0 for name in ("resolution",) if name in FORMATS[ending].options}
    for length in (0, 1, 7, 100, 5000):
        attempt(tmp_path / f"a{ending}", rng.bytes(length), option)


def bomb(kind: str) -> tuple[str, bytes, dict[str, float]]:
    """Small files that name large contents."""
    if kind == "png":
        data = samples.png(np.zeros((1, 1), np.uint8))
        head = b"IHDR" + struct.pack(">IIBBBBB", 2**30, 2**30, 8, 0, 0, 0, 0)
        return "a.png", data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:], {"resolution": 1.0}
    if kind == "pgm":
        return "a.pgm", b"P5\n100000 100000\n255\n" + bytes(100), {"resolution": 1.0}
    if kind == "npy":
        data = samples.npy(np.zeros((4, 3)))
        return "a.npy", data.replace(b"(4, 3), }" + b" " * 12, b"(4000000000000, 3), }"), {"radius": 1.0}
    if kind == "npz":
        return "a.npz", samples.npz(occupied=np.zeros((2**14, 2**13 + 1), bool)), {}
    if kind == "packed pcd":
        data = samples.pcd("binary_compressed").replace(b" 40\n", b" 33000000\n")
        return "a.pcd", data.replace(struct.pack("<I", 480), struct.pack("<I", 12 * 33_000_000)), {"radius": 1.0}
    if kind == "heights":
        return "a.npy", samples.npy(np.array([[0.0, 9e6]])), {"height": 1.0, "resolution": 1e-3}
    if kind == "bt":  # a free leaf of half the frame's side
        return "a.bt", bt(b"\x01\x00"), {}
    return "a.yaml", samples.yaml("plan.pgm", more="[" + "[], " * 4000 + "]"), {}


def bt(nodes: bytes) -> bytes:
    data = samples.SAMPLES["tree.bt"][0]
    return data[: data.index(b"data\n") + 5].replace(b"size 34", b"size 2") + nodes


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", ["png", "pgm", "npy", "npz", "packed pcd", "heights", "bt", "yaml"])
def test_sizes_are_checked_before_memory_is_taken(kind: str, tmp_path: Path) -> None:
    name, data, options = bomb(kind)
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            read(tmp_path / name, **options)
        assert tracemalloc.get_traced_memory()[1] < (150e6 if kind == "npz" else 30e6)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["tree.bt", "tree.ot"])
def test_trees_without_end(name: str, tmp_path: Path) -> None:
    """Nodes that always have children go deeper than a tree may."""
    data = samples.SAMPLES[name][0]
    head = data[: data.index(b"data\n") + 5].replace(b"size 34", b"size 9999999")
    node = b"\xff\xff" if name == "tree.bt" else struct.pack("<fB", 1.0, 255)
    (tmp_path / name).write_bytes(head + node * 1000)
    with pytest.raises(InputError, match="a deeper one at byte"):
        read(tmp_path / name)
