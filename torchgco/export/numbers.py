"""What may change of an exported problem, and how the arrays that C reads follow from it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base import numbers as checks
from torchgco.base.errors import InputError
from torchgco.base.numbers import Number
from torchgco.compiled import Compiled
from torchgco.compiled.numbers import KeptCarried, steady
from torchgco.native.interior import Kept
from torchgco.native.structures import Array

# What is checked of a number in C: finite, at least 0, above 0, or a bound, which may be infinite.
FINITE, AT_LEAST_ZERO, ABOVE_ZERO, BOUND = range(4)
KINDS = {checks.lengths: AT_LEAST_ZERO, checks.at_least_zero: AT_LEAST_ZERO, checks.above_zero: ABOVE_ZERO}
RADII, RADIUS = "radii", "vehicle_radius"


@dataclass(frozen=True)
class Member:
    """A number of the problem as a member of the structure `NAME_numbers`.

    Attributes:
        name: of the member.
        full: its name in the problem, such as "constraints[1].centers".
        first: its place among all numbers of the structure.
        shape: of one element.
        values: as they are exported, of this shape, of each element.
        kind: of its check.
    """

    name: str
    full: str
    first: int
    shape: tuple[int, ...]
    values: np.ndarray
    kind: int
    steady: int = 0  # how many numbers a stage has, of those that are the same at all stages; 0: others

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))


@dataclass
class Copies:
    """Entries of an element's array that C reads which are copies of numbers: entry `to` is number `source` of the
    structure."""

    to: list[int] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    squares: bool = False  # they are squares of a radius and the vehicle's, of which `source` has pairs
    bounds: bool = False


@dataclass(frozen=True)
class Changing:
    """The members, and what follows from them.

    Attributes:
        members: in the order of the structure.
        shared: where C reads members as they are: the place in the structure, by address.
        copied: arrays of which entries are copies of members, by address.
    """

    members: Sequence[Member]
    shared: dict[int, int]
    copied: dict[int, Copies]


def changing(kept: Kept, compiled: Compiled, asked: Sequence[str] | None) -> Changing:
    """The numbers that may change.

    Args:
        kept: the packed problem.
        compiled: with all of its numbers.
        asked: their names; None: all that can.

    Raises:
        InputError: a name that isn't there, x0, or a number from which what C reads is computed in Python.
    """
    numbers = compiled.numbers
    every = [numbers.find(name) for name in (numbers if asked is None else asked)]
    members, shared, copied, first = list[Member](), dict[int, int](), dict[int, Copies](), 0
    arrays = {tensor.data_ptr(): tensor for tensor in _read(kept)}
    for number in every:
        if number.part == "x0":
            if asked is not None:
                raise InputError("changes", "other numbers than x0, which the states of each step are", "x0")
            continue
        ways = _ways(kept, compiled, number, first, arrays)
        if ways is None:
            if asked is not None:
                raise InputError("changes", "numbers that C reads, or copies of them", number.name)
            continue
        name = re.sub(r"\W+", "_", numbers.short(number.name)).strip("_")
        values = number.value.reshape(len(number.value), *(number.value.shape[1:] or (1,)))
        check: Any = number.check
        is_steady = isinstance(check, partial) and check.func is steady
        kind = BOUND if number.none is not None else KINDS.get(check.args[-1] if is_steady else check, FINITE)
        width = values[0, 0].size if is_steady and values.shape[1] > 1 else 0
        members.append(Member(name, number.name, first, values.shape[1:], values, kind, width))
        shared |= ways[0]
        for address, own in ways[1].items():
            together = copied.setdefault(address, Copies(bounds=own.bounds))
            together.to += own.to
            together.source += own.source
        first += members[-1].size
    _add_radii(kept, members, copied)
    return Changing(members, shared, copied)


def _read(kept: Kept, part: str | int | None = None) -> Iterator[Tensor]:
    """The tensors of the arrays that C reads, of one part or of all, and what is carried at the start."""
    if isinstance(kept, KeptCarried):
        yield kept.carried
    groups: dict[str | int, list[Array]] = {"cost": list(kept._cost), "dynamics": [kept._model]}
    for i, own in enumerate(kept._numbers):
        groups[i] = [value for value in own.values() if isinstance(value, Array)]
    for name, group in groups.items():
        if part is None or part == name:
            for array in group:
                yield from array.kept


def _ways(
    kept: Kept, compiled: Compiled, number: Number, first: int, arrays: dict[int, Tensor]
) -> tuple[dict[int, int], dict[int, Copies]] | None:
    """Where C reads a number as it is, and the copies of it, from its place in the structure on; None: neither."""
    places, at = dict[int, int](), first
    for view in number.views:
        places[view.__array_interface__["data"][0]] = at
        at += view[0].size
    if set(places) <= set(arrays):
        return places, {}
    part = kept.problem.constraints[number.part] if isinstance(number.part, int) else None
    if number.name.rpartition(".")[2] in (RADII, RADIUS) and part is not None and part.kernel == "spheres":
        return {}, {}  # C reads squares of inflated radii: see _add_radii
    copies = _probed(kept, compiled, number, first)
    return None if copies is None else ({}, copies)


def _probed(kept: Kept, compiled: Compiled, number: Number, first: int) -> dict[int, Copies] | None:
    """The entries that change with a number, where all of them become one of its entries, the same ones of every
    element; None where they don't."""
    old, draws, part = number.value, np.random.default_rng(0), number.part
    probe = draws.uniform(1.0, 2.0, old.shape)
    if part == "time":  # of which bounds don't cross
        probe = old / probe if number.name.endswith(".least") else old * probe
    part = None if isinstance(kept, KeptCarried) else part  # lifted parts depend on several
    before = {tensor.data_ptr(): tensor.clone() for tensor in _read(kept, part)}
    try:
        _write(kept, compiled, number, probe)
        after = {tensor.data_ptr(): tensor.clone() for tensor in _read(kept, part)}
    finally:
        _write(kept, compiled, number, old)
    found, B = dict[int, Copies](), len(old)
    places = [{value: i for i, value in enumerate(row)} for row in probe.reshape(B, -1).tolist()]
    for address, tensor in after.items():
        changed = tensor != before[address]
        if not bool(changed.any()):
            continue
        if len(tensor) != B or not bool((changed == changed[:1]).all()):
            return None
        at = changed[0].flatten().nonzero().flatten().tolist()
        pairs = zip(places, tensor.flatten(1)[:, at].tolist(), strict=True)
        rows = [[there.get(value, -1) for value in row] for there, row in pairs]
        if any(-1 in row for row in rows) or rows != rows[:1] * B:
            return None
        found[address] = Copies(at, [first + place for place in rows[0]], bounds=number.none is not None)
    return found or None


