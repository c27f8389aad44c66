"""How an experiment writes and checks a file: whole or not at all, with every failure as one line."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

from torchgco.base.errors import InputError

PART = ".part"  # ending of a file that is still being written
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)  # of file systems without hard links


def write(path: Path, save: Callable[[IO[bytes]], Any]) -> None:
    """Let `save(file)` write a temporary file in the same folder, fsync it and move it to `path`.

    A reader sees the old file or the new one, never a part. On any failure the temporary file is removed.

    Raises:
        InputError: the system refuses to write there (disk full, no permission).
    """
    _place(path, save, os.replace)


def create(path: Path, save: Callable[[IO[bytes]], Any]) -> bool:
    """As `write`, but False, and the file left as it is, where `path` exists: of several processes one creates it.

    Raises:
        InputError: the system refuses to write there (disk full, no permission).
    """

    def move(part: str, place: Path) -> None:
        try:
            os.link(part, place)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            os.replace(part, place)

    try:
        _place(path, save, move)
    except FileExistsError:
        return False
    return True


def _place(path: Path, save: Callable[[IO[bytes]], Any], move: Callable[[str, Path], None]) -> None:
    for last in (False, True):
        part: str | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, part = tempfile.mkstemp(dir=path.parent, suffix=PART)
            with os.fdopen(handle, "wb") as file:
                save(file)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(part, 0o644)
            move(part, path)
            return
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not last:
                continue  # another process that finished the study removed the part, or its folder, as left over
            if isinstance(error, FileExistsError) and part is not None:
                raise
            expected = "a folder (hydra.run.dir, --output of a report) with room that may be written to"
            raise InputError(str(path), expected, error.strerror or error) from None
        finally:
            if part is not None:
                Path(part).unlink(missing_ok=True)  # gone already after a move


def say(text: str) -> None:
    """Print a text; a reader that has read enough, as `head` does, isn't an error.

    Raises:
        InputError: the system refuses to write (disk full).
    """
    try:
        print(text, flush=True)
    except BrokenPipeError:
        silence()
    except OSError as error:
        silence()
        raise InputError("standard output", "room to write", error.strerror or error) from None


def silence() -> None:
    """Let all that is still buffered for standard output, or printed later, go nowhere: nobody reads it.

    Otherwise Python would complain when it ends.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def checksum(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as file:
        total = sha256()
        for block in iter(lambda: file.read(1 << 20), b""):
            total.update(block)
    return total.hexdigest()


def damaged(path: Path, reason: str) -> InputError:
    """The error for a file of a study that can't be used: which file, why, and how to repair it."""
    return InputError(
        "hydra.run.dir", "whole files of this study", f"{path}, which {reason} (study.repair=true redoes it)"
    )
