"""Tensors that ask for gradients: found in nested parts, taken out of them, and admitted by the checks of input."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import is_dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchgco.base.tree import mapped

_recording: ContextVar[bool] = ContextVar("recording", default=False)


@contextmanager
def recording() -> Iterator[None]:
    """What is computed from tensors that ask for gradients is recorded, and checks of input admit such tensors."""
    token = _recording.set(True)
    try:
        with torch.enable_grad(), forward_ad._set_fwd_grad_enabled(True) if is_forward() else nullcontext():
            yield
    finally:
        _recording.reset(token)


def not_recording() -> AbstractContextManager[None]:
    """Nothing is recorded, neither for backward passes nor of tensors in forward mode."""
    return _without_tangents() if forward_ad._current_level >= 0 else torch.no_grad()


@contextmanager
def _without_tangents() -> Iterator[None]:
    with torch.no_grad(), forward_ad._set_fwd_grad_enabled(False):
        yield


def is_forward() -> bool:
    """Whether this is within `forward_ad.dual_level`, where tensors may have tangents."""
    return forward_ad._current_level >= 0


def asks(tensor: Tensor) -> bool:
    """Whether a tensor asks for gradients, or has a tangent of forward mode."""
    return tensor.requires_grad or (forward_ad._current_level >= 0 and _has_tangent(tensor))


def _has_tangent(tensor: Tensor) -> bool:
    with forward_ad._set_fwd_grad_enabled(True):  # else none is shown
        return forward_ad.unpack_dual(tensor).tangent is not None


def is_recording() -> bool:
    """Whether checks of input admit tensors that ask for gradients."""
    return _recording.get()


def leaves(tree: Any) -> list[Any]:
    """All that nested sequences, mappings and dataclasses hold, but for these themselves."""
    return [node for node in nodes(tree) if _holds(type(node)) is None]


def nodes(tree: Any) -> list[Any]:
    """Nested sequences, mappings and dataclasses, and all that they hold."""
    flat: list[Any] = []
    waiting, seen = [tree], set[int]()
    while waiting:
        node = waiting.pop()
        held = _holds(type(node))
        if held is None:
            flat.append(node)
        elif id(node) not in seen:  # parts may hold each other
            seen.add(id(node))
            flat.append(node)
            waiting += held(node)
    return flat


@lru_cache(maxsize=4096)
def _holds(kind: type) -> Callable[[Any], Iterable[Any]] | None:
    """What sequences, mappings and dataclasses of a type hold; None of others: each solve looks at some hundred."""
    if issubclass(kind, Mapping):
        return lambda mapping: mapping.values()
    if issubclass(kind, (tuple, list)):
        return iter
    return (lambda part: getattr(part, "__dict__", {}).values()) if is_dataclass(kind) else None


def asking(tree: Any) -> list[Tensor]:
    """The tensors in nested sequences, mappings and dataclasses that ask for gradients."""
    return [leaf for leaf in leaves(tree) if isinstance(leaf, Tensor) and asks(leaf)]


def without_gradients(tree: Any) -> Any:
    """The same numbers without gradients; parts that hold no tensor that asks for one are the same objects."""
    if not asking(tree):  # it may hold itself
        return tree
    return mapped(tree, lambda leaf: leaf.detach() if asks(leaf) else leaf)
