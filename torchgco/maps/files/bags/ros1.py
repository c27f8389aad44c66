"""Bags of ROS 1, version 2.0. The format: http://wiki.ros.org/Bags/Format/2.0."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from torchgco.base.errors import shown
from torchgco.maps.files.bags.container import MOST_INSIDE, MOST_RECORDS, Message, choose, unpack
from torchgco.maps.files.source import Cursor, Source

BAG_FILE = "a bag of ROS 1, version 2.0"
BAG_BEGINS = b"#ROSBAG V2.0\n"
MESSAGE, INDEX, CHUNK, CONNECTION = 2, 4, 5, 7  # kinds of records
MOST_HEADER = 2**16  # bytes
MOST_CONNECTION = 2**24  # bytes, mostly the definition of its messages
Time = tuple[int, int]  # seconds, nanoseconds


@dataclass
class Chunk:
    """Messages that were packed together: where, how, and the latest time of each connection."""

    at: int
    packed: int
    compression: str
    size: int
    latest: dict[int, Time] = field(default_factory=dict)


def last_message(source: Source, topic: str | None) -> Message:
    """The last message of the topic, or of the only one that has maps.

    Raises:
        InputError: no such bag, one without an index, damage, no such topic.
    """
    with source.opened(BAG_FILE) as (data, size):
        cursor = Cursor(source, data, BAG_FILE)
        if bytes(cursor.take(min(size, len(BAG_BEGINS)), "its first line")) != BAG_BEGINS:
            source.refuse(f"{BAG_FILE}, which begins with {BAG_BEGINS.decode().strip()}", "another beginning")
        connections, chunks = _walk(cursor)
        if not connections:
            source.refuse(f"{BAG_FILE} with an index (`rosbag reindex` makes one)", "none")
        name = choose(source, dict(connections.values()), topic)
        ids = {id for id, (other, _) in connections.items() if other == name}
        latest = [max((time for id, time in chunk.latest.items() if id in ids), default=None) for chunk in chunks]
        times = [time for time in latest if time is not None]
        if not times:
            source.refuse(f"{BAG_FILE} with messages of {name}", "none")
        chunk = chunks[latest.index(max(times))]
        cursor.at = chunk.at
        packed = cursor.take(chunk.packed, "a chunk")
        data = _last(source, unpack(source, packed, chunk.compression, chunk.size, chunk.at), ids, chunk.at)
    return Message(dict(connections.values())[name], data, "ros1")


def _walk(cursor: Cursor) -> tuple[dict[int, tuple[str, str]], list[Chunk]]:
    """Topic and type of each connection, and the chunks, whose messages aren't looked at."""
    connections: dict[int, tuple[str, str]] = {}
    chunks: list[Chunk] = []
    for _ in range(MOST_RECORDS):
        if not cursor.left:
            return connections, chunks
        header, length = _header(cursor), cursor.number("I", "a record's length")
        kind, after = header.get(b"op", b""), cursor.at + length
        if length > cursor.left:
            cursor.take(length, "a record")
        if kind == bytes([CHUNK]):
            compression = header.get(b"compression", b"none").decode("ascii", "replace")
            chunks.append(Chunk(cursor.at, length, compression, _number(cursor, header, b"size")))
        elif kind == bytes([INDEX]) and chunks and length >= 12:
            cursor.at = after - 12  # entries are in the order of time
            time = (cursor.number("I", "a time"), cursor.number("I", "a time"))
            chunks[-1].latest[_number(cursor, header, b"conn")] = time
        elif kind == bytes([CONNECTION]):
            cursor.source.limit(length, MOST_CONNECTION, "bytes of a connection")
            fields = _fields(cursor, bytes(cursor.take(length, "a connection")))
            topic, type = (
                info.get(key, b"").decode("utf-8", "replace") for info, key in ((header, b"topic"), (fields, b"type"))
            )
            connections[_number(cursor, header, b"conn")] = (topic, type)
        cursor.at = after
    cursor.source.refuse(f"at most {MOST_RECORDS:,} records", "more")


def _last(source: Source, chunk: bytes | memoryview, ids: set[int], offset: int) -> memoryview:
    """The last message of these connections in an unpacked chunk."""
    inside = Cursor(source, chunk, f"a sound chunk at byte {offset:,}")
    message = None
    for _ in range(MOST_INSIDE):
        if not inside.left:
            break
        header = _header(inside)
        data = inside.take(inside.number("I", "a record's length"), "a record")
        if header.get(b"op") == bytes([MESSAGE]) and _number(inside, header, b"conn") in ids:
            message = data
    else:
        source.refuse(f"at most {MOST_INSIDE:,} records in the chunk at byte {offset:,}", "more")
    if message is None:
        source.refuse("the message that the index names", f"none in the chunk at byte {offset:,}")
    return message


def _header(cursor: Cursor) -> dict[bytes, bytes]:
    length = cursor.number("I", "a header's length")
    cursor.source.limit(length, MOST_HEADER, "bytes of a header")
    return _fields(cursor, bytes(cursor.take(length, "a header")))


def _fields(cursor: Cursor, data: bytes) -> dict[bytes, bytes]:
    """Values by name: each has a length, then `name=value`."""
    values: dict[bytes, bytes] = {}
    offset = 0
    while offset < len(data):
        length = int.from_bytes(data[offset : offset + 4], "little")
        name, sign, value = data[offset + 4 : offset + 4 + length].partition(b"=")
        if offset + 4 + length > len(data) or not sign:
            cursor.source.refuse(
                f"{cursor.expected} with fields name=value", f"{shown(name[:40])} before byte {cursor.at:,}"
            )
        values[name] = value
        offset += 4 + length
    return values


def _number(cursor: Cursor, header: dict[bytes, bytes], name: bytes) -> int:
    value = header.get(name, b"")
    if len(value) != 4:
        cursor.source.refuse(
            f"{cursor.expected} with {name.decode()} in each header", f"none before byte {cursor.at:,}"
        )
    return struct.unpack("<I", value)[0]
