"""Tensors that ask for gradients: found in nested parts, taken out of them, and admitted by the checks of input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

_recording: ContextVar[bool] = ContextVar("recording", default=False)


@contextmanager
def recording() -> Iterator[None]:
    """What is computed from tensors that ask for gradients is recorded, and checks of input admit such tensors."""
    token = _recording.set(True)
    try:
        with torch.enable_grad():
            yield
    finally:
        _recording.reset(token)


def is_recording() -> bool:
    """Whether checks of input admit tensors that ask for gradients."""
    return _recording.get()


def leaves(tree: Any) -> list[Any]:
    """All that nested sequences, mappings and dataclasses hold, but for these themselves."""
    found: list[Any] = []
    waiting, seen = [tree], set[int]()
    while waiting:
        part = waiting.pop()
        if not isinstance(part, (Mapping, tuple, list)) and (isinstance(part, type) or not is_dataclass(part)):
            found.append(part)
        elif id(part) not in seen:  # parts may hold each other
            seen.add(id(part))
            waiting += [held for _, held in _parts(part)]
    return found


def asking(tree: Any) -> list[Tensor]:
    """The tensors in nested sequences, mappings and dataclasses that ask for gradients."""
    return [leaf for leaf in leaves(tree) if isinstance(leaf, Tensor) and leaf.requires_grad]


def without_gradients(tree: Any) -> Any:
    """The same numbers without gradients; parts that hold no tensor that asks for one are the same objects."""
    if isinstance(tree, Tensor):
        return tree.detach() if tree.requires_grad else tree
    if not asking(tree):
        return tree
    parts = {name: without_gradients(part) for name, part in _parts(tree)}
    if isinstance(tree, Mapping):
        return parts
    if isinstance(tree, (tuple, list)):
        return type(tree)(*parts.values()) if hasattr(tree, "_fields") else type(tree)(parts.values())
    twin = object.__new__(type(tree))  # a part has checked its other fields already
    for name, part in parts.items():
        object.__setattr__(twin, name, part)
    return twin


def _parts(tree: Any) -> list[tuple[Any, Any]]:
    """What a sequence, a mapping or a dataclass holds, by place or name; nothing of all else."""
    if isinstance(tree, Mapping):
        return list(tree.items())
    if isinstance(tree, (tuple, list)):
        return list(enumerate(tree))
    if is_dataclass(tree) and not isinstance(tree, type) and hasattr(tree, "__dict__"):
        return list(vars(tree).items())
    return []
