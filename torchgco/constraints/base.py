"""Constraint = a function, a sense, and the knots at which it holds. c <= 0 (or c = 0) is feasible."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.autodiff import jacobian
from torchgco.base.errors import InputError, shown, undefined
from torchgco.base.numbers import Number, numbers_of_fields
from torchgco.base.options import check_options
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import PerElement, is_users, passed_on
from torchgco.base.values import bound_values, taken_by
from torchgco.constraints.carried import Carried
from torchgco.costs.base import add_first, add_slopes

CONTACT_FACTOR = 0.95  # bodies touch at this share of r_obs + r_veh; planners keep the full distance (Table 3)
TOUCH = 1.0 - CONTACT_FACTOR  # the same, as a share beneath the full surface
ADMITTED = 1e-3  # m: the violation up to which solvers and judge call a trajectory feasible, unless options say else

NO_ROW = -1.0  # the row of a bound that one problem of a batch doesn't have

Sense = Literal["inequality", "equality"]
Knots = slice | Sequence[int] | Tensor


@dataclass(frozen=True)
class Lowered:
    """The numbers of a constraint's rows as kernels in C read them, by the names of `native/structures.py`."""

    by_knot: Mapping[str, Tensor]  # (B|1, K|1, ...)
    by_problem: Mapping[str, Tensor] = field(default_factory=dict)  # (B, ...)
    plain: Mapping[str, Any] = field(default_factory=dict)  # numbers, and tensors that aren't copied


