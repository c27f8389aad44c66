"""Vehicles that move at the same time and keep apart: what a fleet is, and what is wrong with one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import tensor
from torchgco.constraints.base import CONTACT_FACTOR, whole
from torchgco.fleets.merged import merged
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Fleet:
    """Vehicles that move at the same time, among the same or other obstacles, and keep a distance from each other.

        torchgco.solve(Fleet([to_the_right, to_the_left], apart=0.4))

    As with obstacles, two vehicles touch at 0.95 of their distance, and keep all of it at the knots.

    Args:
        vehicles: a problem per vehicle, each a batch of B: B fleets, with problem b of each vehicle in fleet b. Or one
            problem, a batch whose problems are the vehicles of a single fleet. All have the same N and dt; models,
            costs and constraints may differ.
        apart: the distance that centres keep, one number or (Q,), one for each of the `pairs`, above 0 m: for vehicles
            that are balls the sum of two radii.
        pairs: which vehicles keep it, (Q, 2) whole numbers; None: all, in the order (0, 1), (0, 2), ..., (1, 2), ...

    Raises:
        InputError: fewer than two vehicles, another N, dt, batch or dimension of space, problems that aren't float64 on
            the CPU, a free time, a horizon or free starts, pairs of unknown vehicles or given twice, distances that
            aren't above 0.
    """

    vehicles: Sequence[Problem] | Problem
    apart: Any
    pairs: Any = None
    members: tuple[Problem, ...] = field(init=False, repr=False)  # a problem per vehicle, (B,) each
    # Problems of those that are alike as one batch, (vehicles, B) after each other, and whose they are.
    forms: tuple[tuple[Problem, tuple[int, ...]], ...] = field(init=False, repr=False)
    distances: Tensor = field(init=False, repr=False)  # (V, V), m; 0 of pairs that keep none

    def __post_init__(self) -> None:
        members = _members(self.vehicles)
        pairs = _pairs(self.pairs, len(members))
        apart = _distances(self.apart, pairs, len(members), members[0].x0)
        for name, part in {"members": members, "distances": apart}.items():
            object.__setattr__(self, name, part)
        forms = ((self.vehicles, tuple(range(len(members)))),) if isinstance(self.vehicles, Problem) else ()
        object.__setattr__(self, "forms", forms or _forms(members))

    @property
    def B(self) -> int:
        """How many fleets."""
        return self.members[0].B

    @property
    def V(self) -> int:
        """How many vehicles each has."""
        return len(self.members)

    @property
    def N(self) -> int:
        return self.members[0].N

    @property
    def dt(self) -> float:
        return float(self.members[0].dynamics.dt)

    @property
    def states(self) -> int:
        """States of all vehicles together."""
        return sum(one.n for one in self.members)

    @property
    def pairs_kept(self) -> tuple[Tensor, Tensor]:
        """Both vehicles of the Q pairs that keep a distance, the first below the second, (Q,) each."""
        first, second = self.distances.triu().nonzero(as_tuple=True)
        return first, second

    @property
    def start_is_apart(self) -> Tensor:
        """Which vehicles start without touching another that they keep a distance from, (B, V) bool."""
        p = self.places([one.x0.unsqueeze(1) for one in self.members])[:, :, 0]
        gap = (p.unsqueeze(1) - p.unsqueeze(2)).norm(dim=-1)
        return ~(gap < CONTACT_FACTOR * self.distances).any(-1)

    def places(self, X: Sequence[Tensor]) -> Tensor:
        """Positions (B, V, K, d) of the vehicles in states (B, K, n) each."""
        return torch.stack([x[..., one.position] for one, x in zip(self.members, X, strict=True)], dim=1)

    @cached_property
    def form_of(self) -> dict[int, tuple[int, int]]:
        """Of each vehicle its form, and its place there."""
        return {v: (i, place) for i, (_, whose) in enumerate(self.forms) for place, v in enumerate(whose)}

    def row_of(self, v: int, b: int) -> int:
        """Which problem of its form vehicle v of fleet b has."""
        return self.form_of[v][1] * self.B + b

    def take(self, b: Sequence[int]) -> Fleet:
        """The fleets at some places of the batch."""
        rows, one = torch.tensor(list(b), dtype=torch.int64), object.__new__(Fleet)
        members = tuple(each.take(rows) for each in self.members)
        at = [torch.cat([place * self.B + rows for place in range(len(whose))]) for _, whose in self.forms]
        forms = tuple((batch.take(own), whose) for (batch, whose), own in zip(self.forms, at, strict=True))
        kept = {"vehicles": members, "apart": self.apart, "pairs": self.pairs, "members": members, "forms": forms}
        for name, part in (kept | {"distances": self.distances}).items():
            object.__setattr__(one, name, part)
        return one


def _members(vehicles: Any) -> tuple[Problem, ...]:
    if isinstance(vehicles, Problem):
        members = tuple(vehicles.take(torch.tensor([v])) for v in range(vehicles.B))
    elif isinstance(vehicles, Sequence) and all(isinstance(one, Problem) for one in vehicles):
        members = tuple(one.current() for one in vehicles)
    else:
        got = shown(vehicles)
        raise InputError("fleet.vehicles", "a problem per vehicle, or one whose batch are the vehicles", got)
    if len(members) < 2:
        raise InputError("fleet.vehicles", "at least two", len(members))
    first = members[0]
    for v, one in enumerate(members):
        where = f"fleet.vehicles[{v}]"
        _check_served(one, where)
        for name, of in ALIKE.items():
            if of(one) != of(first):
                raise InputError(where, f"{name} {of(first)} as of vehicle 0", of(one))
    return members


ALIKE = {
    "N": lambda one: one.N,
    "dt": lambda one: one.dynamics.dt,
    "a batch of": lambda one: one.B,
    "a position of dimension": lambda one: one.position.stop - one.position.start,
}


def _check_served(one: Problem, where: str) -> None:
    if one.dynamics.position is None or getattr(one.dynamics, "dt", None) is None:
        raise InputError(where, "dynamics with a position and a time step", type(one.dynamics).__name__)
    if one.x0.dtype != torch.float64 or one.x0.device.type != "cpu":
        raise InputError(f"{where}.x0", "float64 on the CPU", f"{one.x0.dtype} on {one.x0.device}")
    for name in ("time", "horizon", "free_start"):
        if getattr(one, name) is not None:
            raise InputError(f"{where}.{name}", "None: all vehicles of a fleet have the same, given times", name)


def _pairs(pairs: Any, V: int) -> list[tuple[int, int]]:
    """Pairs of different vehicles, the first below the second."""
    if pairs is None:
        return list(combinations(range(V), 2))
    expected = f"pairs of two vehicles within 0..{V - 1}, none twice"
    try:
        found = [tuple(sorted(whole(v) for v in pair)) for pair in pairs]
    except TypeError:
        raise InputError("fleet.pairs", expected, shown(pairs)) from None
    fits = all(len(pair) == 2 and 0 <= pair[0] < pair[1] < V for pair in found)
    if not found or not fits or len(set(found)) < len(found):
        raise InputError("fleet.pairs", expected, shown(pairs))
    return [(pair[0], pair[1]) for pair in found]


def _distances(apart: Any, pairs: list[tuple[int, int]], V: int, like: Tensor) -> Tensor:
    given = tensor(apart, "fleet.apart", like)
    if tuple(given.shape) not in ((), (len(pairs),)):
        raise InputError("fleet.apart", f"a number, or one for each of {len(pairs)} pairs", tuple(given.shape))
    if not bool((torch.isfinite(given) & (given > 0)).all()):
        raise InputError("fleet.apart", "finite distances above 0 m", given.tolist())
    found = like.new_zeros(V, V)
    for (i, j), distance in zip(pairs, given.expand(len(pairs)).tolist(), strict=True):
        found[i, j] = found[j, i] = distance
    return found


def _forms(members: tuple[Problem, ...]) -> tuple[tuple[Problem, tuple[int, ...]], ...]:
    """Problems of the same form as one batch, (vehicles, B) after each other, and whose they are."""
    found: list[tuple[Problem, tuple[int, ...]]] = []
    for v, one in enumerate(members):
        for i, (batch, whose) in enumerate(found):
            if (joined := merged(batch, one)) is not None:
                found[i] = joined, (*whose, v)
                break
        else:
            found.append((one, (v,)))
    return tuple(found)
