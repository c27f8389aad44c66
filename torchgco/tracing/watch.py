"""Whether tensors still have the numbers that they had."""

from __future__ import annotations

import ctypes
from collections.abc import Hashable, Iterable

import torch
from torch import Tensor


def contents(tensors: Iterable[Tensor]) -> tuple[Hashable, ...] | None:
    """Content, shape, type and place of tensors, to be compared with those of another time.

    None where nothing is known of a tensor's memory, as of a sparse one's. Much quicker than PyTorch's operations on a
    few numbers each.
    """
    seen = list[Hashable]()
    for tensor in tensors:
        if tensor.layout is not torch.strided or tensor.device.type != "cpu":
            return None
        address, size = tensor.data_ptr(), tensor.nbytes
        if not tensor.is_contiguous():
            seen.append(tensor.stride())
            if size > 0:  # all from the first number to the last: strides are never negative
                steps = ((count - 1) * by for count, by in zip(tensor.shape, tensor.stride(), strict=True))
                size = (sum(steps) + 1) * tensor.element_size()
        seen += address, tensor.shape, tensor.dtype, ctypes.string_at(address, size)
    return tuple(seen)


def has_own_memory(tensor: Tensor) -> bool:
    """Whether a new tensor was made of numbers: the memory of a NumPy array, which it may share, can't be resized."""
    with torch._C.DisableTorchFunction():
        return tensor.untyped_storage().resizable()


def overlap(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors may share memory."""
    (first, last), (begin, end) = _memory(a), _memory(b)
    return first < end and begin < last


def _memory(tensor: Tensor) -> tuple[int, int]:
    """Where a tensor's memory begins and ends."""
    if tensor.layout is not torch.strided or tensor.numel() == 0:
        return 0, 0
    steps = ((size - 1) * by for size, by in zip(tensor.shape, tensor.stride(), strict=True))
    return tensor.data_ptr(), tensor.data_ptr() + (sum(steps) + 1) * tensor.element_size()
