"""What the families of `general_problems` are made of: draws by seed, end states, free time, obstacles off the ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

import torch
from torch import Tensor

from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, Problem, QuadraticCost, StateBounds

D, INF = torch.float64, inf
Field = Callable[..., Tensor]


class Draws:
    """Numbers for the problems of a batch, always the same under a seed."""

    def __init__(self, B: int, seed: int) -> None:
        self.B, self._generator = B, torch.Generator("cpu").manual_seed(seed)

    def shared(self, low: float | Sequence[float], high: float | Sequence[float], *shape: int) -> Tensor:
        """Uniform draws (*shape), the same for all problems; bounds per column as lists."""
        a, b = torch.as_tensor(low, dtype=D), torch.as_tensor(high, dtype=D)
        share = torch.rand(*shape, *a.shape, dtype=D, generator=self._generator, device="cpu")
        return a + (b - a) * share.to(a.device)

    def __call__(self, low: float | Sequence[float], high: float | Sequence[float], *shape: int) -> Tensor:
        """Uniform draws per problem, (B, *shape), and one more axis where the bounds are lists."""
        return self.shared(low, high, self.B, *shape)

    def states(self, *columns: Tensor | float) -> Tensor:
        """States (B, n) from their columns: numbers, or one per problem."""
        return torch.stack([torch.as_tensor(c, dtype=D).expand(self.B) for c in columns], dim=-1)


@dataclass(frozen=True)
class Drawn:
    """A batch of problems, and states (B, n) near its ends: where a straight line in states would lead to."""

    problem: Problem
    end: Tensor


@dataclass(frozen=True)
class Family:
    """Problems of one kind.

    Args:
        name: of the family.
        set: 1 classics, 2 obstacles, 3 constraints, 4 scale.
        B: problems per seed.
        make: draws the problems.
        known: the optimum of a problem as published or in closed form, (B,), NaN where unknown.
    """

    name: str
    set: int
    B: int
    make: Callable[[Draws], Drawn]
    known: Callable[[Problem], Tensor] | None = None

    def drawn(self, seed: int) -> Drawn:
        return self.make(Draws(self.B, seed))

    def problem(self, seed: int) -> Problem:
        return self.drawn(seed).problem


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def limits(*values: float) -> StateBounds:
    """|x_i| <= values[i]; infinity means unbounded."""
    return StateBounds([-value for value in values], list(values))


def effort(dt: float, *weights: float, around: Sequence[float] | None = None) -> FunctionCost:
    """dt sum_i w_i (u_i - around_i)^2 per stage."""
    weight, rest = numbers(*weights), numbers(*(around or [0.0] * len(weights)))
    return FunctionCost(lambda x, u: dt * (weight * (u - rest).square()).sum(-1))


def toward(
    end: Tensor, Q: Sequence[float], R: Sequence[float], Qf: Sequence[float], u_ref: Sequence[float] | float = 0.0
) -> QuadraticCost:
    """A quadratic cost around states (B, n), one per problem."""
    return QuadraticCost(list(Q), list(R), list(Qf), x_ref=end.unsqueeze(1), u_ref=u_ref)


def ends_at(goal: Tensor, states: slice = slice(None)) -> FunctionConstraint:
    """These states of the last knot are those of the goal (B, n)."""
    rows = lambda x, goal: x[..., states] - goal[..., states]
    return FunctionConstraint(rows, "equality", [-1], name="end", values={"goal": goal})


def stacked(*components: Tensor) -> Tensor:
    return torch.stack(components, dim=-1)


def rk4(rates: Callable[[Tensor], Tensor], x: Tensor, dt: Tensor | float) -> Tensor:
    """A step of Runge and Kutta, whose length may be a control."""
    k1 = rates(x)
    k2 = rates(x + 0.5 * dt * k1)
    k3 = rates(x + 0.5 * dt * k2)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(x + dt * k3))


def with_free_time(field: Field, n: int, m: int, h: float, position: slice | None = None) -> FunctionDynamics:
    """Stages of h exp(w) seconds, where w is the last control: to be bounded, as long steps would be exploited."""

    def step(x: Tensor, u: Tensor) -> Tensor:
        return rk4(lambda at: field(at, u), x, h * u[..., -1:].exp())

    return FunctionDynamics(step, n, m, h, "none", position)


def least_time(h: float) -> FunctionCost:
    """The time of stages of h exp(w); small terms keep stages alike, and controls small, where the time doesn't."""
    alike = lambda u: 1e-3 * u[..., -1].square() + 1e-5 * u[..., :-1].square().sum(-1)
    return FunctionCost(lambda x, u: h * (u[..., -1].exp() + alike(u)))


def balls(
    draw: Draws,
    count: int,
    box: tuple[list[float], list[float]],
    sizes: tuple[float, float],
    body: float,
    *ends: Tensor,
) -> tuple[Tensor, Tensor]:
    """Centres (B, count, d) within a box and radii (B, count), smaller near the ends (B, d), absent on top of them.

    Args:
        box: its lowest and its highest corner, m.
        sizes: least and largest radius, m.
        body: radius of the vehicle, which keeps a fifth of a metre free at its ends.
    """
    centers, radii = draw(*box, count), draw(*sizes, count)
    for end in ends:
        radii = torch.minimum(radii, (centers - end.unsqueeze(1)).norm(dim=-1) - body - 0.2)
    gone = radii < 0.3 * sizes[0]
    return centers.masked_fill(gone.unsqueeze(-1), torch.nan), radii.masked_fill(gone, torch.nan)
