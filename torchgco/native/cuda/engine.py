"""Functions of C that run on a device, with the calls of those on the CPU."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from torchgco.base.errors import DeviceWarning
from torchgco.native import structures as c
from torchgco.native.codegen.source import Form
from torchgco.native.compiler import NativeError
from torchgco.native.cuda import launch
from torchgco.native.cuda.source import Program, source

# Problems or samples, for each thread of the CPU that has some, from which on a device is asked. An estimate: 256
# threads of an H200 are as fast as one core or two.
LEAST = 512
# Problems of one call at least: about as many as an H200 has threads at the same time, 132 multiprocessors with
# `launch.BLOCKS` blocks each.
AT_ONCE = 2**15
SIZES = {"double": 8, "float": 4}  # bytes


@dataclass(frozen=True)
class OnDevice:
    """What serves problems on a device.

    Attributes:
        load: has a text of CUDA C++ compiled, and loads it.
        least: see `LEAST`.
    """

    load: Callable[[str], launch.Module]
    least: int = LEAST


_device: ContextVar[OnDevice | None] = ContextVar("_device", default=None)
_launched: ContextVar[set[str] | None] = ContextVar("_launched", default=None)  # functions, in the present block


def current_device() -> OnDevice | None:
    """What serves problems on a device now; None: all are solved on the CPU."""
    return _device.get()


def at_once(most: int) -> int:
    """How many problems are worked on together: `most`, which bounds memory and the time between two reports; where a
    device serves, with a thread for each, more."""
    return most if _device.get() is None else max(most, AT_ONCE)


@contextmanager
def working_on(device: OnDevice | None) -> Iterator[None]:
    """In this block kernels are made for a device."""
    before, launched = _device.set(device), _launched.set(set())
    try:
        yield
    finally:
        _device.reset(before)
        _launched.reset(launched)


def has_served() -> bool:
    """Whether a device has served a function in the present block of `working_on`."""
    return bool(_launched.get())


class Library:
    """A library of C, of which some functions run on a device; each is compiled when it is first called.

    Args:
        host: has all functions.
    """

    def __init__(self, device: OnDevice, form: Form, host: ctypes.CDLL, program: Program, real: str = "double") -> None:
        self.device, self.form, self.host, self.program, self.real = device, form, host, program, real
        self._kernels: dict[str, Kernel] = {}

    def __getattr__(self, name: str) -> Any:
        if name not in self.program.functions:
            return getattr(self.host, name)
        if name not in self._kernels:
            self._kernels[name] = Kernel(self, name)
        return self._kernels[name]


class Kernel:
    """A function of a library on its device.

    Attributes:
        host: the same on the CPU.
    """

    def __init__(self, library: Library, name: str) -> None:
        self.library, self.name, self.host = library, name, getattr(library.host, name)
        self._refused = False

    @cached_property
    def module(self) -> launch.Module:
        """The program with this function."""
        library = self.library
        return library.device.load(source(library.form, library.program, self.name, library.real))

    def pays(self, count: int, each: int = 1) -> bool:
        """Whether the device, with `each` threads for a problem, is faster than the CPU with one at most."""
        on_cpu = min(torch.get_num_threads(), count)
        return not self._refused and count * each >= self.library.device.least * on_cpu

    def served(self, argument: Any, first: int, count: int) -> bool:
        """Call it on `count` problems; False where the CPU is to do that, as it is faster, or the device can't.

        A DeviceWarning says once why a device can't.
        """
        if not self.pays(count, argument.samples if isinstance(argument, c.Sampling) else 1):
            return False
        try:
            self._run(argument, first, first + count)
        except (NativeError, MemoryError, torch.OutOfMemoryError) as error:
            self._refused = isinstance(error, NativeError)
            told = f"solved by C on the CPU, and not on the device: {str(error).splitlines()[0]}"
            warnings.warn(told, DeviceWarning, stacklevel=2)
            return False
        if (launched := _launched.get()) is not None:
            launched.add(self.name)
        return True

    def _run(self, argument: Any, first: int, last: int) -> None:
        if isinstance(argument, c.Problem):
            argument = problem = argument.fill({"replicas": 1}, copied=True)  # a thread has a single lane
        else:
            problem = c.Problem.from_address(argument.of)
        room = getattr(self.library.host, self.library.program.room_of(self.name))
        numbers = launch.room_of(room, problem if isinstance(argument, c.Outer) else argument)
        if isinstance(argument, c.Sampling):
            size = SIZES[self.library.real]
            launch.sample(self.module, argument, problem, numbers, size, first, last)
        else:
            launch.solve(self.module, self.name, argument, problem, numbers, first, last)
