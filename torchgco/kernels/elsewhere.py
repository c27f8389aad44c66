"""Problems of a GPU, by copies: C serves them on the CPU, but for what iterates on many, which runs on their device.

PyTorch's kernels start hundreds of small operations for each stage: on a GPU a solve takes some hundred times as long
as in C on one core.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import DeviceWarning, InputError
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import field_names, mapped
from torchgco.kernels.choice import native, serves
from torchgco.native.cuda.compiler import Loaded, available
from torchgco.native.cuda.engine import OnDevice, working_on
from torchgco.problem.problem import Problem


def on_cpu(problem: Problem) -> Problem | None:
    """The problem on the CPU in float64, where it lies on another device and C serves it on the CPU; else None.

    A DeviceWarning says so once in a process. A problem stays where the process has chosen PyTorch's kernels
    (`use_native`), and where code can't be traced on the CPU, as that of a function which holds a tensor of its device.
    """
    device = problem.x0.device
    if device.type == CPU.type or problem.B == 0 or not native():
        return None
    there = _copied(problem)
    with computing_on(CPU), served_by(device):
        if not serves(there):
            return None
    global _said
    if not _said and on_device(device) is None:
        _said = True
        told = f"problems on {device} are solved by C on the CPU, with copies: PyTorch's kernels take far longer there"
        warnings.warn(told, DeviceWarning, stacklevel=4)
    return there


def held_on_cpu(problem: Problem) -> Problem:
    """The problem on the CPU: itself, or as `on_cpu` has it.

    Raises:
        InputError: C doesn't serve it there.
    """
    there = problem if problem.x0.device.type == CPU.type else on_cpu(problem)
    if there is None:
        raise InputError("problem", "one on the CPU", str(problem.x0.device))
    return there


@cache
def on_device(device: torch.device) -> OnDevice | None:
    """The kernels of a device; None where it has none, or the extra `cuda` isn't installed."""
    return OnDevice(partial(Loaded, device=device)) if device.type == "cuda" and available() else None


@contextmanager
def served_by(device: torch.device) -> Iterator[None]:
    """In this block what iterates on many problems runs on a device, if that has kernels."""
    kernels = on_device(device) if native() else None
    with nullcontext() if kernels is None else working_on(kernels):
        yield


def _copied(problem: Problem) -> Problem:
    """The problem without gradients; what users' functions hold stays where it is."""
    change = lambda leaf: leaf.detach().to(CPU, torch.float64 if leaf.is_floating_point() else leaf.dtype)
    parts = {name: mapped(getattr(problem, name), change) for name in field_names(type(problem))}
    return problem._with(parts)


def copied_to(tree: Any, like: Tensor) -> Any:
    """The same with every tensor on the device of another, numbers in its precision."""
    change = lambda leaf: leaf.to(like.device, like.dtype if leaf.is_floating_point() else leaf.dtype)
    return mapped(tree, change)


_said = False
