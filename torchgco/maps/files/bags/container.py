"""What the containers of messages have in common: choosing a topic, and unpacking within bounds.

Read by hand: the library rosbags unpacks a block before it can be known how large that is.
"""

from __future__ import annotations

import bz2
from dataclasses import dataclass
from typing import Any

from torchgco.base.errors import InputError
from torchgco.maps.files.source import MOST_POINTS, Source

MOST_RECORDS = 2**23  # of a file
MOST_INSIDE = 2**20  # records in chunks, which may be far larger than the file: some seconds
MOST_MESSAGE = 16 * MOST_POINTS  # bytes of a message, or of a chunk of them: a cloud of four floats per point
CLOUDS, GRIDS = "sensor_msgs/PointCloud2", "nav_msgs/OccupancyGrid"


@dataclass(frozen=True)
class Message:
    """One message as it was sent: its type, bytes, and how they are written, `cdr` or `ros1`."""

    type: str
    data: bytes | memoryview
    encoding: str


def plain(type: str) -> str:
    """A message type by its name of ROS 1: `nav_msgs/msg/OccupancyGrid` is `nav_msgs/OccupancyGrid`."""
    return type.replace("/msg/", "/")


def choose(source: Source, topics: dict[str, str], wanted: str | None) -> str:
    """The topic `wanted`, or the only one that has maps.

    Args:
        topics: types of messages by topic.

    Raises:
        InputError: no or several topics have maps, or the one that is wanted has none.
    """
    maps = sorted(topic for topic, type in topics.items() if plain(type) in (CLOUDS, GRIDS))
    said = ", ".join(maps[:8]) + (", ..." if len(maps) > 8 else "")
    if not maps:
        others = ", ".join(sorted({plain(type) for type in topics.values()})[:8])
        source.refuse(f"a bag with messages of {CLOUDS} or {GRIDS}", others or "no messages")
    if wanted is None and len(maps) == 1:
        return maps[0]
    if wanted not in maps:
        raise InputError(f"{source.name}.topic", f"one of the topics with maps of {source.path}: {said}", wanted)
    return wanted


def unpack(source: Source, data: memoryview, compression: str, size: int, offset: int) -> bytes | memoryview:
    """`size` bytes that were packed by bz2, lz4, zstd or not at all; `offset` is where they lie, for errors."""
    source.limit(size, MOST_MESSAGE, "bytes of a chunk")
    if compression in ("", "none"):
        unpacked: Any = data
    elif compression not in ("bz2", "lz4", "zstd"):
        source.refuse("chunks packed by bz2, lz4, zstd or not at all", repr(compression[:40]))
    else:
        decompressor = _decompressor(source, compression)
        with source.library(f"a chunk packed by {compression} at byte {offset:,}"):
            # One byte more shows that there are more.
            unpacked = decompressor.decompress(bytes(data), max_length=size + 1)
    if len(unpacked) != size:
        got = f"{len(unpacked):,}" if len(unpacked) < size else "more"
        source.refuse(f"{size:,} bytes in the chunk at byte {offset:,}", got)
    return unpacked


def _decompressor(source: Source, compression: str) -> Any:
    try:
        if compression == "bz2":
            return bz2.BZ2Decompressor()
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return LZ4FrameDecompressor()
        try:
            from compression.zstd import ZstdDecompressor  # pyright: ignore[reportMissingImports]
        except ImportError:
            from backports.zstd import ZstdDecompressor  # before Python 3.14
        return ZstdDecompressor()
    except ImportError:
        source.refuse(f"a bag packed by {compression} with the extra maps: pip install 'torchgco[maps]'", "none")
