"""Roots of equations: what an implicit step is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # type: ignore[import]

from torchgco.base.autodiff import jacobian
from torchgco.base.gradients import asks

MOST_EVALUATIONS = 60  # after the first: a step takes 4 to 12; from states far off some take more
# Steps of this share of the unknowns, a power of the precision, end where the next one isn't far less: it is rounding.
BY_ROUNDING = 2.0 / 3.0
SERVES_AGAIN = 0.1  # slopes serve for another correction where it is this share of the last one

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

    By Newton's method, with halved corrections where it must be. Its first and second derivatives by all that the
    residual reads are those of the implicit function. Roots that the residual itself asks for, of as many rows, are
    found together with it.
    """
    if _AS_OPERATIONS.get():
        unknown = torch.ops.torchgco.unknown(guess)
        return torch.ops.torchgco.solved(unknown, residual(unknown))
    if (around := _AROUND.get()) is not None and around.rows == guess.shape[:-1]:
        return around.root_within(residual, guess)
    equation = _Equation(residual, guess)
    z = _newton(equation, equation.guess)
    value = equation(z)
    if is_functorch_wrapped_tensor(value) or asks(value):
        inverse = torch.linalg.inv_ex(_slopes(equation, z))[0]
        # A step of Newton's method with a constant inverse brings one more derivative each.
        for _ in range(2):
            z = z - _times(inverse, equation(z))
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
    """The root without derivatives.

    A step serves where the correction that the same slopes ask for after it is less than the step itself: the natural
    monotonicity test, which no scale of the residual changes (Deuflhard, Newton Methods for Nonlinear Problems, section
    3.3); or where the residual is less. Slopes serve again where it is a tenth at most; steps are halved with slopes of
    their own point alone. The root is found where what is left is less than rounding.
    """
    rest, epsilon, step, trial = residual(z).detach(), torch.finfo(z.dtype).eps, torch.zeros_like(z), z
    lost = ~torch.isfinite(rest).all(-1)
    done, begins, fresh = lost, ~lost, torch.zeros_like(lost)  # begins: slopes of the trial are taken without a test
    inverse, share = z.new_zeros(*z.shape, z.shape[-1]), torch.ones_like(rest[..., 0])
    size = torch.zeros_like(share)  # of the residual at z, squared
    for _ in range(1 + MOST_EVALUATIONS):
        further, length, less = -_times(inverse, rest), step.abs().amax(-1), rest.square().sum(-1)
        left, of_trial, tested = further.abs().amax(-1), trial.abs().amax(-1), ~begins & ~done
        better = begins | (tested & ((left <= length) | (less < size)))
        ends = tested & better & (left * left <= epsilon * of_trial * length)
        ahead = trial + torch.where(ends.unsqueeze(-1), further, 0.0)
        z, size = torch.where(better.unsqueeze(-1), ahead, z), torch.where(better, less, size)
        ends |= tested & ~(left <= SERVES_AGAIN * length) & (length <= epsilon**BY_ROUNDING * of_trial)
        done = done | ends
        if _all(done):
            break
        stale = better & ~ends & (begins | (left > SERVES_AGAIN * length))
        if not _all(~stale):
            inverse = torch.where(stale[..., None, None], torch.linalg.inv_ex(_slopes(residual, z))[0], inverse)
            further = torch.where(stale.unsqueeze(-1), -_times(inverse, rest), further)
        begins = tested & ~better & ~ends & ~fresh
        fresh, share = stale | (fresh & ~better), torch.where(better | begins, 1.0, 0.5 * share)
        step = torch.where(better.unsqueeze(-1), further, step)
        trial = z + torch.where(begins, 0.0, share).unsqueeze(-1) * step
        rest = residual(trial).detach()
    return torch.where((done & ~lost).unsqueeze(-1), z, torch.nan)


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)


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
    known = torch.isfinite(slopes).all(-1).all(-1) | ~torch.isfinite(residual(z.detach())).all(-1)
    return slopes if bool(known.all()) else jacobian(residual, z)[0].detach()


def _all(done: Tensor) -> bool:
    """Whether all are true, as far as it may be read."""
    try:
        return bool(done.all())
    except RuntimeError:  # within `torch.func.vmap`
        return False
