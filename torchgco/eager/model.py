"""A batch of problems along trajectories: values, and derivatives of first and second order, of all knots at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.costs.base import Cost, ShiftedCost
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.eager.curvature import Expansion, expansion_of
from torchgco.eager.rows import Group, Slopes, groups_of, joined
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Values:
    """Along X (b, N+1, n), U (b, N, m)."""

    cost: Tensor  # (b,), in the problem's own units
    c: Tensor  # (b, R): rows
    gap: Tensor  # (b, N, n): step(x, u) less the next state


@dataclass(frozen=True)
class Derivatives:
    """First derivatives, and the curvature of the Lagrangian where it was asked for."""

    cost: Tensor  # (b, N+1, S): slopes of the cost
    F: Tensor  # (b, N, n, S): [fx fu]
    slopes: Sequence[Slopes]
    H: Tensor  # (b, N+1, S, S): weight times the cost's curvature, with those of y' step and lam' c

    def pull(self, by: Tensor) -> Tensor:
        """J' by (b, L, N+1, S) of row vectors by (b, L, R)."""
        out = self.cost.new_zeros(*by.shape[:2], *self.cost.shape[1:])
        for part in self.slopes:
            part.pull(by, out)
        return out

    def push(self, dz: Tensor, like: Tensor) -> Tensor:
        """J dz (b, R) of changes dz (b, N+1, S)."""
        out = torch.zeros_like(like)
        for part in self.slopes:
            out[:, part.place.rows] = part.push(dz).flatten(1)
        return out

    def terms(self, dz: Tensor, like: Tensor) -> Tensor:
        """The sums (b, R) of the sizes of what each variable adds to `push`."""
        out = torch.zeros_like(like)
        for part in self.slopes:
            out[:, part.place.rows] = part.terms(dz).flatten(1)
        return out

    def with_squares(self, cc: Tensor) -> Tensor:
        """H with J' diag(cc) J, of weights cc (b, R)."""
        H = self.H.clone()
        for part in self.slopes:
            part.add_squares(cc, H)
        return H


@dataclass(frozen=True)
class Model:
    """The functions of a batch of problems.

    Attributes:
        expansion: how PyTorch differentiates the dynamics.
    """

    problem: Problem
    groups: tuple[Group, ...]
    expansion: Expansion

    @classmethod
    def of(cls, problem: Problem) -> Model:
        """The model of a batch."""
        one = problem.take(slice(0, 1))
        n, (X, U) = problem.n, one.at_rest
        z = torch.cat((X[:, :-1], U), dim=-1)
        return cls(problem, groups_of(problem), expansion_of(lambda z: one.along.step(z[..., :n], z[..., n:]), z))

    def among(self, problem: Problem) -> Model:
        """The model of other problems of the same form."""
        return replace(self, problem=problem, groups=tuple(group.of(problem) for group in self.groups))

    def take(self, rows: Tensor) -> Model:
        """The model of the problems `rows` (int64)."""
        some = self.problem.take(rows)
        return self if some is self.problem else self.among(some)

    def values(self, X: Tensor, U: Tensor, rows: int) -> Values:
        """Cost, rows and gaps."""
        c = X.new_zeros(X.shape[0], rows)
        for group in self.groups:
            c[:, group.place.rows] = group.value(X, U)
        gap = self.problem.along.step(X[:, :-1], U) - X[:, 1:]
        return Values(self.problem.cost.total(X, U), c, gap)

    def cost_model(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (b, N+1, S) and curvature (b, N+1, S, S) of the cost."""
        n, s = self.problem.n, self.problem.n + 1 + self.problem.m
        blocks = X.new_empty(*X.shape[:2], s, s)
        _expand_exactly(self.problem.cost, X, U, blocks)
        z = [i for i in range(s) if i != n]
        return blocks[..., z, n], blocks[..., z, :][..., z]

    def slopes(self, X: Tensor, U: Tensor) -> Derivatives:
        """First derivatives, of the rows and the dynamics; `H` is that of the cost alone."""
        F = torch.cat(self.problem.along.jacobians(X[:, :-1], U), dim=-1)
        cost, H = self.cost_model(X, U)
        return Derivatives(cost, F, [group.slopes(X, U) for group in self.groups], H)

    def expand(self, X: Tensor, U: Tensor, weight: Tensor, y: Tensor, lam: Tensor) -> Derivatives:
        """Derivatives with the Lagrangian's curvature.

        Args:
            weight: of the cost (b,); its slopes are multiplied with it, too.
            y: costates (b, N+1, n), of which the first has no part.
            lam: multipliers of the rows (b, R).
        """
        cost, H = self.cost_model(X, U)
        weight = weight.view(-1, 1, 1)
        H = H * weight.unsqueeze(-1)
        F = self._dynamics(X, U, y, H)
        return Derivatives(cost * weight, F, [group.expand(X, U, lam, H) for group in self.groups], H)

    def _dynamics(self, X: Tensor, U: Tensor, y: Tensor, H: Tensor) -> Tensor:
        """[fx fu] (b, N, n, S); the curvature of y' step is added to H."""
        model, n = self.problem.along, self.problem.n
        z = joined(X, U)[:, :-1]
        F, curvature = self.expansion(lambda z: model.step(z[..., :n], z[..., n:]), z, y[:, 1:])
        H[:, :-1] += curvature
        return F


def _expand_exactly(cost: Cost, X: Tensor, U: Tensor, H: Tensor) -> None:
    """Write gradient and exact Hessian into homogeneous blocks; a cost's own `expand` may leave parts of it out."""
    if isinstance(cost, ShiftedCost):
        _expand_exactly(cost.cost, X, U, H)
    elif isinstance(cost, BoundQuadratic) or type(cost).total is not Cost.total:
        cost.expand(X, U, H)
    else:
        Cost.expand(cost, X, U, H)
