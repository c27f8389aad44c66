"""How an experiment writes and checks a file: whole or not at all, with every failure as one line."""

from __future__ import annotations

import errno
import os
import zipfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import IO, Any, TypeVar

from torchgco.base.errors import InputError, first_line
from torchgco.base.files import write_whole

Read = TypeVar("Read")
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)  # of file systems without hard links


def write(path: Path, save: Callable[[IO[bytes]], Any]) -> None:
    """As `write_whole`.

    Raises:
        InputError: the system refuses to write there (disk full, no permission).
    """
    _write(path, save)


def create(path: Path, save: Callable[[IO[bytes]], Any]) -> bool:
    """As `write`, but False, and the file left as it is, where `path` exists: of several processes one creates it.

    Raises:
        InputError: the system refuses to write there (disk full, no permission).
    """

    def move(temporary: str, whole: Path) -> None:
        try:
            os.link(temporary, whole)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            os.replace(temporary, whole)

    try:
        _write(path, save, move)
    except FileExistsError:
        return False
    return True


def _write(path: Path, save: Callable[[IO[bytes]], Any], move: Callable[[str, Path], None] | None = None) -> None:
    for last in (False, True):
        try:
            return write_whole(path, save, move)
        except FileExistsError:
            if move is not None:
                raise
            raise refused(path, "a file in place of a folder") from None
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not last:
                continue  # another process that finished the study removed the part, or its folder, as left over
            raise refused(path, error.strerror or error) from None


def refused(path: Path, reason: object) -> InputError:
    """The error for a file that the system refuses to write."""
    expected = "a folder (hydra.run.dir, --output of a report) with room that may be written to"
    return InputError(str(path), expected, reason)


def checksum(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as file:
        total = sha256()
        for block in iter(lambda: file.read(1 << 20), b""):
            total.update(block)
    return total.hexdigest()


def readable(path: Path, reader: Callable[..., Read], sized: bool = True, **options: Any) -> Read:
    """What `reader` makes of a file of a study, whose bytes anything may have happened to; `options` are its own.

    Args:
        sized: whether to pass on that the file takes more memory than it may, which a command can admit.

    Raises:
        InputError: the file is missing or damaged.
    """
    if not path.exists():
        raise damaged(path, "is missing")
    try:
        content = reader(path, **options)  # first, as it refuses sizes
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as members:
                if members.testzip() is not None:  # np.load alone doesn't check every member's checksum
                    raise ValueError("a checksum differs")
        return content
    except Exception as error:  # damaged bytes make readers raise nearly anything
        if sized and isinstance(error, InputError) and "--trust" in error.expected:
            raise
        raise damaged(path, f"is damaged ({first_line(error)})") from None


def damaged(path: Path, reason: str) -> InputError:
    """The error for a file of a study that can't be used: which file, why, and how to repair it."""
    return InputError(
        "hydra.run.dir", "whole files of this study", f"{path}, which {reason} (study.repair=true redoes it)"
    )
