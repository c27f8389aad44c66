"""Interpolation in a distance field: values between the nodes that never exceed the true distance.

With s_i = |x_i - q|^2 at nodes x_i around a point x, for any occupied point q, and weights w_i >= 0 that sum to 1 and
have x as their mean,

    sum w_i s_i = |x - q|^2 + V,    V = sum w_i |x_i - x|^2.

Squared distances at the nodes are no larger than s_i for the q that is nearest to x. So G(x) = sum w_i d_i^2 - V is no
larger than the squared distance at x, and equal to it where all nodes see the same q. V is known: d h^2 / 4 for
quadratic B-splines (three nodes per axis; G has continuous first derivatives), h^2 sum f (1 - f) for linear weights
(two nodes per axis; kinks between cells). Nodes outside of the lattice are those at its edge, farther by their distance
from it: this is no larger than the true distance either, as everything occupied lies in the lattice.

Nearer than a core r the square is replaced by its tangent at r, which lies below it: G then goes on falling inside of
obstacles, with the same slope. native/c/field.c does the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Lattice:
    """Distances at nodes, and which of the maps each problem is in."""

    nodes: Tensor  # (G, nodes along x, y[, z]) float32, m
    which: Tensor  # (B,) int64
    origins: Tensor  # (B, d): the first node, m
    spacing: float  # m
    smooth: bool  # quadratic B-splines, or linear weights


@dataclass(frozen=True)
class _Taps:
    """The nodes along one axis around points (B, K): weights, their derivatives, and places held in the lattice."""

    held: list[Tensor]  # int64
    weights: list[Tensor]
    slopes: list[Tensor]
    more: Tensor  # what the axis adds to G, in squared steps: distances beyond the edge, less the variance V
    more_slope: Tensor


def squares(lattice: Lattice, p: Tensor, cores: Tensor) -> Tensor:
    """G (B, K), m^2, at points p (B, K, d), m, with the core r (B,), m."""
    return _contracted(lattice, _taps(lattice, p), cores)[0]


def squares_and_slopes(lattice: Lattice, p: Tensor, cores: Tensor) -> tuple[Tensor, Tensor]:
    """G (B, K), m^2, and its derivatives by p (B, K, d), m."""
    value, slopes = _contracted(lattice, _taps(lattice, p), cores)
    return value, torch.stack(slopes, dim=-1)


def distances(lattice: Lattice, p: Tensor, cores: Tensor) -> Tensor:
    """Distances (B, K), m, of which G is the square, or its tangent nearer than the core."""
    return lengths(squares(lattice, p, cores), cores.unsqueeze(-1))


def lengths(square: Tensor, core: Tensor) -> Tensor:
    """The distances whose squares, or tangents to them nearer than a core, are `square`."""
    least = core.square()
    return torch.where(square < least, (square + least) / (2.0 * core), torch.maximum(square, least).sqrt())


def _taps(lattice: Lattice, p: Tensor) -> list[_Taps]:
    u = (p - lattice.origins.unsqueeze(1)) * (1.0 / lattice.spacing)
    return [_axis(x, size, lattice.smooth) for x, size in zip(u.unbind(-1), lattice.nodes.shape[1:], strict=True)]


def _axis(u: Tensor, size: int, smooth: bool) -> _Taps:
    base = (u.detach() + 0.5).floor() if smooth else u.detach().floor()
    f = u - base
    if smooth:
        low, high = 0.5 - f, 0.5 + f
        weights, slopes = [0.5 * low * low, 0.75 - f * f, 0.5 * high * high], [-low, -2.0 * f, high]
        more, more_slope, first = torch.full_like(f, -0.25), torch.zeros_like(f), -1
    else:
        weights, slopes = [1.0 - f, f], [-torch.ones_like(f), torch.ones_like(f)]
        more, more_slope, first = -f * (1.0 - f), 2.0 * f - 1.0, 0
    held = []
    for i, (weight, slope) in enumerate(zip(weights, slopes, strict=True)):
        place = base + (i + first)
        inside = place.clamp(0.0, size - 1.0)
        beyond = (place - inside) * (place - inside)
        more, more_slope = more + weight * beyond, more_slope + slope * beyond
        held.append(inside.nan_to_num(0.0).long())
    return _Taps(held, weights, slopes, more, more_slope)


def _contracted(lattice: Lattice, taps: list[_Taps], cores: Tensor) -> tuple[Tensor, list[Tensor]]:
    shape, core = lattice.nodes.shape[1:], cores.unsqueeze(-1)
    flat = lattice.nodes.reshape(-1)

    def along(axis: int, place: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The sums over the nodes of this axis and all later ones, and their derivatives by these axes."""
        if axis == len(shape):
            distance = flat[place].to(cores.dtype)
            return torch.where(distance < core, core * (2.0 * distance - core), distance * distance), []
        value, slopes = torch.zeros_like(taps[axis].more), [torch.zeros_like(taps[axis].more) for _ in shape[axis:]]
        for held, weight, slope in zip(taps[axis].held, taps[axis].weights, taps[axis].slopes, strict=True):
            inner, others = along(axis + 1, place * shape[axis] + held)
            value = value + weight * inner
            slopes = [slopes[0] + slope * inner, *(a + weight * b for a, b in zip(slopes[1:], others, strict=True))]
        return value, slopes

    value, slopes = along(0, lattice.which.unsqueeze(-1))
    h = lattice.spacing
    for axis in taps:
        value = value + (h * h) * axis.more
    return value, [(1.0 / h) * slope + h * axis.more_slope for slope, axis in zip(slopes, taps, strict=True)]
