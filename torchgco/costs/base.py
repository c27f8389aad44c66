"""Cost of a trajectory, and its quadratic expansion. An own cost is a subclass of `Cost`, or functions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.autodiff import gradient_and_hessian
from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Number, numbers_of_fields
from torchgco.base.shapes import Dimensions, lead
from torchgco.base.tree import PerElement, is_users, passed_on
from torchgco.base.values import bound_values, taken_by, whole_numbers_become


class Cost(PerElement):
    """J_var = terminal(x_N) + sum_k stage(x_k, u_k, k).

    A subclass defines `stage` and `terminal` on any leading axes, and no other sum of them; derivatives are exact
    unless it overrides `expand` too. A Hessian that isn't positive semidefinite is handled by the solver's
    regularisation.

    On a CPU the code is traced and compiled (`torchgco.native`). Values that differ between problems (`batched`,
    `per_element`) or between stages (indexed with k or computed from it) become inputs of the compiled code. A cost
    that branches on the values of x, u or k is evaluated by PyTorch, and a warning names it; one that joins several
    knots is refused.
    """

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        """Cost (...) of stage k for x (..., n), u (..., m).

        k is a number where all rows belong to one stage, or arange(N) where x is (B, N, n).
        """
        raise NotImplementedError(f"{type(self).__name__} defines no stage cost")

    def terminal(self, x: Tensor) -> Tensor:
        """Cost (...) of the last knot for x (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} defines no terminal cost")

    def bind(self, dims: Dimensions) -> Self:
        """The cost checked and shaped for one problem; called once, by Problem."""
        return self

    def rest_controls(self, like: Tensor) -> Tensor:
        """Controls (B, N, m) at rest, shaped as `like`: the references of a quadratic cost, else zero."""
        return torch.zeros_like(like)

    def goal(self, x0: Tensor) -> Tensor | None:
        """The state (B, n) that the terminal cost asks for, for starts x0 (B, n); None where it isn't known."""
        return None

    def scaled(self, factor: Tensor) -> Cost:
        """The same cost times `factor` (B,), one positive number per problem."""
        return ScaledCost(self, factor)

    def numbers(self, where: str) -> list[Number]:
        """Its numbers, which a compiled problem writes; `where` it is in the problem: "cost"."""
        return numbers_of_fields(self, where, where)

    def by_knot(self, N: int) -> Self:
        """The same, with memory for the numbers of each of N stages that may be written."""
        return self

    @property
    def kernel(self) -> str:
        """Which code in C computes it: "quadratic", or "function": that of a trace."""
        return "function"

    def names_by_stage(self) -> set[str]:
        """The names of its numbers that differ from stage to stage."""
        return set()

    def with_more(self, n: int, r: int) -> Cost:
        """The same cost in a form of the problem with r further states after the first n."""
        return FirstStates(self, n) if type(self).expand is Cost.expand else OwnExpansion(self, n)

    @property
    def reads_knots(self) -> bool:
        """Whether the cost of a stage may depend on its number."""
        return True

    def precision(self, dtype: torch.dtype) -> AbstractContextManager[None]:
        """In which the cost is evaluated: PyTorch's default one is changed for whole numbers, such as k."""
        return whole_numbers_become(dtype) if self.reads_knots else nullcontext()

    def total(self, X: Tensor, U: Tensor) -> Tensor:
        """J_var (B,) of trajectories X (B, N+1, n), U (B, N, m)."""
        k = torch.arange(U.shape[1], device=U.device)
        with self.precision(X.dtype):
            return self.stage(X[:, :-1], U, k).sum(-1) + self.terminal(X[:, -1])

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        """Write gradient and Hessian at X, U into the homogeneous blocks H (B, N+1, s, s), order [x, 1, u]."""
        n, N = X.shape[-1], U.shape[1]
        H.zero_()
        k, z = torch.arange(N, device=U.device), torch.cat((X[:, :-1], U), dim=-1)
        with self.precision(X.dtype):
            g, h = gradient_and_hessian(lambda z: self.stage(z[..., :n], z[..., n:], k), z)
            last = gradient_and_hessian(self.terminal, X[:, -1])
        add_blocks(H[:, :-1], n, g[..., :n], g[..., n:], h[..., :n, :n], h[..., n:, n:], h[..., n:, :n])
        g, h = last
        add_blocks(H[:, -1], n, g, None, h, None)


@dataclass(frozen=True)
class WrappedCost(Cost):
    """A cost with the goal and the controls at rest of another one."""

    cost: Cost

    calls_function = property(lambda self: is_users(self.cost))
    reads_knots, rest_controls, goal = passed_on("cost", "reads_knots", "rest_controls", "goal")


@dataclass(frozen=True)
class ScaledCost(WrappedCost):
    """A cost times one positive number per problem."""

    factor: Tensor  # (B,)

    batched: ClassVar[tuple[str, ...]] = ("cost", "factor")

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        value = self.cost.stage(x, u, k)
        return lead(self.factor, value) * value

    def terminal(self, x: Tensor) -> Tensor:
        value = self.cost.terminal(x)
        return lead(self.factor, value) * value

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        self.cost.expand(X, U, H)
        H.mul_(self.factor.view(-1, 1, 1, 1))


@dataclass(frozen=True)
class ShiftedCost(WrappedCost):
    """A cost less one number per problem and stage."""

    shift: Tensor  # (B,)

    batched: ClassVar[tuple[str, ...]] = ("cost", "shift")

    terminal, expand = passed_on("cost", "terminal", "expand")

    def scaled(self, factor: Tensor) -> ShiftedCost:
        return ShiftedCost(self.cost.scaled(factor), self.shift * factor)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        value = self.cost.stage(x, u, k)
        return value - lead(self.shift, value)


