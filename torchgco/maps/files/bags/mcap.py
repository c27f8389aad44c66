"""mcap files, as ROS 2 and others write. The format: https://mcap.dev/spec."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchgco.maps.files.bags.container import MOST_INSIDE, MOST_MESSAGE, MOST_RECORDS, Message, choose, unpack
from torchgco.maps.files.source import Cursor, Source

MCAP = "an mcap file"
MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK, MCAP_INDEX = 3, 4, 5, 6, 7  # kinds of records
MOST_SCHEMA = 2**24  # bytes
MOST_UNPACKED = 2**32  # bytes of all chunks of a file without an index


@dataclass(frozen=True)
class Place:
    """Where a message may be: in the file, or in the unpacked chunk that begins at byte `chunk`."""

    time: int
    at: int
    length: int
    chunk: int | None


@dataclass
class Contents:
    """What was found so far: types by schema, (topic, schema, encoding) by channel, and each channel's last message."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, tuple[str, int, str]] = field(default_factory=dict)
    last: dict[int, Place] = field(default_factory=dict)
    # Latest times by channel, by the chunk's first byte.
    chunks: dict[int, dict[int, int]] = field(default_factory=dict)
    records: int = 0
    unpacked: int = 0  # records in chunks

    def topics(self) -> dict[str, str]:
        """Types by topic."""
        return {topic: self.schemas.get(schema, "") for topic, schema, _ in self.channels.values()}


def last_message(source: Source, topic: str | None) -> Message:
    """The last message of the topic, or of the only one that has maps.

    Raises:
        InputError: no such file, damage, no such topic.
    """
    with source.opened(MCAP) as (data, size):
        cursor = Cursor(source, data, MCAP)
        if bytes(cursor.take(min(size, len(MAGIC)), "its beginning")) != MAGIC:
            source.refuse(f"{MCAP}, which begins with {MAGIC!r}", "another beginning")
        contents = Contents()
        _walk(cursor, contents)
        if not contents.channels or not all(contents.chunks.values()):
            _walk_chunks(cursor, contents)  # no index
        topics = contents.topics()
        name = choose(source, topics, topic)
        ids = {id for id, (other, _, _) in contents.channels.items() if other == name}
        indexed = [
            (max(times[id] for id in ids & times.keys()), offset)
            for offset, times in contents.chunks.items()
            if ids & times.keys()
        ]
        if indexed:
            _walk(_chunk(cursor, max(indexed)[1]), contents, max(indexed)[1])
        if not (places := [(contents.last[id].time, id) for id in ids & contents.last.keys()]):
            source.refuse(f"{MCAP} with messages of {name}", "none")
        id = max(places)[1]
        entry = contents.last[id]
        inside = cursor if entry.chunk is None else _chunk(cursor, entry.chunk)
        inside.at = entry.at
        return Message(topics[name], bytes(inside.take(entry.length, "a message")), contents.channels[id][2])


def _walk(cursor: Cursor, contents: Contents, chunk: int | None = None) -> None:
    """Note what the records of a file, or of an unpacked chunk, say."""
    latest: dict[int, int] = {}
    while cursor.left:
        contents.records += chunk is None
        contents.unpacked += chunk is not None
        if contents.records > MOST_RECORDS or contents.unpacked > MOST_INSIDE:
            most = MOST_RECORDS if chunk is None else MOST_INSIDE
            cursor.source.refuse(f"at most {most:,} records", "more")
        if chunk is None and cursor.left == len(MAGIC):
            break
        kind, length = cursor.number("B", "a record's kind"), cursor.number("Q", "a record's length")
        first = cursor.at
        if length > cursor.left:
            cursor.take(length, "a record")
        if kind in (SCHEMA, CHANNEL):
            cursor.source.limit(length, MOST_SCHEMA, "bytes of a schema")
            _name(Cursor(cursor.source, cursor.take(length, "a schema"), MCAP, 0, first), kind, contents)
        elif kind == MCAP_MESSAGE and length >= 22:
            id, _, time, _ = (cursor.number(letter, "a message") for letter in "HIQQ")
            entry = Place(time, cursor.at, length - 22, chunk)
            if id not in contents.last or contents.last[id].time <= time:
                contents.last[id] = entry
        elif kind == MCAP_CHUNK and chunk is None:
            latest = contents.chunks[first] = {}
        elif kind == MCAP_INDEX and chunk is None and length >= 22:
            id = cursor.number("H", "an index")
            cursor.at = first + length - 16
            latest[id] = max(latest.get(id, 0), cursor.number("Q", "a time"))
        cursor.at = first + length


def _walk_chunks(cursor: Cursor, contents: Contents) -> None:
    """Note what is in every chunk, of a file that has no summary or no indices."""
    total = 0
    for offset in list(contents.chunks):
        inside = _chunk(cursor, offset)
        total += inside.left
        cursor.source.limit(total, MOST_UNPACKED, "bytes in the chunks of a file without an index")
        _walk(inside, contents, offset)
        contents.chunks[offset] = {}


def _chunk(cursor: Cursor, at: int) -> Cursor:
    """The unpacked chunk whose record begins at a byte."""
    cursor.at = at + 16  # its times
    size, _ = cursor.number("Q", "a chunk's size"), cursor.number("I", "a checksum")
    cursor.source.limit(size, MOST_MESSAGE, "bytes of a chunk")
    compression = cursor.text(min(cursor.number("I", "a length"), 64), "a name")
    packed = cursor.take(cursor.number("Q", "a length"), "a chunk")
    return Cursor(cursor.source, unpack(cursor.source, packed, compression, size, at), f"a sound chunk at byte {at:,}")


def _name(cursor: Cursor, kind: int, contents: Contents) -> None:
    """Note a schema or a channel."""
    id = cursor.number("H", "a number")
    if kind == SCHEMA:
        contents.schemas.setdefault(id, cursor.text(cursor.number("I", "a length"), "a name"))
        return
    schema = cursor.number("H", "a number")
    topic = cursor.text(cursor.number("I", "a length"), "a topic")
    encoding = cursor.text(cursor.number("I", "a length"), "an encoding")
    contents.channels.setdefault(id, (topic, schema, encoding))
