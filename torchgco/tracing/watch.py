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
