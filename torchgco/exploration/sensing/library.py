"""The C library of sensing: ray casting, the vehicle's map, search in it. Functions take NumPy arrays and numbers."""

from __future__ import annotations

import ctypes
import functools
import re
from ctypes import c_double, c_int64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.native.compiler import Compiler, build, find_compiler
from torchgco.native.includes import included, joined

C_FOLDER = Path(__file__).parent / "c"
C_TYPES = {"int64_t": c_int64, "double": c_double}
DECLARED = re.compile(r"^\w+ (tgco_\w+)\(([^)]*)\)", re.MULTILINE)


def call(name: str, *arguments: Any) -> int:
    """Call a function of the library; arrays pass their address, so they must be contiguous and of the right type.

    Numbers become what the function declares: a whole number is a double where it takes one.

    Raises:
        NativeError: there is no compiler, or it refuses the source.
    """
    return getattr(_library(find_compiler()), name)(*map(_passed, arguments))


def _passed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        assert value.flags.c_contiguous
        return value.ctypes.data
    return value


@functools.cache
def _library(compiler: Compiler | None) -> ctypes.CDLL:
    source = joined(included(*sorted(path.name for path in C_FOLDER.glob("*.c"))), C_FOLDER)
    library = build(source)
    for name, declared in DECLARED.findall(source):
        function = getattr(library, name)
        function.restype = c_int64
        function.argtypes = [c_void_p if "*" in arg else C_TYPES[arg.split()[0]] for arg in declared.split(",")]
    return library