def _write(kept: Kept, compiled: Compiled, number: Number, values: np.ndarray) -> None:
    number.write(values)
    parts = {number.part}
    if isinstance(kept, KeptCarried):
        parts = kept.read(parts, compiled.now)
    for part in parts:
        if part == "dynamics":
            kept.refresh_model()
        elif part == "cost":
            kept.refresh_cost()
        elif isinstance(part, int):
            kept.refresh_constraint(part)


def _add_radii(kept: Kept, members: list[Member], copied: dict[int, Copies]) -> None:
    """Squares of radii and the vehicle's radius, where one of the two may change."""
    for i, part in enumerate(kept.problem.constraints):
        own = {m.full.rpartition(".")[2]: m for m in members if m.full.startswith(f"constraints[{i}].")}
        radii, radius = own.get(RADII), own.get(RADIUS)
        if (radii is None and radius is None) or part.kernel != "spheres":
            continue
        (squares,) = kept._numbers[i]["squares"].kept
        count = squares[0].numel()
        pairs = list[int]()
        for j in range(count):
            pairs += [-1 if radii is None else radii.first + j, -1 if radius is None else radius.first]
        copied[squares.data_ptr()] = Copies(list(range(count)), pairs, squares=True)


def fixed_radii(kept: Kept, address: int) -> Tensor:
    """Radii of spheres, then that of the vehicle, (B, M + 1), of the squares at an address."""
    parts: Sequence[Any] = kept.problem.constraints
    for part, own in zip(parts, kept._numbers, strict=True):
        if "squares" in own and own["squares"].kept[0].data_ptr() == address:
            radius = part.vehicle_radius.unsqueeze(-1)
            return torch.cat((part.inflated_radii - radius, radius.expand(len(part.inflated_radii), 1)), dim=-1)
    raise AssertionError("squares of spheres")
