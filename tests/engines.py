"""The library in C behind a problem's kernels, for tests that look inside."""

from __future__ import annotations

from torchgco import Problem
from torchgco.kernels import kernels_of
from torchgco.kernels.in_c import NativeKernels
from torchgco.native.engine import Engine


def engine_of(problem: Problem) -> Engine | None:
    """None where PyTorch's kernels serve the problem."""
    kernels = kernels_of(problem)
    return kernels.engine if isinstance(kernels, NativeKernels) else None
