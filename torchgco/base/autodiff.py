"""Derivatives of batched functions by `torch.func`, for parts that define none.

Every basis direction is pushed through the whole batch at once, so a function sees the shapes it was written for and
may use parameters per problem. `vmap` over the batch would not allow that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch import _is_functional_tensor as is_functional  # type: ignore[attr-defined]
from torch._C._functorch import is_functorch_wrapped_tensor  # type: ignore[import]
from torch.overrides import TorchFunctionMode

from torchgco.base.clock import loading
from torchgco.base.gradients import is_forward


class ReadsMemory(RuntimeError):
    """A function hands a tensor to NumPy or Python where only operations of PyTorch are seen."""


class WithoutReading(TorchFunctionMode):
    """Raises ReadsMemory where a function leaves PyTorch with a tensor that is differentiated or recorded.

    Such a tensor has no memory of its own: reading it may crash, and what is made of the numbers is a constant. Other
    tensors may be read; `seen` keeps by which methods, `read` which ones. `called` is the function of PyTorch that was
    called last, `refused` the first error, which the function itself may have caught.
    """

    READERS = (
        "numpy", "__array__", "__dlpack__", "tolist", "data_ptr", "storage", "untyped_storage", "__repr__",
        "__format__",
    )  # fmt: skip
    PLACED = ("tensor_split",)  # functions of PyTorch that read where to cut without any operation

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()
        self.read: list[Tensor] = []
        self.called: Any = None
        self.refused: ReadsMemory | None = None

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.called, name = func, getattr(func, "__name__", "")
        if name in self.READERS:
            self._hand_over(name, args[:1])
        elif name in self.PLACED:
            self._hand_over(name, (*args[1:], *(kwargs or {}).values()))
        return func(*args, **(kwargs or {}))

    def _hand_over(self, name: str, values: Sequence[Any]) -> None:
        """Note that a function reads these values without an operation."""
        tensors = [value for value in values if isinstance(value, Tensor)]
        if tensors:
            self.seen.add(name)
        if any(is_functional(tensor) or is_functorch_wrapped_tensor(tensor) for tensor in tensors):
            refusal = ReadsMemory(f"one that hands its tensors to NumPy or Python (Tensor.{name})")
            self.refused = self.refused or refusal
            raise refusal
        self.read += tensors


@loading()
def slope_along(function: Callable[..., Tensor], args: tuple[Tensor, ...], tangents: tuple[Tensor, ...]) -> Tensor:
    """The derivative of function(*args) along tangents, of the shape of its value.

    Within `forward_ad.dual_level`, where PyTorch nests no forward mode, by reverse mode of the linear map of a
    backward pass.
    """
    if not is_forward():
        return torch.func.jvp(function, args, tangents)[1]
    value, backward = torch.func.vjp(function, *args)[:2]
    return torch.func.vjp(backward, torch.zeros_like(value))[1](tangents)[0]


@loading()
def jacobian(function: Callable[..., Tensor], *args: Tensor) -> tuple[Tensor, ...]:
    """Derivatives of function(*args) (..., out) with respect to each argument's last axis: (..., out, in) each."""
    sizes = [arg.shape[-1] for arg in args]

    def along(direction: Tensor) -> Tensor:
        tangents = tuple(tangent.expand_as(arg) for tangent, arg in zip(direction.split(sizes), args, strict=True))
        return slope_along(function, args, tangents)

    basis = torch.eye(sum(sizes), dtype=args[0].dtype, device=args[0].device)
    return torch.func.vmap(along)(basis).movedim(0, -1).split(sizes, dim=-1)


@loading()
def gradients(function: Callable[..., Tensor], *args: Tensor) -> tuple[Tensor, ...]:
    """Gradients of function(*args).sum() with respect to each argument; zero where the sum doesn't depend on it.

    `torch.func` differentiates within `torch.no_grad()` and `torch.inference_mode()` too, and through tensors that were
    created there, where `torch.autograd.grad` raises or sees constants.
    """
    return torch.func.grad(lambda *z: function(*z).sum(), argnums=tuple(range(len(args))))(*args)


def gradients_at_once(function: Callable[..., Tensor], *args: Tensor) -> tuple[Tensor, ...]:
    """`gradients` without loading `torch.func`, which takes seconds at its first use, where that isn't needed."""
    if not torch.is_inference_mode_enabled():
        try:
            with torch.enable_grad():
                z = [arg.detach().clone().requires_grad_() for arg in args]
                total = function(*z).sum()
                slopes = torch.autograd.grad(total, z, allow_unused=True) if total.requires_grad else [None] * len(z)
        except ReadsMemory:
            raise
        except RuntimeError:  # a tensor of the function was made in inference mode, say
            pass
        else:
            return tuple(torch.zeros_like(arg) if g is None else g for g, arg in zip(slopes, args, strict=True))
    return gradients(function, *args)


@loading()
def gradient_and_hessian(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (..., s) and Hessian (..., s, s) of function(z) (...), which maps each row of z (..., s) to a number.

    By forward over reverse differentiation; where that isn't finite, by forward differentiation alone.
    """
    gradient = torch.func.grad(lambda rows: function(rows).sum())

    def along(direction: Tensor) -> Tensor:
        return slope_along(gradient, (z,), (direction.expand_as(z),))

    basis = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    g, H = gradient(z), torch.func.vmap(along)(basis).movedim(0, -1)
    if lost := not_finite(g, function(z)):
        g = torch.where(torch.isfinite(g), g, jacobian(lambda z: function(z).unsqueeze(-1), z)[0].squeeze(-2))
    if lost or not_finite(H, function(z)):
        H = torch.where(torch.isfinite(H), H, hessian_forward(function, z))
    return g, H


def not_finite(derivatives: Tensor, values: Tensor) -> bool:
    """Whether derivatives aren't finite, though all values are or at least some."""
    return not bool(torch.isfinite(derivatives).all()) and bool(torch.isfinite(values).any())


def hessian_forward(function: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """The Hessian (..., s, s) of `gradient_and_hessian` by forward over forward differentiation; NaN if it has none.

    Reverse differentiation multiplies the slopes of a branch that `torch.where` doesn't take by 0, which is NaN where
    they are infinite or NaN, as those of `where(x > 0, x.sqrt(), x)` at x <= 0; forward differentiation leaves them
    out. It takes s times as long.
    """
    basis = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)

    def slope(z: Tensor, i: int) -> Tensor:
        return slope_along(function, (z,), (basis[i].expand_as(z),))

    def row(i: int) -> Tensor:
        along = lambda direction: slope_along(lambda z: slope(z, i), (z,), (direction.expand_as(z),))
        return torch.func.vmap(along)(basis).movedim(0, -1)

    try:
        return torch.stack([row(i) for i in range(z.shape[-1])], dim=-2)
    except RuntimeError:  # an operation without such derivatives
        return torch.full((*z.shape, z.shape[-1]), torch.nan, dtype=z.dtype, device=z.device)