def add_blocks(
    H: Tensor,
    n: int,
    lx: Tensor | None,
    lu: Tensor | None,
    lxx: Tensor | None,
    luu: Tensor | None,
    lux: Tensor | None = None,
) -> None:
    """Add the blocks of a quadratic model to homogeneous blocks H (..., s, s) with z = [x, 1, u], in place."""
    if lx is not None:
        H[..., :n, n] += lx
        H[..., n, :n] += lx
    if lu is not None:
        H[..., n + 1 :, n] += lu
        H[..., n, n + 1 :] += lu
    if lxx is not None:
        H[..., :n, :n] += lxx
    if luu is not None:
        H[..., n + 1 :, n + 1 :] += luu
    if lux is not None:
        H[..., n + 1 :, :n] += lux
        H[..., :n, n + 1 :] += lux.mT


def add_slopes(H: Tensor, knots: Any, n: int, g: Tensor, h: Tensor, cx: Tensor | None, cu: Tensor | None) -> None:
    """Add g' dc and dc' h dc (g, h (B, K, p)) of rows with slopes cx (B, K, p, n), cu (B, K, p, m), or none, to H."""
    add = H.new_zeros(*g.shape[:2], *H.shape[2:])

    def gradient(c: Tensor | None) -> Tensor | None:
        return None if c is None else (g.unsqueeze(-2) @ c).squeeze(-2)

    def product(a: Tensor | None, b: Tensor | None) -> Tensor | None:
        return None if a is None or b is None else (h.unsqueeze(-1) * a).mT @ b

    add_blocks(add, n, gradient(cx), gradient(cu), product(cx, cx), product(cu, cu), product(cu, cx))
    H[:, knots] += add


@dataclass(frozen=True)
class FirstStates(WrappedCost):
    """A cost of the first n states."""

    n: int

    batched: ClassVar[tuple[str, ...]] = ("cost",)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self.cost.stage(x[..., : self.n], u, k)

    def terminal(self, x: Tensor) -> Tensor:
        return self.cost.terminal(x[..., : self.n])

    def goal(self, x0: Tensor) -> None:
        """The problem has its goal already."""


class OwnExpansion(FirstStates):
    """Where the cost has its own `expand`."""

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        H.zero_()
        add_first(H, X, self.n, U.shape[-1], lambda blocks: self.cost.expand(X[..., : self.n], U, blocks))


def add_at(H: Tensor, knots: Any, span: slice, n: int, gradient: Tensor, hessian: Tensor) -> None:
    """Add gradients (B, K, c) and Hessians (B, K, c, c) of components `span` to homogeneous blocks H of n states."""
    H[:, knots, span, n] += gradient
    H[:, knots, n, span] += gradient
    H[:, knots, span, span] += hessian


def add_first(H: Tensor, X: Tensor, n: int, m: int, write: Callable[[Tensor], None]) -> None:
    """Add homogeneous blocks of the first n states and m controls, which `write` fills, to H, of all states X."""
    blocks = H.new_zeros(*H.shape[:2], n + 1 + m, n + 1 + m)
    write(blocks)
    count = X.shape[-1]
    index = torch.tensor([*range(n), *range(count, count + 1 + m)], device=H.device)
    H[..., index.unsqueeze(-1), index] += blocks


@dataclass(frozen=True)
class FunctionCost(Cost):
    """A cost given as functions; derivatives by PyTorch.

        cost = FunctionCost(
            lambda x, u, goal: (x[..., :2] - goal).square().sum(-1) + 0.1 * u.square().sum(-1),
            lambda x, goal: 50.0 * (x[..., :2] - goal).square().sum(-1),
            values={"goal": goals},  # (B, 2)
        )

    Numbers that change from solve to solve belong into `values`, or in captured tensors: with another captured Python
    number the code is compiled again. A solver looks for paths among obstacles only where it knows the goal: pass
    `goal` to `Problem`.

    Args:
        stage_function: function(x, u) of (..., n), (..., m) to costs (...); may take an argument k (without a
            default), the number of the stage, or arange(N) where x is (B, N, n).
        terminal_function: function(x) of the last knot to costs (...), which may take k = N; None: no terminal cost.
        values: numbers per problem by name, (B, ...), which the functions take as arguments of these names, shaped to
            fit x: (B, ...), or (B, 1, ...) where x has an axis of knots or samples.
        knot_values: the same per knot, (B|1, N+1, ...); a function sees the rows of its knots.

    Raises:
        InputError: on `Problem(...)`: no functions, values of another shape or that no function takes; costs of another
            shape, that depend on other problems, or whose derivatives are wrong.
    """

    stage_function: Callable[..., Tensor]
    terminal_function: Callable[..., Tensor] | None = None
    values: Any = None
    knot_values: Any = None

    batched: ClassVar[tuple[str, ...]] = ("values",)
    calls_function: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        if not callable(self.stage_function):
            raise InputError("cost.stage_function", "a function of x and u", shown(self.stage_function))
        if self.terminal_function is not None and not callable(self.terminal_function):
            raise InputError("cost.terminal_function", "a function of x, or None", shown(self.terminal_function))
        functions = self.stage_function, self.terminal_function
        return replace(self, values=bound_values(self.values, self.knot_values, functions, dims, "cost"))

    @property
    def reads_knots(self) -> bool:
        """Whether the cost of a stage takes its number, or values of it."""
        return bool(self.values.knot_names) or taken_by(self.stage_function).knot

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self.values.call(self.stage_function, x, u, k=k)

    def terminal(self, x: Tensor) -> Tensor:
        if self.terminal_function is None:
            return x.new_zeros(x.shape[:-1])
        return self.values.call(self.terminal_function, x, k=self.values.stages)

    def names_by_stage(self) -> set[str]:
        return set(self.values.knot_names)