class Constraint(PerElement):
    """Rows c (B, K, p) at K knots of a trajectory.

    `geometric` marks constraints on the position: sampling counts their violations as collisions, and guidance looks
    among them for rows that cancel each other (F_k of Equation 53).
    """

    sense: Sense = "inequality"
    geometric: bool = False
    knots: Any  # a slice, or an int64 tensor (K,), once bound
    is_goal: ClassVar[bool] = False  # whether it is the row of a required goal
    says_where: ClassVar[bool] = False  # whether it says where to be, not how fast
    in_place: ClassVar[bool] = False  # whether it finds its states and controls where others follow them
    joins_knots: ClassVar[bool] = False  # whether its rows are of two knots
    on_its_way: ClassVar[bool] = False  # whether rows are kept between knots, too
    tightened: ClassVar[Any] = None  # a method, where rows within stages can move to where they are violated

    @property
    def bare(self) -> Constraint:
        """The user's constraint behind a solver's wrapper; itself if it isn't wrapped."""
        return self

    @property
    def row_radii(self) -> Tensor | None:
        """Of rows s (|v|^2 - r^2) / (2 r) with `violation` s (|v| - r), s = 1 or -1: s r (B|1, K|1, p); else None.

        Kernels in C turn such rows into violations themselves.
        """
        return None

    def bind(self, dims: Dimensions) -> Self:
        """The constraint checked and shaped for one problem; called once, by Problem."""
        raise undefined(self, "bind")

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        """c (B, K, p) along X (B, N+1, n), U (B, N, m)."""
        raise undefined(self, "value")

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        """Add sum_i g_i dc_i and sum_i h_i dc_i' dc_i (Gauss-Newton) to H (B, N+1, s, s); g, h are (B, K, p).

        By default PyTorch differentiates `value`, whose rows read the state and the control of their own knot alone.
        """
        n, z = X.shape[-1], torch.cat((X, pad(U, (0, 0, 0, 1))), dim=-1)
        (slopes,) = jacobian(lambda z: self.value(z[..., :n], z[:, :-1, n:]), z)
        add_slopes(H, self.knots, n, g, h, slopes[..., :n], slopes[..., n:])

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """By how much each row is violated, (B, K, p) >= 0: lengths in metres, all else in the units of c."""
        c = self.value(X, U)
        return c.abs() if self.sense == "equality" else c.clamp(min=0.0)

    def worst(self, X: Tensor, U: Tensor) -> Tensor:
        """The largest violation of each problem, (B,); 0 for a constraint without rows."""
        rows = self.violation(X, U).flatten(1)
        return rows.amax(-1) if rows.shape[1] > 0 else rows.new_zeros(rows.shape[0])

    def at(self, x: Tensor, k: int) -> Tensor:
        """Rows (B, S, p) for samples x (B, S, n) of one knot; geometric constraints only."""
        raise undefined(self, "at")

    def row_shape(self, N: int) -> tuple[int, int] | None:
        """Knots and rows for N stages, where they are known without evaluating the rows."""
        return None

    def holds_at(self, k: int) -> bool:
        """Whether the constraint applies to knot k."""
        if isinstance(self.knots, slice):
            return self.knots.start <= k < self.knots.stop
        return bool((self.knots == k).any())

    def numbers(self, where: str, index: int) -> list[Number]:
        """Its numbers, which a compiled problem writes; `where` it is in the problem, such as "constraints[1]"."""
        return numbers_of_fields(self, where, index)

    @property
    def kernel(self) -> str:
        """Which code in C computes the rows: "bounds", "spheres", ...; "function": that of a trace."""
        return "function"

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        """The numbers for that code, of a problem with n states.

        Args:
            others: the same obstacles of a body's other balls, whose rows follow these.
        """
        raise undefined(self, "lowered")

    @property
    def in_metres(self) -> bool:
        """Whether violations are lengths."""
        return self.geometric

    def row_sizes(self, at_rest: Tensor, along: Tensor) -> Tensor:
        """Sizes (B, 1, p) of rows with these values (B, K, p) at rest, and along a trajectory, by their largest value.

        Of equalities at rest alone: along a trajectory they are met.
        """
        sizes = at_rest.abs().amax(1, keepdim=True)
        return sizes if self.sense == "equality" else torch.maximum(sizes, along.abs().amax(1, keepdim=True))

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        """A row at a knot in words."""
        return f"row {row}"

    def by_obstacle(self, rows: Tensor) -> Tensor:
        """Of each obstacle whether any of its rows (..., p) is marked; of each row, where each has its own."""
        return rows

    def remade(self) -> Constraint:
        """The same with what is computed from its numbers as they are now."""
        return self

    def carries(self, x0: Tensor, N: int) -> Carried:
        """What rows of two knots need of the earlier one, in problems of N stages that start at x0 (B, n)."""
        raise undefined(self, "carries")

    def with_carried(self, first: int) -> Constraint:
        """The same rows as those of one knot, where what is carried are the states from `first` on."""
        raise undefined(self, "with_carried")

    def with_more(self, n: int, m: int) -> Constraint:
        """The same rows in a form of the problem with further states and controls after the first n and m."""
        return self if self.in_place and not is_users(self) else FirstRows(self, n, m)

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        """The same where state n is the factor of time, followed by controls, and `later` factors are to be chosen."""
        return self if self.in_place and not is_users(self) else FirstRowsInTime(self, n, m)

    def at_factor(self, factor: Tensor) -> Constraint:
        """The same of a form `in_free_time` whose factor (B,) is held."""
        return self

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        """The same in a form where states are held after each problem's last knot, `horizon` (B,).

        Args:
            counts: at which of its knots rows count, (B, K), 1 or 0; those of knot N may stand for the last knot.
            where: the constraint's name in errors.

        Raises:
            InputError: a constraint that can't end early.
        """
        return CountedRows(self, counts)

    def grown(self, by: Tensor) -> Self:
        """The same constraint with more distance from its obstacles by `by` (B,), m; itself where it keeps none."""
        return self

    def later(self, t: float) -> Self:
        """The same constraint for a problem that starts t seconds later: moving obstacles have moved."""
        return self

    def start_is_clear(self, x0: Tensor) -> Tensor:
        """Whether the constraint admits a start at x0 (B, n), (B,) bool."""
        return torch.ones(x0.shape[0], dtype=torch.bool, device=x0.device)

    def on_the_way(self, X: Tensor) -> Tensor | None:
        """Points (B, K, P, d) of states X (B, K, n) whose way between the knots counts, too; None without any."""
        return None


