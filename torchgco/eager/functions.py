"""A batch of problems along trajectories: values, and derivatives of first and second order, of all knots at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.base.autodiff import hessian_forward, jacobian, not_finite
from torchgco.base.clock import loading
from torchgco.base.shapes import MISTAKES
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, FunctionConstraint
from torchgco.costs.base import Cost, ShiftedCost
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.obstacles.base import OwnKind
from torchgco.problem.problem import Problem

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


@loading()
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


@dataclass(frozen=True)
class Functions:
    """The dynamics, the cost and some constraints of b problems with K knots; z = [x, u] are the S variables of a knot.

    Derivatives by the controls of the last knot, which has none, are 0.

    Attributes:
        rows: the constraints, by their number, with how PyTorch differentiates them.
        expansion: the same of the dynamics.
    """

    problem: Problem
    rows: dict[int, Expansion]
    expansion: Expansion

    @classmethod
    def of(cls, problem: Problem, called: Iterable[int]) -> Functions:
        """The functions of a form of problems, with the constraints of these numbers."""
        alone = problem.take(slice(0, 1))
        n, (X, U) = problem.n, alone.at_rest
        rows = {i: expansion_of(*_by_knots(alone.constraints[i], X, U)[:2]) for i in called}
        step = lambda z: alone.along.step(z[..., :n], z[..., n:])
        return cls(problem, rows, expansion_of(step, torch.cat((X[:, :-1], U), dim=-1)))

    def among(self, problem: Problem) -> Functions:
        """Those of other problems of the same form."""
        return self if problem is self.problem else replace(self, problem=problem)

    def cost(self, X: Tensor, U: Tensor) -> Tensor:
        """Costs of whole trajectories (b,)."""
        return self.problem.cost.total(X, U)

    def step(self, X: Tensor, U: Tensor) -> Tensor:
        """The next states (b, N, n)."""
        return self.problem.along.step(X[:, :-1], U)

    def row(self, i: int, X: Tensor, U: Tensor) -> Tensor:
        """Rows (b, K, p) of constraint i."""
        return self.problem.constraints[i].value(X, U)

    def expand_cost(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (b, N+1, S) and Hessians (b, N+1, S, S) of the cost."""
        n, s = self.problem.n, self.problem.n + 1 + self.problem.m
        blocks = X.new_empty(*X.shape[:2], s, s)
        _expand_exactly(self.problem.cost, X, U, blocks)
        z = [i for i in range(s) if i != n]
        return blocks[..., z, n], blocks[..., z, :][..., z]

    def expand_step(self, X: Tensor, U: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (b, N, n, S) of the step, and Hessians (b, N, S, S) of y' step, for y (b, N, n)."""
        model, n = self.problem.along, self.problem.n
        z = torch.cat((X[:, :-1], U), dim=-1)
        return self.expansion(lambda z: model.step(z[..., :n], z[..., n:]), z, y)

    def expand_row(self, i: int, X: Tensor, U: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (b, K, p, S) of constraint i, and Hessians (b, K, S, S) of lam' c, for lam (b, K, p)."""
        constraint, S = self.problem.constraints[i], X.shape[-1] + U.shape[-1]
        function, w, columns = _by_knots(constraint, X, U)
        parts = self.rows[i](function, w, lam)
        J, H = (z if z.shape[1] == lam.shape[1] else z[:, constraint.knots] for z in parts)
        slopes, curvature = J.new_zeros(*J.shape[:3], S), H.new_zeros(*J.shape[:2], S, S)
        slopes[..., columns], curvature[..., columns, columns] = J, H
        return slopes, curvature

    def nearby(self, X: Tensor, U: Tensor, start: Tensor, controls: Tensor) -> Tensor:
        """States (b, N+1, n) that follow from others than X, U, with the same gaps."""
        ahead, states = self.step(X, U), [start]
        for k in range(U.shape[1]):
            step = self.problem.dynamics.at(k).step(states[-1], controls[:, k])
            states.append(X[:, k + 1] + (step - ahead[:, k]))
        return torch.stack(states, dim=1)


def joined(X: Tensor, U: Tensor) -> Tensor:
    """z = [x, u] of all knots (b, N+1, S), with zeros for the controls of the last one."""
    return torch.cat((X, torch.nn.functional.pad(U, (0, 0, 0, 1))), dim=-1)


def is_function(part: Constraint) -> bool:
    """Whether rows are a function of their own knot's x, u or both."""
    return isinstance(part, FunctionConstraint) and type(part).value is FunctionConstraint.value


def _by_knots(part: Constraint, X: Tensor, U: Tensor) -> tuple[Callable[[Tensor], Tensor], Tensor, slice]:
    """Rows (b, K, p) as a function of w, columns of z at their knots or at all; w, and which columns these are."""
    n, S = X.shape[-1], X.shape[-1] + U.shape[-1]
    if is_function(part):
        assert isinstance(part, FunctionConstraint)
        k = torch.arange(X.shape[1], device=X.device)[part.knots]
        read = [(X if of == "x" else U)[:, part.knots] for of in part.of]
        sizes = [z.shape[-1] for z in read]
        columns = slice(n if part.of == "u" else 0, n if part.of == "x" else S)
        return lambda w: part.rows_at(k, *w.split(sizes, dim=-1)), torch.cat(read, dim=-1), columns
    if isinstance(part, OwnKind) and not is_users(part):  # which reads nothing but the position
        at = part.position
        before, after = X[..., : at.start], X[..., at.stop :]
        return lambda w: part.value(torch.cat((before, w, after), dim=-1), U), X[..., at], at
    return lambda w: part.value(w[..., :n], w[:, :-1, n:]), joined(X, U), slice(0, S)


def _expand_exactly(cost: Cost, X: Tensor, U: Tensor, H: Tensor) -> None:
    """Write gradient and exact Hessian into homogeneous blocks; a cost's own `expand` may leave parts of it out."""
    if isinstance(cost, ShiftedCost):
        _expand_exactly(cost.cost, X, U, H)
    elif isinstance(cost, BoundQuadratic):
        cost.expand(X, U, H)
    else:
        Cost.expand(cost, X, U, H)
