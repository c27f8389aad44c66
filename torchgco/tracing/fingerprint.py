"""A digest of a traced function's computation, the same in every process."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from torchgco.tracing.recorder import Operation, Slot

FORMAT = 3  # to be raised when the digested text changes, or its meaning in a replay


def fingerprint(
    variables: Mapping[Slot, tuple[int, ...]],
    own: Mapping[Slot, tuple[int, ...]],
    shared: tuple[Mapping[Slot, tuple[int, ...]], np.ndarray],
    constants: Mapping[Slot, np.ndarray],
    operations: Sequence[Operation],
    result: Slot,
) -> str:
    """Hexadecimal digits that two functions share only where they have the same operations, constants and shapes.

    Args:
        variables, own: shapes of the function's arguments, and of the numbers that differ between problems.
        shared: shapes of the numbers that all problems share, and which of them are structural.
        constants: all other tensors that no operation makes.
        operations: in order, with slots in the place of tensors.
        result: the slot of the result.
    """
    # A slot's own number may differ between recordings: here, slots are numbered in the order in which they occur.
    order = count()
    made = (slot for operation in operations for slot in operation.outputs)
    names = {slot: f"${next(order)} {slot.dtype}" for slot in (*variables, *own, *shared[0], *constants, *made)}
    digest = hashlib.sha256(f"format {FORMAT}\n".encode())
    for kind, shapes in (("variable", variables), ("own", own), ("shared", shared[0])):
        for slot, shape in shapes.items():
            digest.update(f"{kind} {names[slot]} {shape}\n".encode())
    digest.update(f"pattern {shared[1].shape}\n".encode() + np.nan_to_num(shared[1], nan=2.0).tobytes())
    for slot, value in constants.items():
        plain = value.astype(np.float64) if value.dtype == object else value
        digest.update(f"constant {names[slot]} {plain.dtype.str} {plain.shape}\n".encode() + plain.tobytes() + b"\n")
    for operation in operations:
        words = (operation.function, operation.args, operation.kwargs, operation.result)
        digest.update(" ".join(_word(word, names) for word in words).encode() + b"\n")
    digest.update(names[result].encode())
    return digest.hexdigest()


def _word(value: Any, names: Mapping[Slot, str]) -> str:
    if isinstance(value, Slot):
        return names[value]
    if isinstance(value, float):
        return value.hex()
    if isinstance(value, (list, tuple)):
        return f"({', '.join(_word(item, names) for item in value)})"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_word(value[key], names)}' for key in sorted(value))}}}"
    return f"{type(value).__name__} {value}"
