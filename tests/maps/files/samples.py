"""A small sound file of each format, written here by hand or once by the library that owns the format."""

from __future__ import annotations

import io
import struct
import zlib
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest

# Walls of a room of 6 x 4 cells, rows from the top as in an image: 1 is occupied.
ROOM = np.array([[1, 1, 1, 1, 1, 1], [1, 0, 0, 0, 0, 1], [1, 0, 1, 0, 0, 0], [1, 1, 1, 1, 1, 1]])
POINTS = np.array([[0.5, -1.0, 2.0], [1.25, 3.0, -0.5], [-7.0, 0.125, 0.0], [4.0, 4.0, 4.0]])

# OctoMap 1.10 wrote these two (by pyoctomap 1.2.2): cells of 0.25 m, occupied in the cube from (0, 0.5, -0.5) to
# (0.5, 1, 0) and in the cell at (-0.375, 0.625, 0.375), free in the cell at (0.625, 0.625, -0.125).
OT = (
    "IyBPY3RvbWFwIE9jVHJlZSBmaWxlCiMgKGZlZWwgZnJlZSB0byBhZGQgLyBjaGFuZ2UgY29tbWVudHMsIGJ1dCBsZWF2ZSB0aGUgZmlyc3QgbGlu"
    "ZSBhcyBpdCBpcyEpCiMKaWQgT2NUcmVlCnNpemUgMzQKcmVzIDAuMjUKZGF0YQqD6Fg/SIPoWD8Qg+hYPxCD6Fg/EIPoWD8Qg+hYPxCD6Fg/EIPo"
    "WD8Qg+hYPxCD6Fg/EIPoWD8Qg+hYPxCD6Fg/EIPoWD8Qg+hYP8CD6Fg/AB+Zz74QH5nPvgCD6Fg/AoPoWD8Cg+hYPwKD6Fg/AoPoWD8Cg+hYPwKD"
    "6Fg/AoPoWD8Cg+hYPwKD6Fg/AoPoWD8Cg+hYPwKD6Fg/AoPoWD8Ig+hYPxCD6Fg/AA=="
)
BT = (
    "IyBPY3RvbWFwIE9jVHJlZSBiaW5hcnkgZmlsZQojIChmZWVsIGZyZWUgdG8gYWRkIC8gY2hhbmdlIGNvbW1lbnRzLCBidXQgbGVhdmUgdGhlIGZp"
    "cnN0IGxpbmUgYXMgaXQgaXMhKQojCmlkIE9jVHJlZQpzaXplIDM0CnJlcyAwLjI1CmRhdGEKwDAAAwADAAMAAwADAAMAAwADAAMAAwADAAMAAwDg"
    "AAEMAAwADAAMAAwADAAMAAwADAAMAAwADAAMAMAAAAI="
)
# 40 points as float32, packed by liblzf: x = i // 8, y = 2, z = i % 4 / 4.
PACKED = b64decode("AQAA4BcAAYA/4BUDAQBA4BUDAEAgH+ATAwCAIB/gEwPgF1/geB8gAAGAPiAEIScAQCADQADgfw8BQD8=")
PACKED_POINTS = np.stack([np.arange(40) // 8, np.full(40, 2.0), np.arange(40) % 4 / 4], 1)

WORLD = (
    b"<sdf version='1.7'><model name='a'><static>1</static><pose>0 1 0 0 0 0.4</pose>"
    b"<link name='l'><collision name='c'><geometry><box><size>2 1 1</size></box></geometry>"
    b"</collision></link></model></sdf>"
)
# A header of 80 bytes, one triangle: its normal, three corners, and two bytes.
STL = bytes(80) + struct.pack("<I12f2x", 1, 0, 0, 1, *(0, 0, 0), *(2, 0, 0), *(0, 2, 0))


def png(pixels: np.ndarray) -> bytes:
    """Grey (rows, columns), or with channels: grey and opacity, colours, colours and opacity; uint8 or uint16."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    big = pixels.astype(pixels.dtype.newbyteorder(">"))
    rows = b"".join(b"\0" + row.tobytes() for row in big)

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 8 * pixels.dtype.itemsize, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def pgm(pixels: np.ndarray) -> bytes:
    return b"P5\n# a map\n%d %d\n255\n" % pixels.shape[::-1] + pixels.astype(np.uint8).tobytes()


def yaml(image: str, **changed: object) -> bytes:
    keys = {
        "image": image, "resolution": 0.5, "origin": [-1.0, 2.0, 0.0], "negate": 0, "occupied_thresh": 0.65,
        "free_thresh": 0.196, **changed,
    }  # fmt: skip
    return "".join(f"{key}: {value}\n" for key, value in keys.items() if value is not None).encode()


def npz(**changed: object) -> bytes:
    held = {"occupied": ROOM[::-1].T.astype(bool), "origin": [-1.0, 2.0], "resolution": 0.5, **changed}
    file = io.BytesIO()
    np.savez(file, **{name: np.asarray(value) for name, value in held.items() if value is not None})
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def xyz() -> bytes:
    lines = ["# x y z intensity", *(f"{x} {y}\t{z} 7" for x, y, z in POINTS)]
    return ("\n".join(lines) + "\n").encode()


def pcd(data: str) -> bytes:
    """POINTS between an intensity and three bytes of colour."""
    count = 40 if data == "binary_compressed" else len(POINTS)
    fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    if data != "binary_compressed":
        fields = "FIELDS intensity x y z rgb\nSIZE 2 4 4 8 1\nTYPE U F F F U\nCOUNT 1 1 1 1 3\n"
    head = f"# .PCD v0.7\nVERSION 0.7\n{fields}WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
    if data == "ascii":
        body = "".join(f"9 {x} {y} {z} 1 2 3\n" for x, y, z in POINTS).encode()
    elif data == "binary":
        body = b"".join(struct.pack("<HffdBBB", 9, x, y, z, 1, 2, 3) for x, y, z in POINTS)
    else:
        body = struct.pack("<II", len(PACKED), 480) + PACKED
    return f"{head}DATA {data}\n".encode() + body


def ply(kind: str) -> bytes:
    """POINTS with a colour, after a table of two numbers and before one of lists."""
    head = (
        f"ply\nformat {kind} 1.0\ncomment made by hand\nelement camera 2\nproperty float gain\n"
        f"element vertex {len(POINTS)}\nproperty uchar red\nproperty float x\nproperty double y\nproperty float z\n"
        "element curve 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        body = "0.5\n0.25\n" + "".join(f"255 {x} {y} {z}\n" for x, y, z in POINTS) + "2 0 1\n"
        return (head + body).encode()
    order = "<" if "little" in kind else ">"
    body = struct.pack(f"{order}ff", 0.5, 0.25)
    body += b"".join(struct.pack(f"{order}Bfdf", 255, x, y, z) for x, y, z in POINTS)
    return head.encode() + body + struct.pack(f"{order}Bii", 2, 0, 1)


WHITE_ROOM = np.where(ROOM, 0, 254).astype(np.uint8)
RESOLUTION, RADIUS = {"resolution": 0.5}, {"radius": 0.1}

# Name of a file, its bytes, and the options of `read` that it needs.
SAMPLES: dict[str, tuple[bytes, dict[str, float]]] = {
    "grid.npz": (npz(), {}),
    "points.npy": (npy(POINTS), RADIUS),
    "cells.npy": (npy(ROOM[::-1].T.astype(bool)), RESOLUTION),
    "heights.npy": (npy(np.array([[0.2, 1.0], [0.0, 0.7]])), RESOLUTION | {"height": 1.0}),
    "points.xyz": (xyz(), RADIUS),
    "plan.png": (png(WHITE_ROOM), RESOLUTION),
    "plan.pgm": (pgm(WHITE_ROOM), RESOLUTION),
    "map.yaml": (yaml("plan.pgm"), {}),
    "turned.yaml": (yaml("plan.pgm", origin=[1.0, 0.0, 0.3], mode="scale"), {}),
    "ascii.pcd": (pcd("ascii"), RADIUS),
    "binary.pcd": (pcd("binary"), RADIUS),
    "packed.pcd": (pcd("binary_compressed"), RADIUS),
    "ascii.ply": (ply("ascii"), RADIUS),
    "little.ply": (ply("binary_little_endian"), RADIUS),
    "big.ply": (ply("binary_big_endian"), RADIUS),
    "tree.bt": (b64decode(BT), {}),
    "tree.ot": (b64decode(OT), {}),
    "city.map": (b"type octile\nheight 2\nwidth 3\nmap\n@.T\nSGW\n", RESOLUTION),
    "yard.world": (WORLD, RESOLUTION),
    "wedge.stl": (STL, RESOLUTION),
    "wedge.obj": (b"v 0 0 0\nv 2 0 0\nv 0 2 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n", RESOLUTION),
}


def write(folder: Path, name: str, data: bytes | None = None) -> Path:
    """The sample, or other bytes under its name, with the image that map_server's yaml files name."""
    if name.endswith((".ply", ".stl", ".obj")):
        pytest.importorskip("trimesh")
    if name.endswith(".yaml"):
        (folder / "plan.pgm").write_bytes(SAMPLES["plan.pgm"][0])
    (folder / name).write_bytes(SAMPLES[name][0] if data is None else data)
    return folder / name
