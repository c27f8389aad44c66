"""Derivatives of batched functions by `torch.func`, for parts that define none.

Every basis direction is pushed through the whole batch at once, so a function sees the shapes it was written for and
may use parameters per problem. `vmap` over the batch would not allow that.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def jacobian(function: Callable[..., Tensor], *args: Tensor) -> tuple[Tensor, ...]:
    """Derivatives of function(*args) (..., out) with respect to each argument's last axis: (..., out, in) each."""
    sizes = [arg.shape[-1] for arg in args]

    def along(direction: Tensor) -> Tensor:
        tangents = tuple(part.expand_as(arg) for part, arg in zip(direction.split(sizes), args, strict=True))
        return torch.func.jvp(function, args, tangents)[1]

    basis = torch.eye(sum(sizes), dtype=args[0].dtype, device=args[0].device)
    return torch.func.vmap(along)(basis).movedim(0, -1).split(sizes, dim=-1)


def gradients(function: Callable[..., Tensor], *args: Tensor) -> tuple[Tensor, ...]:
    """Gradients of function(*args).sum() with respect to each argument; zero where the sum doesn't depend on it.

    `torch.func` differentiates within `torch.no_grad()` and `torch.inference_mode()` too, and through tensors that were
    created there, where `torch.autograd.grad` raises or sees constants.
    """
    return torch.func.grad(lambda *z: function(*z).sum(), argnums=tuple(range(len(args))))(*args)


def gradient_and_hessian(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (..., s) and Hessian (..., s, s) of function(z) (...), which maps each row of z (..., s) to a number."""
    gradient = torch.func.grad(lambda rows: function(rows).sum())

    def along(direction: Tensor) -> Tensor:
        return torch.func.jvp(gradient, (z,), (direction.expand_as(z),))[1]

    basis = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    return gradient(z), torch.func.vmap(along)(basis).movedim(0, -1)
