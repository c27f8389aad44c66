"""Which kernels a process uses: native ones in C, or PyTorch's own.

Native kernels are for float64 on a CPU, where they are the default, and solve several problems side by side. PyTorch's
kernels are for everything else (GPUs, single precision, problems that can't be traced), and are the reference for the
native ones: the two differ in the last bits. `device.kernels` chooses for a study, `use_native` for a process.
"""

from __future__ import annotations


class _Switch:
    native = True


def use_native(on: bool) -> None:
    """Use native kernels where they can be used (the default), or PyTorch's everywhere."""
    _Switch.native = on


def native() -> bool:
    """Whether this process uses native kernels where they can be used."""
    return _Switch.native
