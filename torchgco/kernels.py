"""Kernels that may be compiled: eager by default, through torch.compile where the caller has asked for it.

Compiling is a choice of the process, as the number of threads is: `device.compile=true`, or `compile_kernels(True)`.
A compiled kernel fuses many small operations; its results may differ from the eager ones in the last bits.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

VARIANTS = 32  # of a kernel that may be compiled: one for each precision, each for no, one and many problems, and so on
P = ParamSpec("P")
R = TypeVar("R")


class _Switch:
    """Which kernels this process uses."""

    on = False
    native = True


def compile_kernels(on: bool) -> None:
    """Compile all kernels on their next call, or go back to eager ones."""
    _Switch.on = on


def use_native(on: bool) -> None:
    """Kernels in C on a CPU (the default), or PyTorch's there too."""
    _Switch.native = on


def native() -> bool:
    """Whether this process uses kernels in C on a CPU."""
    return _Switch.native and not _Switch.on


def compiling() -> bool:
    """Whether this process compiles its kernels."""
    return _Switch.on


def kernel(function: Callable[P, R], dynamic: bool | None = True) -> Callable[P, R]:
    """A function that is compiled once its process compiles kernels; eager where no compiler is found.

    `dynamic` is torch.compile's: True compiles once for all sizes, None takes those for fixed that never change.
    """
    compiled: Any = None

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal compiled
        if not _Switch.on or torch.compiler.is_compiling():
            return function(*args, **kwargs)
        from torch._dynamo.exc import BackendCompilerFailed  # loaded by those who compile

        if compiled is None:
            # Over its own limit torch would run further variants eagerly, with a warning that nobody reads.
            torch._dynamo.config.recompile_limit = max(VARIANTS, torch._dynamo.config.recompile_limit)
            compiled = torch.compile(function, dynamic=dynamic)
        try:
            return compiled(*args, **kwargs)
        except BackendCompilerFailed as error:  # no C++ compiler, or none that works
            _Switch.on = False
            warnings.warn(f"kernels run eagerly, as compiling failed: {str(error).splitlines()[0]}", stacklevel=2)
            return function(*args, **kwargs)

    return call
