"""The C library of sensing: ray casting, the vehicle's map, search in it. Functions take NumPy arrays and numbers."""

from __future__ import annotations

import ctypes
import functools
from ctypes import c_double, c_int64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.native.compiler import Compiler, build, find_compiler

FOLDER = Path(__file__).parent / "c"
TYPES = {int: c_int64, float: c_double}


def call(name: str, *arguments: Any) -> int:
    """Call a function of the library; arrays pass their address, so they must be contiguous and of the right type.

    Raises:
        NativeError: there is no compiler, or it refuses the source.
    """
    function = getattr(_library(find_compiler()), name)
    function.restype = c_int64
    return function(*map(_passed, arguments))


def _passed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        assert value.flags.c_contiguous
        return c_void_p(value.ctypes.data)
    return TYPES[type(value)](value)


@functools.cache
def _library(compiler: Compiler | None) -> ctypes.CDLL:
    return build("\n".join(path.read_text() for path in sorted(FOLDER.glob("*.c"))))
