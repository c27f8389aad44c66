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
    implicit function. Roots that the residual itself asks for, of as many rows, are found together with it.
    """
    if _AS_OPERATIONS.get():
        unknown = torch.ops.torchgco.unknown(guess)
        return torch.ops.torchgco.solved(unknown, residual(unknown))
    if (around := _AROUND.get()) is not None and around.rows == guess.shape[:-1]:
        return around.root_within(residual, guess)
    equation = _Equation(residual, guess)
    z = _newton(equation, equation.guess)
    inverse = torch.linalg.inv_ex(_slopes(equation, z))[0]
    # A step of Newton's method with a constant inverse brings one more derivative each.
    for _ in range(2):
        z = z - (inverse @ equation(z).unsqueeze(-1)).squeeze(-1)
    return z[..., : guess.shape[-1]]


class _Equation:
    """A residual together with those of the roots that it asks for, as a function of all unknowns (..., q)."""

    def __init__(self, residual: Callable[[Tensor], Tensor], guess: Tensor) -> None:
        self._residual, self.rows = residual, guess.shape[:-1]
        self._guesses, self._given = [guess.detach()], iter(list[Tensor]())
        self._within: list[Tensor] = []
        self._called(guess.detach())
        self.guess, self._sizes = torch.cat(self._guesses, -1), [guess.shape[-1] for guess in self._guesses]

    def __call__(self, z: Tensor) -> Tensor:
        first, *others = z.split(self._sizes, -1)
        self._given, self._within = iter(others), []
        return torch.cat([self._called(first), *self._within], -1)

    def _called(self, z: Tensor) -> Tensor:
        before = _AROUND.set(self)
        try:
            return self._residual(z)
        finally:
            _AROUND.reset(before)

    def root_within(self, residual: Callable[[Tensor], Tensor], guess: Tensor) -> Tensor:
        """The unknowns of a root that the residual asks for, as they are given; at first, its guess."""
        z = next(self._given, None)
        if z is None:
            z = guess.detach()
            self._guesses.append(z)
        self._within.append(residual(z))
        return z


_AROUND: ContextVar[_Equation | None] = ContextVar("around", default=None)


def _newton(residual: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """The root without derivatives."""
    epsilon = torch.finfo(z.dtype).eps
    size = torch.full_like(z[..., 0], torch.inf)
    correction, share, done = torch.zeros_like(z), torch.ones_like(size), torch.zeros_like(size, dtype=torch.bool)
    for _ in range(MOST_EVALUATIONS):
        trial = z + share.unsqueeze(-1) * correction
        rest = residual(trial).detach()
        new_size, of_trial = rest.square().sum(-1), trial.abs().amax(-1)
        better = (new_size < size) & ~done
        # The next correction is less than rounding, if it is to this residual as the last one was to the one before.
        next_size = new_size * correction.abs().amax(-1).square()
        exact = better & (size < torch.inf) & (next_size <= (epsilon * of_trial).square() * size)
        ahead = -torch.linalg.solve_ex(_slopes(residual, trial), rest)[0]
        accepted = better.unsqueeze(-1)
        z, correction = torch.where(accepted, trial, z), torch.where(accepted, ahead, correction)
        size, share = torch.where(better, new_size, size), torch.where(better, 1.0, 0.5 * share)
        near = correction.abs().amax(-1) <= epsilon**NEARLY_CONVERGED * of_trial
        ends = better & ~exact & near
        z = torch.where(ends.unsqueeze(-1), z + correction, z)
        done = done | exact | ends
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
