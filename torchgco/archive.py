"""Reading npz files, by their arrays."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Collection

import numpy as np

from torchgco.errors import InputError

# Raised by np.load for a file that is no npz, holds pickles or is damaged; an .npy file fails as a context manager.
UNREADABLE = (OSError, EOFError, AttributeError, TypeError, ValueError, zipfile.BadZipFile, zlib.error)


def read_arrays(
    path: str | os.PathLike[str], field: str, kind: str, needed: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name.

    Args:
        field, kind: the argument and the kind of file that errors name.
        needed: arrays that the file must hold.

    Raises:
        InputError: no such file, one that isn't a readable npz file without pickles, or one that lacks an array.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(field, f"the path of {kind}", repr(path))
    try:
        # Opened here, because np.load leaves a damaged file open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
    except FileNotFoundError:
        raise InputError(field, f"{kind} (.npz)", f"{path}, which isn't there") from None
    except UNREADABLE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(field, "a readable npz file without pickles", f"{path} ({reason})") from None
    if missing := sorted(set(needed) - set(arrays)):
        raise InputError(field, kind, f"{path} without {missing}")
    return arrays
