"""Libraries whose functions run on a device, with the calls of those on the CPU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torchgco.native import structures as c
from torchgco.native.codegen.source import Form
from torchgco.native.cuda import launch
from torchgco.native.cuda.source import Program, source

SIZES = {"double": 8, "float": 4}  # bytes


@dataclass(frozen=True)
class OnDevice:
    """What serves problems on a device.

    Attributes:
        load: has a text of CUDA C++ compiled, and loads it.
    """

    load: Callable[[str], launch.Module]

    def library(self, form: Form, host: ctypes.CDLL, program: Program, real: str = "double") -> Library:
        """A library whose functions have kernels on the device; `host` has all of them."""
        return Library(host, self.load(source(form, program, real)), program, real)


class Library:
    """A library of C, of which some functions run on a device."""

    def __init__(self, host: ctypes.CDLL, module: launch.Module, program: Program, real: str) -> None:
        self._host, self._module, self._program, self._size = host, module, program, SIZES[real]

    def __getattr__(self, name: str) -> Any:
        if name not in self._program.functions:
            return getattr(self._host, name)
        return Kernel(self._module, name, getattr(self._host, self._program.room_of(name)), self._size)


@dataclass(frozen=True)
class Kernel:
    """A function on a device.

    Attributes:
        room: the function of C on the CPU that says how many numbers, of `size` bytes, a problem needs.
    """

    module: launch.Module
    name: str
    room: Any
    size: int

    def __call__(self, argument: Any, first: int, last: int) -> None:
        """Call it on the problems first, ..., last - 1, as `native.engine.run` calls functions on the CPU.

        Raises:
            MemoryError: the device hasn't enough memory.
        """
        if isinstance(argument, c.Problem):
            argument = problem = argument.copy({"replicas": 1})  # a thread has a single lane
        else:
            problem = c.Problem.from_address(argument.of)
        numbers = launch.room_of(self.room, problem if isinstance(argument, c.Outer) else argument)
        if isinstance(argument, c.Sampling):
            launch.sample(self.module, argument, problem, numbers, self.size, first, last)
        else:
            launch.solve(self.module, self.name, argument, problem, numbers, first, last)
