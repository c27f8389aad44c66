"""First and second derivatives by one pass of forward over reverse differentiation, all knots and problems at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchgco.base.shapes import MISTAKES

AT_ONCE = 2**21  # numbers of w, over all directions, that are differentiated together: bounds the memory


def with_curvature(function: Callable[[Tensor], Tensor], w: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of function(w) (b, K, p), whose rows read one knot of w (b, K', v) each.

    Args:
        weights: (b, K, p).

    Returns:
        The Jacobians (b, K, p, v), and the Hessians of the weighted sums of a knot's rows, (b, K', v, v).
    """

    def weighted(w: Tensor) -> tuple[Tensor, Tensor]:
        value = function(w)
        return (weights * value).sum(), value

    def along(direction: Tensor) -> tuple[Tensor, Tensor]:
        return torch.func.jvp(torch.func.grad(weighted, has_aux=True), (w,), (direction.expand_as(w),))[1]

    basis = torch.eye(w.shape[-1], dtype=w.dtype, device=w.device)
    H, J = torch.func.vmap(along, chunk_size=max(1, AT_ONCE // max(1, w.numel())))(basis)
    return J.movedim(0, -1), H.movedim(0, -1)


def bends(function: Callable[[Tensor], Tensor], w: Tensor) -> bool:
    """Whether PyTorch differentiates a function twice: some operations have first derivatives alone."""
    try:
        value = function(w)
        with_curvature(function, w, torch.ones_like(value))
    except MISTAKES:
        return False
    return True
