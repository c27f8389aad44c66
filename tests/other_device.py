"""A second device without hardware: tensors that say they are elsewhere, and operations that refuse to mix devices.

Values live in ordinary tensors of the CPU, so that code which looks at values runs as it would. A tensor of the second
device is a wrapper whose `device` is another one; what is made with `device=` of it is one, too. An operation on
tensors of both devices is an error, as it is on a GPU, but for single numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

OTHER = torch.device("meta")  # the one device besides the CPU that every build of PyTorch knows; nothing is asked of it
PACKAGE = Path(__file__).parents[1] / "torchgco"
INDEXED = (torch.ops.aten.index, torch.ops.aten.index_put, torch.ops.aten.index_put_)
FROM_DATA = (torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor)


class Elsewhere(Tensor):
    """A tensor of the second device, with its values in `held`."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Elsewhere:
        return Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            layout=held.layout, device=OTHER, requires_grad=False,
        )  # fmt: skip

    def __init__(self, held: Tensor) -> None:
        self.held = held

    def __repr__(self) -> str:
        return f"Elsewhere({self.held!r})"

    def tolist(self) -> Any:
        return self.held.tolist()

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside of SecondDevice")


@dataclass
class SecondDevice:
    """A context in which `OTHER` is a device.

    Attributes:
        moved: places in the package, "file:line", from which tensors were brought to the CPU or from it.
        moves: how often.
    """

    moved: set[str] = field(default_factory=set)
    moves: int = 0

    def __enter__(self) -> SecondDevice:
        self._modes = _Made(), _Run(self)
        for mode in self._modes:
            mode.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        for mode in reversed(self._modes):
            mode.__exit__(*error)


class _Made(TorchFunctionMode):
    """Tensors made from data: PyTorch would make them on the device itself, without their values."""

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (Tensor.__getitem__, Tensor.__setitem__):  # a list in an index
            return func(args[0], _listed(args[1]), *args[2:])
        if func not in FROM_DATA:
            return func(*args, **kwargs)
        device = kwargs.pop("device", args[0].device if func is Tensor.new_tensor else None)
        if func is Tensor.new_tensor:
            kwargs.setdefault("dtype", args[0].dtype)
            args, func = args[1:], torch.tensor
        given = args[0]
        if device is None or torch.device(device).type != OTHER.type or isinstance(given, Elsewhere):
            return func(*args, **kwargs) if device is None else func(*args, device=device, **kwargs)
        return func(*args, device="cpu", **kwargs).to(OTHER)


def _listed(index: Any) -> Any:
    """An index with tensors of the CPU for its lists."""
    if isinstance(index, tuple):
        return tuple(map(_listed, index))
    return torch.tensor(index, device="cpu") if isinstance(index, list) else index


class _Run(TorchDispatchMode):
    def __init__(self, device: SecondDevice) -> None:
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
        there = any(isinstance(value, Elsewhere) for value in tensors)
        device, moves = kwargs.get("device"), func._overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_)
        if device is not None and torch.device(device).type == OTHER.type:
            kwargs["device"] = torch.device("cpu")
            result_there = True
        else:
            result_there = there and device is None
        if moves and len({isinstance(value, Elsewhere) for value in tensors} | {result_there}) > 1:
            self.device.moved.add(_place())
            self.device.moves += 1
        elif there and not moves:
            mixing = tensors[:1] if func._overloadpacket in INDEXED else tensors  # indices may lie on the CPU
            strange = [value for value in mixing if not isinstance(value, Elsewhere) and value.dim() > 0]
            if strange:
                raise RuntimeError(f"{func}: tensors on two devices, of shapes {[tuple(v.shape) for v in strange]}")
        held = lambda value: value.held if isinstance(value, Elsewhere) else value
        if func._overloadpacket is torch.ops.aten._efficientzerotensor:  # zeros without storage, of derivatives
            func = torch.ops.aten.zeros.default
        result = func(*tree_map(held, args), **tree_map(held, kwargs))
        if not result_there:
            return result
        known = {id(value.held): value for value in tensors if isinstance(value, Elsewhere)}
        return tree_map(lambda value: _wrapped(value, known), result)


def _wrapped(value: Any, known: dict[int, Elsewhere]) -> Any:
    """A result on the second device: what was changed in place is the tensor that it was."""
    if type(value) is not Tensor:
        return value
    return known[id(value)] if id(value) in known else Elsewhere(value)


def _place() -> str:
    """The innermost line of the package on the stack, or "outside"."""
    frame: FrameType | None = sys._getframe()
    while frame is not None and not frame.f_code.co_filename.startswith(str(PACKAGE)):
        frame = frame.f_back
    return "outside" if frame is None else f"{Path(frame.f_code.co_filename).relative_to(PACKAGE)}:{frame.f_lineno}"
