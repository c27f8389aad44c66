"""The user's cache folder: generated and compiled code, under keys made from everything that the code depends on.

A file is called KEY-CHECKSUM and a suffix, with the checksum of its content. It is written under another name and
renamed, so processes that write the same file at once do no harm; a damaged, truncated or swapped file is deleted.
The first digits of a key are those of its kin: code that differs in numbers alone, as in a loop that trains a model. Of
such a kin only so many files are kept, so a loop displaces its own oldest files and not those of other problems. The
objects of solvers, which libraries to come are linked from, are counted apart.
A folder that is missing or can't be written costs time, never correctness: nothing here raises OSError.

Libraries are code, and the checksum is no signature: anybody can compute it. So a folder or file that others own or may
write to is not used, which a CacheWarning says; root's own are, as on a cluster whose administrator shares a folder.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from torchgco.base.files import PART, write_whole
from torchgco.base.memory import trim

FILES = 1000  # at most, some 150 MB; the least recently used are removed
OBJECT, OBJECTS = ".o", 200  # objects of the solvers, further 20 MB: no loop over models removes any
KIN = 100  # at most of one kin: a tenth of all, as a solve makes four or so
_PREFIX = 8  # digits of a key that name its kin
_ABANDONED = 3600.0  # s after which a half-written file belongs to a process that was killed
_OURS = re.compile(r"[0-9a-f]{32}-[0-9a-f]{32}\.[a-z]+")


_warned: set[Path] = set()  # places that a CacheWarning has named


class CacheWarning(UserWarning):
    """The cache folder, or a file in it, might hold the code of somebody else, and is not used."""


class Made(NamedTuple):
    """What was generated, and its key."""

    key: str
    content: dict[str, Any]


_made: dict[tuple[str, str], Made] = {}


def made(parts: Sequence[str], make: Callable[[], dict[str, Any]], kin: str = "") -> Made:
    """What `make` generates for the key of `parts`: of this process, else from the folder, else made now and stored."""
    key, root = key_of(parts, kin), str(folder())
    if (key, root) not in _made:
        known = read(key, ".json")
        if known is None:
            known = json.dumps(make()).encode()
            save(key, ".json", known)
        _made[key, root] = Made(key, json.loads(known))
        trim(_made, FILES)
    return _made[key, root]


def folder() -> Path:
    """TORCHGCO_CACHE, else torchgco in XDG_CACHE_HOME, else ~/.cache/torchgco; it need not exist."""
    chosen, shared = os.environ.get("TORCHGCO_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if chosen:
        return Path(chosen)
    # Without a home, expanduser leaves the ~, which would become the name of a folder here.
    return Path(shared or os.path.expanduser("~/.cache")) / "torchgco"


def key_of(parts: Iterable[str], kin: str = "") -> str:
    """A key that differs from that of any other sequence of texts; of the `kin` that a text names, or of none."""
    digest = hashlib.sha256()
    for piece in parts:
        text = piece.encode(errors="surrogateescape")
        digest.update(f"{len(text)}:".encode() + text)
    digits = digest.hexdigest()[:32]
    return key_of((kin,))[:_PREFIX] + digits[_PREFIX:] if kin else digits


def find(key: str, suffix: str) -> Path | None:
    """The path of the intact file under a key, or None. The file may be gone before the caller opens it."""
    return next((path for path, _ in _sound(key, suffix)), None)


def read(key: str, suffix: str) -> bytes | None:
    """The content of the intact file under a key, or None."""
    return next((content for _, content in _sound(key, suffix)), None)


def _sound(key: str, suffix: str) -> Iterator[tuple[Path, bytes]]:
    """Files under a key that match their checksum, and their content; the others are removed."""
    root, names = folder(), list[str]()
    with suppress(OSError):
        if _is_ours(root, os.stat(root)):
            names = [name for name in os.listdir(root) if name.startswith(f"{key}-") and name.endswith(suffix)]
    for path in (root / name for name in sorted(names)):
        with suppress(OSError):
            with open(path, "rb") as file:
                if not _is_ours(path, os.fstat(file.fileno())):
                    continue
                content = file.read()
            if path.name != _name(key, suffix, content):
                path.unlink()
                continue
            with suppress(OSError):  # root's file can be read, but not its time changed
                os.utime(path)
            yield path, content


def _is_ours(root: Path, about: os.stat_result) -> bool:
    """Whether nobody but this user and root can have written there; a CacheWarning says once where it isn't so."""
    if about.st_uid not in (os.geteuid(), 0):
        reason = f"belongs to another user ({about.st_uid})"
    elif about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        reason = f"can be written by others (chmod go-w {root})"
    else:
        return True
    if root not in _warned:
        _warned.add(root)
        told = f"kernels are compiled again in every process: {root} {reason}; TORCHGCO_CACHE names another folder"
        warnings.warn(told, CacheWarning, stacklevel=2)
    return False


def save(key: str, suffix: str, content: bytes) -> Path | None:
    """Store `content` under a key; returns the file's path, None where the folder can't be written."""
    root = folder()
    if str(root).startswith("~"):
        return None
    path = root / _name(key, suffix, content)
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_ours(root, os.stat(root)):
            return None
        write_whole(path, lambda file: file.write(content))
    except OSError:
        return None
    _tidy(root, key[:_PREFIX])
    return path


def _name(key: str, suffix: str, content: bytes) -> str:
    # The key is part of the checksum: a file that was renamed to another key doesn't match.
    return f"{key}-{hashlib.sha256(key.encode() + content).hexdigest()[:32]}{suffix}"


def _tidy(root: Path, kin: str) -> None:
    """Remove the least recently used files over the limits, of a kin and of all; another process may use or remove
    them meanwhile. Only where there are too many is each file asked for its time.
    """
    objects: list[str] = []
    others: list[str] = []
    with suppress(OSError), os.scandir(root) as entries:
        for entry in entries:
            if _OURS.fullmatch(entry.name):  # all other files in the folder are left alone
                (objects if entry.name.endswith(OBJECT) else others).append(entry.path)
            elif entry.name.startswith(PART[0]) and entry.name.endswith(PART[1]):
                with suppress(OSError):
                    if time.time() - entry.stat().st_mtime > _ABANDONED:
                        os.unlink(entry.path)
    over = _oldest([path for path in others if os.path.basename(path).startswith(kin)], KIN)
    over += _oldest([path for path in others if path not in over], FILES) + _oldest(objects, OBJECTS)
    for path in over:
        with suppress(OSError):
            os.unlink(path)


def _oldest(paths: list[str], most: int) -> list[str]:
    """Those beyond so many, by the time of their last use."""

    def last_use(path: str) -> float:
        try:
            return os.stat(path).st_mtime
        except OSError:  # gone meanwhile
            return -math.inf

    return sorted(paths, key=last_use)[: len(paths) - most] if len(paths) > most else []
