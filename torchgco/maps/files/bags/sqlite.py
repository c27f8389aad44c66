"""db3 files of ROS 2: tables of SQLite."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from itertools import count
from urllib.request import pathname2url

from torchgco.maps.files.bags.container import MOST_MESSAGE, Message, choose
from torchgco.maps.files.source import Source

DB3 = "a db3 bag of ROS 2, with tables topics and messages"
MOST_TOPICS = 10_000
STEPS, MOST_CALLS = 10_000, 200_000  # of SQLite's machine between two looks at them, and how many looks: some minutes


def last_message(source: Source, topic: str | None) -> Message:
    """The last message of the topic, or of the only one that has maps.

    Raises:
        InputError: no such file, damage, no such topic.
    """
    source.size(DB3)
    address = f"file:{pathname2url(str(source.path.absolute()))}?mode=ro&immutable=1"
    with source.library(DB3), closing(sqlite3.connect(address, uri=True)) as database:
        _restrict(database)
        names = "SELECT name FROM sqlite_master WHERE type = 'table'"
        if not {"topics", "messages"} <= {name for (name,) in database.execute(names)}:
            source.refuse(DB3, "other tables")
        query = "SELECT id, name, type, serialization_format FROM topics LIMIT ?"
        rows = [tuple(row) for row in database.execute(query, (MOST_TOPICS,))]
        if not all([type(value) for value in row] == [int, str, str, str] for row in rows):
            source.refuse(DB3, "topics of other types")
        chosen = choose(source, {name: kind for _, name, kind, _ in rows}, topic)
        best = None
        for id, name, kind, encoding in rows:
            query = "SELECT timestamp, id FROM messages WHERE topic_id = ? ORDER BY timestamp DESC, id DESC LIMIT 1"
            if name == chosen and (last := database.execute(query, (id,)).fetchone()) and (not best or last > best[0]):
                best = (last, kind, encoding)
        if best is None:
            source.refuse(f"{DB3}, and messages of {chosen}", "none")
        (data,) = database.execute("SELECT data FROM messages WHERE id = ?", (best[0][1],)).fetchone()
    if not isinstance(data, bytes):
        source.refuse(f"{DB3}, and bytes of messages", type(data).__name__)
    return Message(best[1], data, best[2])


def _restrict(database: sqlite3.Connection) -> None:
    """A file of others may hold tables whose columns are computed: nothing large, long or with effects is."""
    looks = count(1)
    database.set_progress_handler(lambda: next(looks) > MOST_CALLS, STEPS)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_MESSAGE)
    database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "query_only = ON"):
        database.execute(f"PRAGMA {pragma}")
