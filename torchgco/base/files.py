"""Reading npz files, by their arrays."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Collection
from typing import IO

import numpy as np

from torchgco.base.errors import InputError


def read_arrays(
    path: str | os.PathLike[str], field: str, kind: str, needed: Collection[str] = (), room: float = math.inf
) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name.

    Args:
        field, kind: the argument and the kind of file that errors name.
        needed: arrays that the file must hold.
        room: bytes of memory that the arrays may take.

    Raises:
        InputError: no such file, one that isn't a readable npz file without pickles, one that lacks an array or takes
            more memory than there is.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(field, f"the path of {kind}", repr(path))
    try:
        # Opened here, because np.load leaves a damaged file open.
        with open(path, "rb") as file:
            size = _size(file)
            if size > room:
                expected = f"arrays that fit into the {room / 1e9:.3g} GB of free memory"
                raise InputError(field, expected, f"{path}, whose arrays take {size / 1e9:.3g} GB")
            with np.load(file, allow_pickle=False) as held:
                arrays = {name: held[name] for name in held.files}
    except FileNotFoundError:
        raise InputError(field, f"{kind} (.npz)", f"{path}, which isn't there") from None
    except InputError:
        raise
    except Exception as error:  # damaged bytes make numpy, zipfile and zlib raise nearly anything
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(field, "a readable npz file without pickles", f"{path} ({reason})") from None
    if missing := sorted(set(needed) - set(arrays)):
        raise InputError(field, kind, f"{path} without {missing}")
    return arrays


def _size(file: IO[bytes]) -> int:
    """Bytes of all arrays in a zip file; 0 for another kind of file, which np.load refuses."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        return 0
    with zipfile.ZipFile(file) as members:
        size = sum(member.file_size for member in members.infolist())
    file.seek(0)
    return size
