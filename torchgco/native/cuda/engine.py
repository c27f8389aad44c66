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
from torchgco.native.declarations import Structure


@dataclass(frozen=True)
class OnDevice:
    """What serves problems on a device.

    Attributes:
        load: has a text of CUDA C++ compiled, and loads it.
    """

    load: Callable[[str], launch.Module]

    def library(self, form: Form, host: ctypes.CDLL, program: Program) -> Library:
        """A library whose functions have kernels on the device; `host` has all of them."""
        return Library(host, self.load(source(form, program)), program)


class Library:
    """A library of C, of which some functions run on a device."""

    def __init__(self, host: ctypes.CDLL, module: launch.Module, program: Program) -> None:
        self._host, self._module, self._program = host, module, program

    def __getattr__(self, name: str) -> Any:
        if name not in self._program.kernels:
            return getattr(self._host, name)
        return Kernel(self._module, name, getattr(self._host, self._program.room_of(name)))


@dataclass(frozen=True)
class Kernel:
    """A function on a device.

    Attributes:
        room: the function of C on the CPU that says how many numbers a solve of its structure needs.
    """

    module: launch.Module
    name: str
    room: Any

    def __call__(self, argument: Structure, first: int, last: int) -> None:
        """Call it on the problems first, ..., last - 1, as `native.engine.run` calls functions on the CPU.

        Raises:
            MemoryError: the device hasn't enough memory.
        """
        if isinstance(argument, c.Problem):
            argument = argument.copy({"replicas": 1})  # a thread has a single lane
        problem = argument if isinstance(argument, c.Problem) else problem_of(argument)
        asked = problem if self.room.__name__ == "tgco_solver_room" else argument
        numbers = launch.room_of(self.room, asked)
        launch.run(self.module, self.name, argument, problem, numbers, first, last)


def problem_of(argument: Any) -> c.Problem:
    """The problem that a structure points to."""
    return c.Problem.from_address(argument.of)
