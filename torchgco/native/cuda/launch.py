"""Functions of C on a device: what a structure points to is brought there and back."""

from __future__ import annotations

import ctypes
from typing import Any, Protocol

import torch
from torch import Tensor

from torchgco.native.cuda.source import ROWS, SAMPLES, THREADS
from torchgco.native.declarations import Structure, kept_by
from torchgco.native.structures import Problem, Sampling

# Blocks of a multiprocessor at the same time, where each thread has the 255 registers that it may have at most: 65,536.
BLOCKS = 65536 // (256 * THREADS)
SHARE = 0.5  # of a device's free memory that a call may take: what it reads lies there, too
_WORD = 8
SUMS = {8: 8, 4: 16}  # partial sums over samples, by the bytes of a number: see mppi.c


class Module(Protocol):
    """A program that is loaded on a device."""

    device: torch.device
    multiprocessors: int

    def launch(self, kernel: str, blocks: int, *arguments: int) -> None:
        """Start a kernel after all that was started before, with arguments of 64 bits."""
        ...

    def free_bytes(self) -> int:
        """How much memory the device has left."""
        ...


class Placed:
    """A structure on a device, with all that it points to.

    Attributes:
        address: of the structure there.
    """

    def __init__(self, structure: Structure, device: torch.device) -> None:
        self._kept, self._device = kept_by(structure), device
        self._storages: dict[int, tuple[Tensor, Tensor]] = {}  # bytes here and there, by where they begin here
        self._written: set[int] = set()
        self._places: dict[int, int] = {}  # of structures in the block of all of them
        self._block, self._inner = bytearray(), list[tuple[int, int]]()  # pointers into it: where, and to which place
        self._put(structure)
        there = torch.empty(len(self._block), dtype=torch.uint8, device=device)
        self.address = there.data_ptr()
        for at, place in self._inner:
            self._write(at, self.address + place)
        there.copy_(torch.frombuffer(self._block, dtype=torch.uint8))
        self._there = there

    def read_back(self) -> None:
        """Copy what C may have written to the tensors here."""
        for begin in self._written:
            here, there = self._storages[begin]
            here.copy_(there)

    def _put(self, one: Any) -> int:
        """The place of a structure, or of an array of them, in the block."""
        address = ctypes.addressof(one)
        if address in self._places:
            return self._places[address]
        place = self._places[address] = len(self._block)
        self._block += bytes(one) + b"\0" * (-ctypes.sizeof(one) % _WORD)
        self._point(one, place)
        return place

    def _point(self, one: Any, place: int) -> None:
        """Let the pointers of what stands at a place lead to the device."""
        if isinstance(one, ctypes.Array):
            size = ctypes.sizeof(one._type_)
            for i, element in enumerate(one):
                self._point(element, place + i * size)
            return
        for name, field in one.declared.items():
            at, value = place + getattr(type(one), name).offset, getattr(one, name)
            if isinstance(value, (ctypes.Structure, ctypes.Array)):
                self._point(value, at)
            elif field.pointer and value:
                held = self._kept[value]
                if isinstance(held, Tensor):
                    self._write(at, self._moved(held, written=not field.const))
                else:
                    self._inner.append((at, self._put(held)))

    def _moved(self, tensor: Tensor, written: bool) -> int:
        """The address there of what a tensor holds. Tensors may share their memory, so all of it moves as one."""
        storage = tensor.untyped_storage()
        begin = storage.data_ptr()
        if begin not in self._storages:
            here = torch.empty(0, dtype=torch.uint8).set_(storage)  # type: ignore[call-overload]
            self._storages[begin] = here, here.to(self._device, copy=True)
        if written:
            self._written.add(begin)
        return self._storages[begin][1].data_ptr() + tensor.data_ptr() - begin

    def _write(self, at: int, address: int) -> None:
        self._block[at : at + _WORD] = address.to_bytes(_WORD, "little")


def room_of(function: Any, structure: Structure) -> int:
    """What a function of C on the CPU says of the numbers that a solve needs."""
    function.restype = ctypes.c_int64
    return int(function(ctypes.byref(structure)))


def solve(
    module: Module, name: str, structure: Structure, problem: Problem, numbers: int, first: int, last: int
) -> None:
    """Call a function of C on the problems first, ..., last - 1: a thread each, which then takes the next.

    Args:
        problem: that `structure` is, or points to.
        numbers: that a problem needs memory for.

    Raises:
        MemoryError: the device hasn't enough memory for a warp.
    """
    others = _others(problem)
    each = _WORD * numbers + others
    placed = Placed(structure, module.device)
    most = int(SHARE * module.free_bytes()) // (each * THREADS)
    blocks = min(-(-(last - first) // THREADS), BLOCKS * module.multiprocessors, most)
    if blocks == 0:
        raise MemoryError(f"kernels of {module.device}: no {each * THREADS} bytes for {THREADS} problems")
    threads = blocks * THREADS
    room = torch.empty(threads * numbers, dtype=torch.float64, device=module.device)
    beside = torch.empty(threads * others, dtype=torch.uint8, device=module.device)
    counters = torch.zeros(2, dtype=torch.int64, device=module.device)
    next_, lacks = counters[0].data_ptr(), counters[1].data_ptr()
    module.launch(
        f"kernel_{name}", blocks, placed.address, first, last, room.data_ptr(), beside.data_ptr(), numbers, others,
        next_, lacks,
    )  # fmt: skip
    if int(counters[1]):
        raise MemoryError(f"kernels of {module.device}: {name} needs more than {each} bytes for a problem")
    placed.read_back()


def sample(module: Module, how: Sampling, problem: Problem, numbers: int, size: int, first: int, last: int) -> None:
    """All rounds of MPPI for the problems first, ..., last - 1: a thread per sample.

    Args:
        numbers: that a problem needs memory for, of `size` bytes each.

    Raises:
        MemoryError: the device hasn't enough memory for a problem.
    """
    others = _others(problem) + _WORD * (how.samples + how.elite)
    each, device = size * numbers + others + SAMPLES, module.device
    placed = Placed(how, device)
    count = min(last - first, int(SHARE * module.free_bytes()) // each)
    if count == 0:
        raise MemoryError(f"kernels of {device}: no {each} bytes for the samples of a problem")
    make = lambda bytes_: torch.empty(count * bytes_, dtype=torch.uint8, device=device)
    room, beside, samples = make(size * numbers), make(others), make(SAMPLES)
    lacks = torch.zeros(1, dtype=torch.int64, device=device)
    o, all_ = placed.address, samples.data_ptr()
    stages = problem.N * SUMS[size]
    controls = kept_by(how)[how.mean][0].numel()
    for begin in range(first, last, count):
        problems = min(count, last - begin)
        start = lambda kernel, threads, *arguments: module.launch(kernel, -(-threads // THREADS), *arguments)
        memory = room.data_ptr(), beside.data_ptr(), numbers, others, lacks.data_ptr()
        start("sample_begin", problems, o, all_, begin, problems, *memory)
        for i in range(how.rounds):
            start("sample_round", problems, all_, begin, problems, i)
            start("sample_fly", problems * how.samples, o, all_, problems)
            module.launch("sample_weigh", problems, o, all_)
            start("sample_average", problems * stages, o, all_, problems)
            start("sample_mean", problems * controls, o, all_, begin, problems)
    if int(lacks):
        raise MemoryError(f"kernels of {device}: samples need more than {each} bytes for a problem")
    placed.read_back()


def _others(problem: Problem) -> int:
    """Bytes that a problem needs beside numbers; two lists of its own number are among them."""
    return ROWS * (problem.constraints + 1) + 2 * _WORD
