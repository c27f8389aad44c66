"""Files: written whole or not at all, and npz files read by their arrays."""

from __future__ import annotations

import math
import os
import stat
import tempfile
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import IO, Any

import numpy as np

from torchgco.base.errors import InputError, first_line

INDEX_BYTES = 8  # bytes of a row's number
PART = ("torchgco-", ".part")  # beginning and ending of the name of a file that is still being written


def write_whole(
    path: str | os.PathLike[str], save: Callable[[IO[bytes]], Any], move: Callable[[str, Path], None] | None = None
) -> None:
    """Let `save(file)` write a temporary file in the same folder, and move it to `path` when it is on the disk.

    A reader sees the old file or the new one, never a part. On any failure the temporary file is removed.

    Args:
        move: in place of `os.replace`.

    Raises:
        OSError: the system refuses to write there.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(PART[1], PART[0], path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            save(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        (move or os.replace)(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)  # gone already after a move


def regular(path: str | os.PathLike[str]) -> Path:
    """The path of a file that has an end.

    Raises:
        OSError: there is none, or it is a device, a pipe or a folder: reading `/dev/zero`, to which a link in a run's
            folder may lead, takes all memory, and a pipe waits for ever.
    """
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise OSError("no regular file")
    return Path(path)


def read_arrays(
    path: str | os.PathLike[str],
    field: str,
    kind: str,
    needed: Collection[str] = (),
    room: float = math.inf,
    limit: str = "of free memory",
) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name.

    Args:
        field, kind: the argument and the kind of file that errors name.
        needed: arrays that the file must hold.
        room, limit: bytes of memory that the arrays may take, and what errors say of them.

    Raises:
        InputError: no such file, one that isn't a readable npz file without pickles, one that lacks an array or takes
            more memory than there is.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(field, f"the path of {kind}", repr(path))
    try:
        # Opened here, because np.load leaves a damaged file open.
        with open(regular(path), "rb") as file:
            size = npz_size(file)
            if size > room:
                expected = f"arrays that fit into the {room / 1e9:.3g} GB {limit}"
                raise InputError(field, expected, f"{path}, whose arrays take {size / 1e9:.3g} GB")
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            longest = max((max(array.shape, default=0) for array in arrays.values() if not array.size), default=0)
            if INDEX_BYTES * longest > room:  # no numbers, but as many rows
                expected = f"arrays whose rows fit into the {room / 1e9:.3g} GB {limit}"
                raise InputError(field, expected, f"{path} with {longest:,} rows")
    except FileNotFoundError:
        raise InputError(field, f"{kind} (.npz)", f"{path}, which isn't there") from None
    except InputError:
        raise
    except Exception as error:  # damaged bytes make numpy, zipfile and zlib raise nearly anything
        reason = first_line(error)
        if "pickle" in reason:  # NumPy's words recommend to load it all the same
            reason = "of another format, or with Python objects"
        raise InputError(field, "a readable npz file without pickles", f"{path} ({reason})") from None
    if missing := sorted(set(needed) - set(arrays)):
        raise InputError(field, kind, f"{path} without {missing}")
    return arrays


def npz_size(file: IO[bytes]) -> int:
    """Bytes of all arrays in a zip file; 0 for another kind of file, which np.load refuses."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        return 0
    with zipfile.ZipFile(file) as members:
        size = sum(member.file_size for member in members.infolist())
    file.seek(0)
    return size