class Distance(Constraint):
    """A constraint that keeps bodies apart: obstacles, and positions that keep a distance from each other.

    P places of a state, points (B, K, P, d) or vectors between two of them, keep distances from M surfaces each.
    """

    on_its_way: ClassVar[bool] = True
    contact_depths: Any  # (B, P M): how deep beneath the full surfaces bodies touch, m

    def places(self, X: Tensor) -> Tensor:
        """The places (B, K, P, d), m, of states X (B, K, n)."""
        raise undefined(self, "places")

    def on_the_way(self, X: Tensor) -> Tensor:
        return self.places(X)

    def even_bulge(self, X: Tensor) -> Tensor:
        """How far places leave their straight lines, m, (B|1, K-1|1, P), where states X (B, K, n) change evenly."""
        return X.new_zeros(1, 1, 1)

    def measured(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Distances of states X (B, K, n), k dt apart, as the judge and the certificate take them, m.

        At each state, (B, K, P M), and lower bounds along the straight ways of places between them, (B, K - 1, P M),
        from the full surfaces: see `obstacles/measured.py`.
        """
        raise undefined(self, "measured")

    def clearances(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """The smallest of these (B,) to where bodies touch: at the states, and there and between; infinite without."""
        at_knots, between = (least(gap + self.contact_depths.unsqueeze(1)) for gap in self.measured(X))
        return at_knots, torch.minimum(at_knots, between)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        """Smallest distance (B,) of the straight lines between knots from where bodies touch, m; negative in contact.

        As solvers measure it. Counted from a `share` of the margin beneath the full surface, by default from where
        bodies touch; infinite where there is no obstacle.
        """
        raise undefined(self, "chord_clearance")

    def in_pieces(self, count: int) -> Self:
        """The same for states at the ends of `count` pieces of each stage."""
        return self


def least(distances: Tensor) -> Tensor:
    """The smallest of distances (B, K, M) per problem, (B,); infinite where there is none."""
    if distances.shape[1] == 0 or distances.shape[2] == 0:
        return distances.new_full(distances.shape[:1], torch.inf)
    return distances.flatten(1).amin(-1)


@dataclass(frozen=True)
class WrappedConstraint(Constraint):
    """A constraint with kind and knots of another one, in a form of the problem with other rows."""

    constraint: Constraint

    keeps_rows: ClassVar[bool] = False  # whether rows, and by how much they are violated, are those of the other one

    sense, geometric, knots = passed_on("constraint", "sense", "geometric", "knots")
    bare, row_radii, start_is_clear = passed_on("constraint", "bare", "row_radii", "start_is_clear")
    calls_function = property(lambda self: is_users(self.constraint))

    def grown(self, by: Tensor) -> Self:
        return replace(self, constraint=self.constraint.grown(by))


@dataclass(frozen=True)
class FirstRows(WrappedConstraint):
    """A constraint on the first n states and m controls."""

    n: int
    m: int

    batched: ClassVar[tuple[str, ...]] = ("constraint",)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.value(X[..., : self.n], U[..., : self.m])

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.violation(X[..., : self.n], U[..., : self.m])

    def at(self, x: Tensor, k: int) -> Tensor:
        return self.constraint.at(x[..., : self.n], k)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        X_own, U_own = X[..., : self.n], U[..., : self.m]
        add_first(H, X, self.n, self.m, lambda blocks: self.constraint.accumulate(X_own, U_own, g, h, blocks))

    def start_is_clear(self, x0: Tensor) -> Tensor:
        return self.constraint.start_is_clear(x0[:, : self.n])


class FirstRowsInTime(FirstRows):
    """Rows of the first states and controls that kernels in C measure, too."""

    keeps_rows: ClassVar[bool] = True


@dataclass(frozen=True)
class CountedRows(WrappedConstraint):
    """A constraint whose rows count at some of its knots."""

    counts: Tensor  # (B, K): 1 where they count, else 0

    batched: ClassVar[tuple[str, ...]] = ("constraint", "counts")

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._where(self.constraint.value(X, U), 0.0 if self.sense == "equality" else NO_ROW)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self._where(self.constraint.violation(X, U), 0.0)

    def at(self, x: Tensor, k: int) -> Tensor:
        rows, knots = self.constraint.at(x, k), self.knots
        index = k - knots.start if isinstance(knots, slice) else knots.tolist().index(k)
        return torch.where(self.counts[:, index, None, None] > 0, rows, NO_ROW)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        self.constraint.accumulate(X, U, self._where(g, 0.0), self._where(h, 0.0), H)

    def _where(self, rows: Tensor, other: float) -> Tensor:
        return torch.where(self.counts.unsqueeze(-1) > 0, rows, other)


def count_of(index: slice | Tensor, of: int) -> int:
    """How many of `of` things a slice or indices take."""
    return len(range(of)[index]) if isinstance(index, slice) else len(index)


def resolve_knots(knots: Knots | None, last: int, field: str, device: torch.device, first: int = 1) -> slice | Tensor:
    """Knots as a slice where they are contiguous, else as indices; negative ones count from the end. None: first..last.

    Raises:
        InputError: no knot, a repeated knot, a knot that is no whole number or outside 0..last.
    """
    knots = slice(first, last + 1) if knots is None else knots
    try:
        chosen = list(range(last + 1)[knots]) if isinstance(knots, slice) else [whole(k) for k in knots]
    except (TypeError, ValueError):
        raise InputError(field, "a slice, or a list of whole numbers", shown(knots)) from None
    if not isinstance(knots, slice):
        if any(not -last - 1 <= k <= last for k in chosen):
            raise InputError(field, f"knots within 0..{last}", chosen)
        chosen = [k % (last + 1) for k in chosen]
    if not chosen or len(set(chosen)) != len(chosen):
        raise InputError(field, "at least one knot, none twice", chosen)
    if chosen == list(range(chosen[0], chosen[-1] + 1)):
        return slice(chosen[0], chosen[-1] + 1)
    return torch.tensor(chosen, device=device)


def whole(k: Any) -> int:
    """An int, or an integer of NumPy or PyTorch; TypeError for all else, a mask's True among it."""
    if isinstance(k, bool) or (isinstance(k, Tensor) and k.dtype == torch.bool):
        raise TypeError
    return operator.index(k)


@dataclass(frozen=True)
class FunctionConstraint(Constraint):
    """A constraint given as a function; derivatives by `torch.func`.

    `of` says what the function takes: "x" for function(x), "u" for function(u), "xu" for function(x, u). It maps
    (..., n), (..., m) to rows (..., p). Default knots: 1..N for "x" (x_0 is given), 0..N-1 otherwise.

        near = FunctionConstraint(
            lambda x, goal, k: (x[..., :2] - goal).square().sum(-1, keepdim=True) - sizes[k],  # sizes (N+1, 1)
            values={"goal": goals},  # (B, 2)
        )

    The function may take an argument k (without a default), the numbers (K,) of the knots of x (B, K, n). `values` are
    numbers per problem by name, (B, ...), `knot_values` numbers per problem and knot, (B|1, N+1, ...); the function
    takes them as arguments of these names, shaped to fit x. Numbers that change from solve to solve belong there, or in
    captured tensors: with another captured Python number the code is compiled again.

    Raises:
        InputError: on `Problem(...)`: bad sense, knots, or `of`; values of another shape or that the function doesn't
            take; a function that doesn't return (..., p).
    """

    function: Callable[..., Tensor]
    sense: Sense = "inequality"
    knots: Any = None
    of: Literal["x", "u", "xu"] = "x"
    geometric: bool = False
    name: str = "constraint"
    values: Any = None
    knot_values: Any = None

    batched: ClassVar[tuple[str, ...]] = ("values",)
    calls_function: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, self.name if isinstance(self.name, str) else "constraint")
        if self.geometric and self.of != "x":
            raise InputError(f"{self.name}.geometric", "a function of x alone", f"of={self.of!r}")
        last, first = (dims.N, 1) if self.of == "x" else (dims.N - 1, 0)
        knots = resolve_knots(self.knots, last, f"{self.name}.knots", dims.like.device, first)
        if not callable(self.function):
            raise InputError(f"{self.name}.function", f"a function of {' and '.join(self.of)}", shown(self.function))
        values = bound_values(self.values, self.knot_values, (self.function,), dims, self.name)
        return replace(self, knots=knots, values=values)

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        knots = torch.arange(N + 1, device=horizon.device)[self.knots]
        stands = (counts > 0) & (knots == N) & (horizon < N).unsqueeze(-1)
        if not bool(stands.any()):
            return CountedRows(self, counts)
        if taken_by(self.function).knot:
            expected = "a function without an argument k at the last knots: `knot_values` serve"
            raise InputError("horizon", expected, f"one with it in {where}")
        return CountedRows(replace(self, values=self.values.ending_at(horizon)), counts)

    @property
    def reads_knots(self) -> bool:
        """Whether the function takes the number of the knot, or values of it."""
        return bool(self.values.knot_names) or taken_by(self.function).knot

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._along(X)(*self._arguments(X, U))

    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        """Rows (B, K, p) for the arguments (B, K, n|m) of the function at knots k (K,), or all at one knot."""
        return self.values.call(self.function, *arguments, k=k)

    def _along(self, X: Tensor) -> Callable[..., Tensor]:
        k = torch.arange(X.shape[1], device=X.device)[self.knots]
        return lambda *z: self.rows_at(k, *z)

    def at(self, x: Tensor, k: int) -> Tensor:
        return self.rows_at(k, x)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        parts = dict(zip(self.of, jacobian(self._along(X), *self._arguments(X, U)), strict=True))
        add_slopes(H, self.knots, X.shape[-1], g, h, parts.get("x"), parts.get("u"))

    def _arguments(self, X: Tensor, U: Tensor) -> tuple[Tensor, ...]:
        return tuple((X if a == "x" else U)[:, self.knots] for a in self.of)
