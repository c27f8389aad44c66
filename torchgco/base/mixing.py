"""Which tensor of a user's function has another floating-point type than the problem."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils._pytree import tree_leaves

from torchgco.base.shapes import MISTAKES


class _FirstMix(TorchFunctionMode):
    """Keeps the first call that takes tensors of `dtype` and of another floating-point type: the call and the other.

    Of those that `fail` the first, or any.
    """

    def __init__(self, dtype: torch.dtype, fail: bool) -> None:
        super().__init__()
        self.dtype, self.fail = dtype, fail
        self.found: tuple[Any, Tensor] | None = None

    def __torch_function__(self, func, types, args=(), kwargs=None):
        leaves = tree_leaves((args, kwargs))
        kinds = {leaf.dtype: leaf for leaf in leaves if isinstance(leaf, Tensor) and leaf.is_floating_point()}
        mix = None
        if self.found is None and self.dtype in kinds and len(kinds) > 1:
            mix = func, next(leaf for dtype, leaf in kinds.items() if dtype != self.dtype)
        try:
            result = func(*args, **(kwargs or {}))
        except MISTAKES:
            self.found = self.found or mix
            raise
        self.found = self.found if self.fail else self.found or mix
        return result


def why(error: Exception, function: Callable[..., Any], *arguments: Any) -> str:
    """Why a call failed, in one line: the tensor of another type than x0, where the two don't join, else the error's.

    The first floating-point tensor of the arguments has the type of x0.
    """
    real = [z for z in arguments if isinstance(z, Tensor) and z.is_floating_point()]
    if (mismatch := foreign(real[0].dtype, function, *arguments, fail=True) if real else None) is not None:
        return mismatch
    return (str(error).splitlines() or [""])[0] or type(error).__name__


def foreign(dtype: torch.dtype, function: Callable[..., Any], *arguments: Any, fail: bool = False) -> str | None:
    """The first tensor of another floating-point type that the function joins with one of x0's `dtype`, in words.

    Args:
        fail: only where they can't be joined.
    """
    with suppress(*MISTAKES), _FirstMix(dtype, fail) as mix:
        function(*arguments)
    if mix.found is None:
        return None
    called, other = mix.found
    name = resolve_name(called) or getattr(called, "__name__", "a function")
    return f"{other.dtype} {tuple(other.shape)} beside {dtype}, the type of x0, in {name}"
