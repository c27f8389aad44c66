"""Roots of equations: what an implicit step is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian

# Newton's method ends where its correction is this share of the unknowns: the error that is left is of its square.
NEARLY_CONVERGED = 2.0 / 3.0  # as a power of the precision
MOST_EVALUATIONS = 30  # 15 corrections from any guess that serves, and as many halvings

_LIBRARY = torch.library.Library("torchgco", "DEF")
_LIBRARY.define("unknown(Tensor guess) -> Tensor")
_LIBRARY.define("solved(Tensor unknown, Tensor residual) -> Tensor")
_LIBRARY.impl("unknown", lambda guess: guess.clone(), "CompositeExplicitAutograd")
_LIBRARY.impl("solved", lambda unknown, residual: unknown.clone(), "CompositeExplicitAutograd")
UNKNOWN, SOLVED = "torchgco.unknown", "torchgco.solved"  # the operations that stand for a root in a recording

_AS_OPERATIONS: ContextVar[bool] = ContextVar("as_operations", default=False)


@contextmanager
def roots_as_operations() -> Iterator[None]:
    """Within, a root is two operations, `UNKNOWN` and `SOLVED`, with the residual between them, and isn't computed:
    Newton's method looks at numbers, which a recording can't follow.
    """
    before = _AS_OPERATIONS.set(True)
    try:
        yield
    finally:
        _AS_OPERATIONS.reset(before)


def root(residual: Callable[[Tensor], Tensor], guess: Tensor) -> Tensor:
    """z (..., q) where residual(z) (..., q), which maps each row by itself, is 0; NaN in rows where none is found.

    By Newton's method with corrections that are halved until the residual is less (Nocedal and Wright, Numerical
    Optimization, section 11.2). Its first and second derivatives by all that the residual reads are those of the
    implicit function.
    """
    if _AS_OPERATIONS.get():
        unknown = torch.ops.torchgco.unknown(guess)
        return torch.ops.torchgco.solved(unknown, residual(unknown))
    z = _newton(residual, guess.detach())
    inverse = torch.linalg.inv_ex(_slopes(residual, z))[0]
    # A step of Newton's method with a constant inverse brings one more derivative each.
    for _ in range(2):
        z = z - (inverse @ residual(z).unsqueeze(-1)).squeeze(-1)
    return z


def _newton(residual: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """The root without derivatives."""
    near = torch.finfo(z.dtype).eps ** NEARLY_CONVERGED
    size = torch.full_like(z[..., 0], torch.inf)
    correction, share, done = torch.zeros_like(z), torch.ones_like(size), torch.zeros_like(size, dtype=torch.bool)
    for _ in range(MOST_EVALUATIONS):
        trial = z + share.unsqueeze(-1) * correction
        rest = residual(trial).detach()
        new_size = rest.square().sum(-1)
        better = (new_size < size) & ~done
        ahead = -torch.linalg.solve_ex(_slopes(residual, trial), rest)[0]
        accepted = better.unsqueeze(-1)
        z, correction = torch.where(accepted, trial, z), torch.where(accepted, ahead, correction)
        size, share = torch.where(better, new_size, size), torch.where(better, 1.0, 0.5 * share)
        ends = (correction.abs().amax(-1) <= near * z.abs().amax(-1)) & (size < torch.inf) & ~done
        z = torch.where(ends.unsqueeze(-1), z + correction, z)
        done = done | ends
        if _all(done):
            break
    return torch.where(done.unsqueeze(-1), z, torch.nan)


def _slopes(residual: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """The Jacobian (..., q, q) of the residual, a constant.

    Backwards, all rows at once, which takes a tenth of the time of `torch.func.jvp`, where that is possible and finite.
    """
    try:
        with torch.enable_grad():
            at = z.detach().clone().requires_grad_()
            totals, basis = residual(at).flatten(0, -2).sum(0), torch.eye(z.shape[-1]).to(z)
            slopes = torch.autograd.grad(totals, at, basis, is_grads_batched=True)[0].movedim(0, -2)
    except RuntimeError:  # within `torch.func`, or in inference mode
        return jacobian(residual, z)[0].detach()
    return slopes if bool(torch.isfinite(slopes).all()) else jacobian(residual, z)[0].detach()


def _all(done: Tensor) -> bool:
    """Whether all are true, as far as it may be read."""
    try:
        return bool(done.all())
    except RuntimeError:  # within `torch.func.vmap`
        return False
