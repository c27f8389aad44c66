"""Replays an operation so that its result has the values that its type in PyTorch can hold.

Expressions are real numbers. Elements that an operation makes follow the type of its result:

    float32   rounded to single precision, where the variables have more
    bool      0 or 1: true + true is 1
    integers  of up to 32 bits wrap around; int64 is exact below 2^53. Made of other numbers they are refused, and so
              are all other types (float16, complex numbers)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch.utils._pytree import tree_map

from torchgco.tracing.arrays import NoCounterpart, boxed
from torchgco.tracing.operations import OPERATIONS, WHOLE_NUMBERS, is_logical, to_single, to_truth, wrapped
from torchgco.tracing.recorder import Operation, Slot, name_of

# Operations that convert their first argument to `dtype`, where that is given, before they compute.
REDUCTIONS = ("aten.sum", "aten.mean", "aten.prod", "aten.cumsum")


def replay(operation: Operation, known: dict[Slot, Any], precision: torch.dtype) -> None:
    """Apply the counterpart of an operation to known arrays, and add its results to `known`.

    Args:
        precision: of the variables.

    Raises:
        NoCounterpart: a type or an argument that has none.
    """
    name, made = name_of(operation.function), operation.outputs
    function = WHOLE_NUMBERS.get(name, OPERATIONS[name]) if _is_whole(made[0].dtype) else OPERATIONS[name]
    args, kwargs = operation.filled(known)
    if name in REDUCTIONS and kwargs.get("dtype") is not None:
        args = (_as_type(args[0], kwargs["dtype"], operation.inputs[:1], known, precision), *args[1:])
    real = [slot.dtype for slot in operation.inputs if slot.dtype.is_floating_point]
    if real and all(_is_narrower(dtype, precision) for dtype in real):  # numbers beside such tensors are rounded, too
        args = tree_map(lambda leaf: float(np.float32(leaf)) if isinstance(leaf, float) else leaf, args)
    results = function(*args, **kwargs)
    for slot, value in zip(made, results if isinstance(results, (list, tuple)) else [results], strict=True):
        known[slot] = _as_type(value, slot.dtype, operation.inputs, known, precision)


def _as_type(
    value: np.ndarray, dtype: torch.dtype, sources: list[Slot], known: Mapping[Slot, Any], precision: torch.dtype
) -> np.ndarray:
    """`value` with the elements that aren't taken over from `sources` of the same type changed to ones of `dtype`."""
    if dtype.is_floating_point and not _is_narrower(dtype, precision):
        return value
    change = _change(dtype, all(_is_whole(slot.dtype) or slot.dtype == torch.bool for slot in sources))
    same = [known[slot] for slot in sources if slot.dtype == dtype]
    kept = {id(element) for array in same if array.dtype == object for element in array.flat}
    return boxed(np.frompyfunc(lambda e: e if id(e) in kept else change(e), 1, 1)(boxed(value)))


def _change(dtype: torch.dtype, whole: bool) -> Callable[[Any], Any]:
    """How an element becomes one of `dtype`; `whole`: it was computed from integers and booleans."""
    if dtype == torch.float32:
        return to_single
    if dtype == torch.bool:
        return to_truth
    if not _is_whole(dtype):
        raise NoCounterpart(f"values in {dtype}")
    low, size = torch.iinfo(dtype).min, 2 ** torch.iinfo(dtype).bits

    def changed(element: Any) -> Any:
        if isinstance(element, (int, float)):
            return (int(element) - low) % size + low
        if not whole:
            raise NoCounterpart(f"{dtype} made of other numbers")
        return element if is_logical(element) or size > 2.0**53 else wrapped(element, low, size)

    return changed


def _is_whole(dtype: torch.dtype) -> bool:
    return not dtype.is_floating_point and not dtype.is_complex and dtype != torch.bool


def _is_narrower(dtype: torch.dtype, precision: torch.dtype) -> bool:
    return dtype.is_floating_point and torch.finfo(dtype).eps > torch.finfo(precision).eps
