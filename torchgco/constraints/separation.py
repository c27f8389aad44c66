"""Distances between positions within one state, as of vehicles that are planned together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions, tensor
from torchgco.constraints.base import CONTACT_FACTOR, TOUCH, Distance, resolve_knots, whole
from torchgco.costs.base import add_blocks


@dataclass(frozen=True)
class Separation(Distance):
    """min_distance^2 - |p_i - p_j|^2 <= 0 for pairs of positions within one state, a row for each pair.

        apart = Separation([[0, 1, 2], [13, 14, 15]], 1.0)  # two quadrotors, 13 states each, keep 1 m

    As with obstacles, bodies touch at 0.95 of the distance: judge and search measure it between the knots, too.

    Args:
        positions: which states are the coordinates of each position, (P, d): P lists or ranges of d whole numbers.
        min_distance: one number for all problems or (B,), m, above 0; or (B|1, Q), one for each pair.
        pairs: which positions keep the distance, (Q, 2) whole numbers below P; None: all of them from each other.
        knots: default 1..N.

    Raises:
        InputError: on `Problem(...)`: positions that are no states, that share one or have different lengths; pairs of
            one position, or given twice; a distance that isn't a finite number above 0.
    """

    positions: Any
    min_distance: Any
    pairs: Any = None
    knots: Any = None

    in_place: ClassVar[bool] = True
    per_element: ClassVar[tuple[str, ...]] = ("min_distance",)

    def bind(self, dims: Dimensions) -> Self:
        states = _indices(self.positions, "separation.positions", dims.n)
        if states.shape[0] < 2 or states.unique().numel() < states.numel():
            raise InputError("separation.positions", "at least two, each with states of its own", states.tolist())
        count = states.shape[0]
        pairs = _indices(
            list(combinations(range(count), 2)) if self.pairs is None else self.pairs, "separation.pairs", count
        )
        different = {frozenset(pair) for pair in pairs.tolist()}
        if pairs.shape[1] != 2 or len(different) < len(pairs) or any(len(pair) < 2 for pair in different):
            raise InputError("separation.pairs", "pairs of two positions, none twice", pairs.tolist())
        distance = tensor(self.min_distance, "separation.min_distance", dims.like)
        of_pairs = distance.dim() == 2 and tuple(distance.shape) in ((1, len(pairs)), (dims.B, len(pairs)))
        if not of_pairs and (distance.dim() > 1 or distance.numel() not in (1, dims.B)):
            expected = f"a number, {dims.B} of them, or ({dims.B} or 1, {len(pairs)}) of the pairs"
            raise InputError("separation.min_distance", expected, f"shape {tuple(distance.shape)}")
        if not bool((torch.isfinite(distance) & (distance > 0)).all()):
            raise InputError("separation.min_distance", "finite numbers above 0 m", distance.tolist())
        knots = resolve_knots(self.knots, dims.N, "separation.knots", distance.device)
        states, pairs = states.to(distance.device), pairs.to(distance.device)
        return replace(
            self,
            positions=states,
            pairs=pairs,
            min_distance=distance if of_pairs else distance.reshape(-1),
            knots=knots,
        )

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.kept.square() - self.away(X[:, self.knots]).square().sum(-1)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """By how much pairs are too close, m."""
        return (self.kept - self.away(X[:, self.knots]).norm(dim=-1)).clamp(min=0.0)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        rows, (first, second) = torch.arange(len(self.pairs), device=X.device).unsqueeze(1), self.ends
        slopes = X.new_zeros(*g.shape, X.shape[-1])
        slopes[..., rows, second] = 2.0 * self.away(X[:, self.knots])
        slopes[..., rows, first] = -slopes[..., rows, second]
        add = H.new_zeros(*g.shape[:2], *H.shape[2:])
        gradient = (g.unsqueeze(-1) * slopes).sum(-2)
        add_blocks(add, X.shape[-1], gradient, None, slopes.mT @ (h.unsqueeze(-1) * slopes), None)
        H[:, self.knots] += add

    def grown(self, by: Tensor) -> Self:
        return replace(
            self, min_distance=self.min_distance + (by if self.min_distance.dim() == 1 else by.unsqueeze(-1))
        )

    def start_is_clear(self, x0: Tensor) -> Tensor:
        """False where bodies touch at the start, (B,)."""
        return (self.away(x0).norm(dim=-1) >= CONTACT_FACTOR * self.kept[:, 0]).all(-1)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        """As of `Distance`, both on the straight lines between their knots at the same time."""
        away = self.away(X)
        a, along = away[:, :-1], away.diff(dim=1)
        length = along.square().sum(-1, keepdim=True).clamp(min=torch.finfo(X.dtype).tiny)
        nearest = a - ((a * along).sum(-1, keepdim=True) / length).clamp(-1.0, 0.0) * along
        contact = 1.0 - (TOUCH if share is None else share)
        return (nearest.norm(dim=-1) - contact * self.kept).flatten(1).amin(-1)

    @property
    def contact_depths(self) -> Tensor:  # type: ignore[override]
        return TOUCH * self.kept[:, 0]

    @property
    def kept(self) -> Tensor:
        """The distances (B|1, 1, Q|1), m, once bound."""
        return self.min_distance.view(len(self.min_distance), 1, -1)

    def places(self, X: Tensor) -> Tensor:
        return self.away(X)

    def measured(self, X: Tensor) -> tuple[Tensor, Tensor]:
        distances, ways = [], []
        for first, second in zip(*self.ends, strict=True):
            away = X[..., first] - X[..., second]
            along = away.diff(dim=1)
            square = along.square().sum(-1).clamp(min=torch.finfo(X.dtype).tiny)
            share = (-(away[:, :-1] * along).sum(-1) / square).clamp(0.0, 1.0).unsqueeze(-1)
            distances.append(away.norm(dim=-1))
            ways.append((away[:, :-1] + share * along).norm(dim=-1))
        return torch.stack(distances, dim=-1) - self.kept, torch.stack(ways, dim=-1) - self.kept

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """The states (Q, d) of the two positions of each pair, once bound."""
        return self.positions[self.pairs[:, 0]], self.positions[self.pairs[:, 1]]

    def away(self, x: Tensor) -> Tensor:
        """Vectors (..., Q, d) between the two positions of each pair, from states (..., n)."""
        first, second = self.ends
        return x[..., first] - x[..., second]


def _indices(value: Any, field: str, count: int) -> Tensor:
    """Whole numbers below `count`, (rows, columns) int64.

    Raises:
        InputError: anything else, rows of different lengths, none.
    """
    expected = f"lists of whole numbers within 0..{count - 1}, all of one length"
    try:
        numbers = torch.tensor([[whole(k) for k in row] for row in value], device="cpu")
    except (TypeError, ValueError, RuntimeError):
        raise InputError(field, expected, shown(value)) from None
    if numbers.dim() != 2 or numbers.numel() == 0 or not bool(((numbers >= 0) & (numbers < count)).all()):
        raise InputError(field, expected, shown(value))
    return numbers
