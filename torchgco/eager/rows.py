"""Rows of constraints at all knots of all problems: values, slopes and curvatures.

Rows of all constraints stand in one axis q, constraint by constraint and knot by knot. z = [x, u] are the S variables
of a knot; the last knot has no controls, and what belongs to them is 0 there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, FunctionConstraint
from torchgco.constraints.bounds import Bounds
from torchgco.eager.curvature import Expansion, expansion_of, flat
from torchgco.obstacles.base import OwnKind
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Place:
    """Where the rows of a constraint are: q from `first` on, of K knots with p rows each, and the columns they read."""

    first: int
    K: int
    p: int
    knots: slice | Tensor
    columns: slice  # of z

    @property
    def rows(self) -> slice:
        """The rows q."""
        return slice(self.first, self.first + self.K * self.p)

    def of(self, values: Tensor) -> Tensor:
        """Those of rows (..., R), as (..., K, p)."""
        return values[..., self.rows].unflatten(-1, (self.K, self.p))


@dataclass(frozen=True)
class Dense:
    """The slopes of a constraint: a matrix per knot."""

    place: Place
    J: Tensor  # (b, K, p, v)

    def pull(self, by: Tensor, out: Tensor) -> None:
        """Add J' by, of row vectors by (b, L, R), to out (b, L, N+1, S)."""
        weights = self.place.of(by).transpose(1, 2)  # (b, K, L, p)
        found = (weights @ self.J).transpose(1, 2)
        out[(slice(None), slice(None), *_block(self.place.knots, self.place.columns))] += found

    def push(self, dz: Tensor) -> Tensor:
        """J dz (b, K, p) for changes dz (b, N+1, S)."""
        along = dz[(slice(None), *_block(self.place.knots, self.place.columns))]
        return (self.J @ along.unsqueeze(-1)).squeeze(-1)

    def terms(self, dz: Tensor) -> Tensor:
        """The sum (b, K, p) of the sizes of what each variable adds to `push`."""
        along = dz[(slice(None), *_block(self.place.knots, self.place.columns))]
        return (self.J * along.unsqueeze(-2)).abs().sum(-1)

    def squares(self, of: Tensor) -> tuple[Tensor, Tensor]:
        """J^2 (b, K, p, v), and numbers (b, N+1, S) of these variables, (b, K, 1, v)."""
        return self.J.square(), of[(slice(None), *_block(self.place.knots, self.place.columns))].unsqueeze(-2)

    def add_squares(self, cc: Tensor, H: Tensor) -> None:
        """Add J' diag(cc) J, of weights cc (b, R), to H (b, N+1, S, S)."""
        weighted = self.place.of(cc).unsqueeze(-1) * self.J
        H[(slice(None), *_square(self.place.knots, self.place.columns))] += self.J.mT @ weighted


@dataclass(frozen=True)
class Single:
    """The slopes of bounds: +1 for the upper ones, then -1 for the lower ones, each of one variable."""

    place: Place
    above: Tensor  # variables of z
    below: Tensor

    def pull(self, by: Tensor, out: Tensor) -> None:
        """As of `Dense`."""
        weights, split = self.place.of(by), len(self.above)
        lead = slice(None), slice(None)
        out[(*lead, *_block(self.place.knots, self.above))] += weights[..., :split]
        out[(*lead, *_block(self.place.knots, self.below))] -= weights[..., split:]

    def push(self, dz: Tensor) -> Tensor:
        """As of `Dense`."""
        at = (dz[(slice(None), *_block(self.place.knots, of))] for of in (self.above, self.below))
        upper, lower = at
        return torch.cat((upper, -lower), dim=-1)

    def terms(self, dz: Tensor) -> Tensor:
        """As of `Dense`."""
        return self.push(dz).abs()

    def squares(self, of: Tensor) -> tuple[Tensor, Tensor]:
        """As of `Dense`, for the one variable of each row: (b, K, p, 1)."""
        both = torch.cat((self.above, self.below))
        at = of[(slice(None), *_block(self.place.knots, both))].unsqueeze(-1)
        return torch.ones_like(at), at

    def add_squares(self, cc: Tensor, H: Tensor) -> None:
        """As of `Dense`."""
        weights, split, diagonal = self.place.of(cc), len(self.above), H.diagonal(dim1=-2, dim2=-1)
        for variables, part in ((self.above, weights[..., :split]), (self.below, weights[..., split:])):
            diagonal[(slice(None), *_block(self.place.knots, variables))] += part


Slopes = Dense | Single


