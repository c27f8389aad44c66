"""Native kernels in tests: the library behind a problem's kernels, and the marker of tests that need a compiler."""

from __future__ import annotations

import pytest

from torchgco import Problem
from torchgco.kernels import kernels_of
from torchgco.kernels.in_c import NativeKernels
from torchgco.native.compiler import find_compiler
from torchgco.native.engine import Engine

compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def engine_of(problem: Problem) -> Engine | None:
    """None where PyTorch's kernels serve the problem."""
    kernels = in_c(problem)
    return None if kernels is None else kernels.engine


def in_c(problem: Problem) -> NativeKernels | None:
    """The same kernels themselves."""
    kernels = kernels_of(problem)
    return kernels if isinstance(kernels, NativeKernels) else None
