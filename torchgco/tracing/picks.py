"""Which operations of a recording depend on which, and whether they only move numbers of a problem's own row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.tracing.recorder import Operation, Slot, name_of, replay_all

INDEXING = ("aten.index", "aten.index_put", "aten.index_select", "aten.gather")
# What moves numbers and computes none.
PICKING = {f"aten.{name}" for name in (
    "index", "index_select", "select", "slice", "unsqueeze", "squeeze", "view", "reshape", "expand", "detach", "alias",
    "clone", "permute", "transpose", "t", "unbind", "split", "cat", "stack",
)}  # fmt: skip
PROBED = 3  # problems for which a function is asked which numbers it takes


def needed(operations: list[Operation], *results: Slot) -> list[Operation]:
    """The operations that the results depend on."""
    wanted, kept = set(results), []
    for operation in reversed(operations):
        if not wanted.isdisjoint(operation.outputs):
            wanted.update(operation.inputs)
            kept.append(operation)
    return kept[::-1]


def followers(operations: Iterable[Operation], sources: Iterable[Slot]) -> set[Slot]:
    """`sources`, and all slots that depend on them."""
    reached = set(sources)
    for operation in operations:
        if not reached.isdisjoint(operation.inputs):
            reached.update(operation.outputs)
    return reached


def indices(operations: list[Operation]) -> set[Slot]:
    """What is used as an index."""
    return {slot for op in operations if name_of(op.function) in INDEXING for slot in op.inputs[1:]}


def picks_of(
    operations: list[Operation],
    own: Mapping[Slot, Tensor],
    results: Sequence[Slot],
    index: Slot,
    captured: Mapping[Slot, Tensor],
    indexed: set[Slot],
) -> Tensor | None:
    """Where each of the results' numbers stands in a problem's row of its own tensors, (count,) int64; None: nowhere.

    Args:
        operations: that the results depend on.
        own: a problem's own tensors, (B, ...), or (1, ...) of all problems.
        index: selects the problem.
        captured: all tensors that the function reads, but for its arguments.
        indexed: those that the index is applied to.
    """
    # Operations may only move numbers of the own tensors, in the rows that the index says or in a shared one.
    if not own or any(name_of(op.function) not in PICKING for op in operations):
        return None
    if not followers(operations, own).issuperset(results):
        return None
    if indices(operations) & (followers(operations, [index, *own]) - {index}):
        return None  # chosen by others
    if any(tensor.dim() == 0 or (len(tensor) > 1 and slot not in indexed) for slot, tensor in own.items()):
        return None
    others = captured.keys() & {slot for op in operations for slot in op.inputs} - own.keys()
    if any(slot.dtype.is_floating_point for slot in others):
        return None
    # Asked with the places themselves in the place of the numbers: those of problem i, i times their number later.
    ends = np.cumsum([0, *(math.prod(tensor.shape[1:]) for tensor in own.values())]).tolist()
    total, known, of_problem = ends[-1], dict(captured), torch.zeros(ends[-1], dtype=torch.int64)
    for (slot, tensor), first, end in zip(own.items(), ends, ends[1:], strict=False):
        rows = PROBED if slot in indexed else 1
        numbers = total * torch.arange(rows).unsqueeze(-1) + torch.arange(first, end, dtype=torch.float64)
        known[slot] = numbers.reshape(rows, *tensor.shape[1:]).to(tensor.device)
        of_problem[first:end] = int(rows > 1)

    def picked(i: int) -> Tensor:
        device = next(iter(own.values())).device
        values: dict[Slot, Any] = {**known, index: torch.full((1,), i, dtype=torch.int64, device=device)}
        replay_all(operations, values)
        return torch.cat([values[slot].flatten().long().cpu() for slot in results])

    try:
        places = torch.stack([picked(i) for i in range(PROBED)])
    except (RuntimeError, IndexError):  # other shapes than these
        return None
    if not bool((places[0] < total).all()):
        return None
    expected = places[0] + total * torch.arange(PROBED).unsqueeze(-1) * of_problem[places[0]]
    return places[0] if torch.equal(places, expected) else None
