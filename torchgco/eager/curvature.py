"""First and second derivatives of functions whose rows read one knot each, of all knots and problems at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchgco.base.autodiff import hessian_forward, jacobian, not_finite
from torchgco.base.shapes import MISTAKES

DIRECTIONS_AT_ONCE = 2**20  # numbers of w, over all directions, that are differentiated together: bounds the memory

Function = Callable[[Tensor], Tensor]  # of w (b, K', v): rows (b, K, p)
Expansion = Callable[[Function, Tensor, Tensor], tuple[Tensor, Tensor]]


def by_reverse(function: Function, w: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of function(w), by reverse over reverse differentiation: a few calls, whatever the code.

    Args:
        weights: (b, K, p).

    Returns:
        The Jacobians, (b, K', p, v) or (b, K, p, v), and the Hessians of the weighted sums of a knot's rows,
        (b, K', v, v), or (b, K, v, v) where those are not finite.
    """
    with torch.enable_grad():
        z = w.detach().clone().requires_grad_()
        value = function(z)
        if not value.requires_grad:
            return w.new_zeros(*value.shape, w.shape[-1]), w.new_zeros(*w.shape, w.shape[-1])
        (slopes,) = torch.autograd.grad((weights * value).sum(), z, create_graph=True)
        J = _rows(value, z) if value.shape[-1] <= 2 * w.shape[-1] else jacobian(function, w)[0]
        H = _rows(slopes, z) if slopes.requires_grad else w.new_zeros(*w.shape, w.shape[-1])
    return _finite(function, w, weights, value.detach(), J.detach(), H.detach())


def _finite(
    function: Function, w: Tensor, weights: Tensor, value: Tensor, J: Tensor, H: Tensor
) -> tuple[Tensor, Tensor]:
    """J and H, by forward differentiation alone where they aren't finite: `hessian_forward` says why."""
    if not_finite(J, value):
        J = jacobian(function, w)[0]
    if not_finite(H, value):
        other = hessian_forward(lambda w: (weights * function(w)).sum(-1), w)
        H = torch.where(torch.isfinite(H), H, other) if other.shape == H.shape else other
    return J, H


def _rows(values: Tensor, z: Tensor) -> Tensor:
    """Slopes (..., p, v) of values (..., p) by z (..., v)."""
    basis = torch.eye(values.shape[-1], dtype=z.dtype, device=z.device)
    basis = basis.view(-1, *[1] * (values.dim() - 1), values.shape[-1])
    parts = []
    for directions in basis.split(max(1, DIRECTIONS_AT_ONCE // max(1, z.numel()))):
        many = directions.expand(-1, *values.shape)
        gradients = torch.autograd.grad(values, z, many, retain_graph=True, is_grads_batched=True, allow_unused=True)[0]
        # Slopes of an affine function depend on its weights, which may ask for gradients, and not on z.
        parts.append(z.new_zeros(len(directions), *z.shape) if gradients is None else gradients)
    return torch.cat(parts).movedim(0, -2)


def by_forward(function: Function, w: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The same by forward over reverse differentiation, which also works in inference mode; many times slower."""

    def weighted(w: Tensor) -> tuple[Tensor, Tensor]:
        value = function(w)
        return (weights * value).sum(), value

    def along(direction: Tensor) -> tuple[Tensor, Tensor]:
        return torch.func.jvp(torch.func.grad(weighted, has_aux=True), (w,), (direction.expand_as(w),))[1]

    basis = torch.eye(w.shape[-1], dtype=w.dtype, device=w.device)
    H, J = torch.func.vmap(along, chunk_size=max(1, DIRECTIONS_AT_ONCE // max(1, w.numel())))(basis)
    return _finite(function, w, weights, function(w), J.movedim(0, -1), H.movedim(0, -1))


def flat(function: Function, w: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The same where PyTorch differentiates the code only once: its curvature counts as 0."""
    return jacobian(function, w)[0], w.new_zeros(*w.shape, w.shape[-1])


def expansion_of(function: Function, w: Tensor) -> Expansion:
    """The fastest of these that serves a function, tried at w."""
    for way in (by_reverse, by_forward):
        if way is by_reverse and torch.is_inference_mode_enabled():
            continue
        try:
            way(function, w, torch.ones_like(function(w)))
        except MISTAKES:
            continue
        return way
    return flat
