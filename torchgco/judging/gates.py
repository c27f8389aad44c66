"""Whether a trajectory passes its gates, measured between the knots too, by maths of its own."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.judging.distances import segment_distance
from torchgco.obstacles.base import ADMITTED


class Passes(NamedTuple):
    """How each problem passes each of its gates, (B, G)."""

    distance: Tensor  # m: from a ball's centre, or in a square's plane along the farther side; infinite: not crossed
    passed: Tensor  # bool: at most the gate's radius or half width, and 1e-3 m, away; a square in its direction


def passes(constraint: Constraint, X: Tensor) -> Passes | None:
    """How X (B, N+1, n) passes the gates of a constraint; None where it has none.

    A ball is passed on the straight lines from the knot before its own to the knot after it, a square on the one from
    its knot to the next.
    """
    gates = constraint.bare
    if isinstance(gates, GateBalls):
        return _balls(gates, X[..., gates.components])
    return _squares(gates, X[..., gates.components]) if isinstance(gates, GateSquares) else None


def _balls(gates: GateBalls, p: Tensor) -> Passes:
    before, at, after = (_knots(p, gates.places + shift) - gates.centers for shift in (-1, 0, 1))
    away = torch.minimum(segment_distance(before, at), segment_distance(at, after))
    return Passes(away, away <= gates.sizes + ADMITTED)


def _squares(gates: GateSquares, p: Tensor) -> Passes:
    a, b = (_knots(p, gates.places + shift) - gates.centers for shift in (0, 1))
    normal, sides = gates.axes[:, :, 0], gates.axes[:, :, 1:]
    first, second = (normal * a).sum(-1), (normal * b).sum(-1)
    crosses = (first <= ADMITTED) & (second >= -ADMITTED) & (second > first)
    share = torch.where(crosses, -first / (second - first), 0.0).clamp(0.0, 1.0)
    place = a + share.unsqueeze(-1) * (b - a)
    away = (sides @ place.unsqueeze(-1))[..., 0].abs().amax(-1)
    away = torch.where(crosses, away, torch.inf)
    return Passes(away, away <= gates.half_widths + ADMITTED)


def _knots(p: Tensor, places: Tensor) -> Tensor:
    """Positions (B, G, d) at knots (B, G), the first and the last for those beyond."""
    index = places.clamp(0, p.shape[1] - 1).unsqueeze(-1).expand(-1, -1, p.shape[-1])
    return p.gather(1, index)