@dataclass(frozen=True)
class Group:
    """A constraint of a batch, with its place among the rows."""

    part: Constraint
    number: int  # among the constraints
    place: Place
    expansion: Expansion = flat  # how PyTorch differentiates it; bounds are not

    def of(self, problem: Problem) -> Group:
        """The same of a subset of the problems."""
        return replace(self, part=problem.constraints[self.number])

    @property
    def is_bound(self) -> bool:
        """Whether rows are bounds of single variables."""
        return isinstance(self.part, Bounds) and not is_users(self.part)

    @property
    def of_controls(self) -> bool:
        """Of bounds: whether they are of controls."""
        return getattr(self.part, "of", None) == "u"

    def variables(self, n: int) -> tuple[Tensor, Tensor]:
        """Of bounds: which variables of z have an upper one, and which a lower one."""
        bounds: Any = self.part
        every = torch.arange(bounds.upper.shape[-1], device=bounds.upper.device) + (n if bounds.of == "u" else 0)
        return every[bounds.above], every[bounds.below]

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        """Rows (b, K p)."""
        return self.part.value(X, U).flatten(1)

    def slopes(self, X: Tensor, U: Tensor) -> Slopes:
        """First derivatives."""
        if self.is_bound:
            return Single(self.place, *self.variables(X.shape[-1]))
        function, w = self._function(X, U)
        return Dense(self.place, jacobian(function, w)[0])

    def expand(self, X: Tensor, U: Tensor, lam: Tensor, H: Tensor) -> Slopes:
        """First derivatives; the second ones of lam' c, for multipliers lam (b, R), are added to H (b, N+1, S, S)."""
        if self.is_bound or self.expansion is flat:
            return self.slopes(X, U)
        function, w = self._function(X, U)
        J, curvature = self.expansion(function, w, self.place.of(lam))
        if not is_function(self.part):
            J = J if J.shape[1] == self.place.K else J[:, self.place.knots]
            curvature = curvature if curvature.shape[1] == self.place.K else curvature[:, self.place.knots]
        H[(slice(None), *_square(self.place.knots, self.place.columns))] += curvature
        return Dense(self.place, J)

    def _function(self, X: Tensor, U: Tensor) -> tuple[Callable[[Tensor], Tensor], Tensor]:
        """The rows (b, K, p) as a function of the columns that they read, w: of their knots, or of all."""
        part, n = self.part, X.shape[-1]
        if is_function(part):
            assert isinstance(part, FunctionConstraint)
            k = torch.arange(X.shape[1], device=X.device)[part.knots]
            given = [(X if of == "x" else U)[:, part.knots] for of in part.of]
            sizes = [z.shape[-1] for z in given]
            return lambda w: part.rows_at(k, *w.split(sizes, dim=-1)), torch.cat(given, dim=-1)
        if _by_position(part):
            at: Any = part.position  # type: ignore[attr-defined]
            before, after = X[..., : at.start], X[..., at.stop :]
            return lambda w: part.value(torch.cat((before, w, after), dim=-1), U), X[..., at]
        return lambda w: part.value(w[..., :n], w[:, :-1, n:]), joined(X, U)


def joined(X: Tensor, U: Tensor) -> Tensor:
    """z = [x, u] of all knots (b, N+1, S), with zeros for the controls of the last one."""
    return torch.cat((X, torch.nn.functional.pad(U, (0, 0, 0, 1))), dim=-1)


def groups_of(problem: Problem) -> tuple[Group, ...]:
    """The constraints of a problem in the order of their rows."""
    found, first = [], 0
    for number, (part, (K, p)) in enumerate(zip(problem.constraints, problem.row_shapes, strict=True)):
        knots = part.knots if p > 0 else slice(0, 0)
        place = Place(first, K if p > 0 else 0, p, knots, _columns(part, problem))
        group = Group(part, number, place)
        if place.K > 0:
            if not group.is_bound:
                group = replace(group, expansion=_expansion(group, problem))
            found.append(group)
        first += K * p
    return tuple(found)


def _expansion(group: Group, problem: Problem) -> Expansion:
    one = problem.take(slice(0, 1))
    part = group.part.take(slice(0, 1))
    function, w = replace(group, part=part)._function(*one.at_rest)
    return expansion_of(function, w)


def is_function(part: Constraint) -> bool:
    """Whether rows are a function of their own knot's x, u or both."""
    return isinstance(part, FunctionConstraint) and type(part).value is FunctionConstraint.value


def _by_position(part: Constraint) -> bool:
    """Whether rows are of a kind that reads nothing but the position."""
    return isinstance(part, OwnKind) and not is_users(part)


def _columns(part: Constraint, problem: Problem) -> slice:
    n, S = problem.n, problem.n + problem.m
    if is_function(part):
        return {"x": slice(0, n), "u": slice(n, S), "xu": slice(0, S)}[part.of]  # type: ignore[attr-defined]
    return part.position if _by_position(part) else slice(0, S)  # type: ignore[attr-defined]


def _block(knots: slice | Tensor, columns: slice | Tensor) -> tuple[Any, Any]:
    """An index of knots and columns; two tensors are crossed."""
    if isinstance(knots, Tensor) and isinstance(columns, Tensor):
        return knots.unsqueeze(-1), columns
    return knots, columns


def _square(knots: slice | Tensor, columns: slice) -> tuple[Any, Any, Any]:
    """An index of knots and of blocks of columns by columns."""
    return knots, columns, columns
