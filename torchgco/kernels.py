"""Which kernels a process works with: native ones in C, or PyTorch's own.

Native kernels serve float64 on a CPU, several problems side by side, and are the default there. PyTorch's kernels serve
everything else, GPUs, single precision and problems that can't be traced, and are the reference for the native ones:
the two differ in the last bits. `device.kernels` chooses for a study, `use_native` for a process.
"""

from __future__ import annotations


class _Switch:
    native = True


def use_native(on: bool) -> None:
    """Native kernels where they serve (the default), or PyTorch's everywhere."""
    _Switch.native = on


def native() -> bool:
    """Whether this process uses native kernels where they serve."""
    return _Switch.native
