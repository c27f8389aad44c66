"""Operations on tensors of several devices, which PyTorch refuses: they work on copies.

A problem of a GPU is solved on the CPU, where a user's function may still hold tensors of the GPU, such as the weights
of a network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

Copy = Callable[[Tensor, torch.device], Tensor]


def copy_to(tensor: Tensor, device: torch.device) -> Tensor:
    return torch.ops.aten._to_copy(tensor, device=device)


def together(
    func: Any, args: Any, kwargs: dict[str, Any], device: torch.device, copy: Copy = copy_to
) -> tuple[Any, dict[str, Any]]:
    """The arguments of an operation, where some lie on another device with a `copy` of each of these.

    Copies from device to device, and what writes into its arguments, stay as they are.
    """
    away = lambda leaf: isinstance(leaf, Tensor) and leaf.device != device and not _is_empty(leaf)
    if not any(map(away, leaves((args, kwargs)))) or func is torch.ops.aten._to_copy.default or func._schema.is_mutable:
        return args, kwargs
    return mapped_arguments(lambda leaf: copy(leaf, device) if away(leaf) else leaf, (args, kwargs))


def _is_empty(tensor: Tensor) -> bool:
    """Whether a tensor has a shape alone, as PyTorch's decompositions make some."""
    return type(tensor) is Tensor and tensor.is_meta


def mapped_arguments(function: Callable[[Any], Any], tree: Any) -> Any:
    """The arguments of an operation, nested tuples, lists and dicts, with function(leaf) in the place of each leaf.

    As PyTorch's `tree_map` of these three, which looks for many kinds more and takes half of the time of a trace.
    """
    if isinstance(tree, (tuple, list)):
        mapped = [mapped_arguments(function, branch) for branch in tree]
        return mapped if isinstance(tree, list) else tuple(mapped)
    if isinstance(tree, dict):
        return {name: mapped_arguments(function, branch) for name, branch in tree.items()}
    return function(tree)


def leaves(tree: Any) -> Iterator[Any]:
    """The leaves of what `mapped_arguments` takes, in order."""
    if isinstance(tree, (tuple, list, dict)):
        for branch in tree.values() if isinstance(tree, dict) else tree:
            yield from leaves(branch)
    else:
        yield tree


class Together(TorchDispatchMode):
    """In this block operations on tensors of a device and of others work on copies on that device."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if any(isinstance(leaf, Tensor) and leaf.device == self.device for leaf in leaves((args, kwargs))):
            args, kwargs = together(func, args, kwargs, self.device)
        return func(*args, **kwargs)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # as of `tracing.recorder.Recording`
