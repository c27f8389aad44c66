"""The libraries of the roadmap's files in C, compiled at the first search."""

from __future__ import annotations

import ctypes
import functools
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchgco.kernels import EagerWarning
from torchgco.native.compiler import Compiler, NativeError, build, find_compiler
from torchgco.native.declarations import Header, defines
from torchgco.native.includes import included, joined

C = Path(__file__).parent / "c"


def library_of(file: str, header: Header, constants: Mapping[str, Any], without: str) -> ctypes.CDLL | None:
    """The library of a file in `C`, for these macros; None where it isn't there.

    That is without a compiler, of which the solver itself warns, and where the source doesn't compile: an EagerWarning
    says why, and what there is not then (`without`).
    """
    compiler = find_compiler()
    return None if compiler is None else _library(file, header.layout, tuple(constants.items()), without, compiler)


@functools.cache
def _library(
    file: str, layout: str, constants: tuple[tuple[str, Any], ...], without: str, compiler: Compiler
) -> ctypes.CDLL | None:
    try:
        return build(joined(defines(dict(constants)) + included(file), C) + layout)
    except NativeError as error:
        warnings.warn(f"{without}: {str(error).splitlines()[0]}", EagerWarning, stacklevel=4)
        return None
