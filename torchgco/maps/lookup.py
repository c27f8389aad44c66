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
obstacles, with the same slope. native/c/field.h does the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LOOKUPS_AT_ONCE = 2**15  # points that are looked up together, about: bounds the memory


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
    """The T nodes along each axis around points (B, K): weights and their derivatives (B, K, d, T)."""

    held: Tensor  # int64: places held in the lattice
    weights: Tensor
    slopes: Tensor
    more: Tensor  # (B, K, d): what each axis adds to G, in squared steps: beyond the edge, less the variance V
    more_slope: Tensor


def squares(lattice: Lattice, p: Tensor, cores: Tensor) -> Tensor:
    """G (B, K), m^2, at points p (B, K, d), m, with the core r (B,), m."""
    return torch.cat([_contracted(lattice, _taps(lattice, chunk), cores, 0)[0] for chunk in _parts(p)], dim=1)


def squares_and_slopes(lattice: Lattice, p: Tensor, cores: Tensor) -> tuple[Tensor, Tensor]:
    """G (B, K), m^2, and its derivatives by p (B, K, d), m."""
    pairs = [_contracted(lattice, _taps(lattice, chunk), cores, 1) for chunk in _parts(p)]
    slopes = [torch.stack(by_axis, dim=-1) for _, by_axis in pairs]
    return torch.cat([value for value, _ in pairs], dim=1), torch.cat(slopes, dim=1)


def _parts(p: Tensor) -> tuple[Tensor, ...]:
    """Points (B, K, d), some of each problem at a time."""
    return p.split(max(1, LOOKUPS_AT_ONCE // max(1, len(p))), dim=1)


def lengths(square: Tensor, core: Tensor) -> Tensor:
    """The distances whose squares, or tangents to them nearer than a core, are `square`."""
    least = core.square()
    return torch.where(square < least, (square + least) / (2.0 * core), torch.maximum(square, least).sqrt())


def _taps(lattice: Lattice, p: Tensor) -> _Taps:
    u = (p - lattice.origins.unsqueeze(1)) * (1.0 / lattice.spacing)
    base = (u.detach() + 0.5).floor() if lattice.smooth else u.detach().floor()
    f = u - base
    if lattice.smooth:
        low, high = 0.5 - f, 0.5 + f
        weights, slopes = [0.5 * low * low, 0.75 - f * f, 0.5 * high * high], [-low, -2.0 * f, high]
        more, more_slope, first = torch.full_like(f, -0.25), torch.zeros_like(f), -1
    else:
        weights, slopes = [1.0 - f, f], [-torch.ones_like(f), torch.ones_like(f)]
        more, more_slope, first = -f * (1.0 - f), 2.0 * f - 1.0, 0
    weight, slope = torch.stack(weights, dim=-1), torch.stack(slopes, dim=-1)
    nodes = base.unsqueeze(-1) + torch.arange(first, first + len(weights), dtype=p.dtype, device=p.device)
    last = torch.tensor(lattice.nodes.shape[1:], dtype=p.dtype, device=p.device).unsqueeze(-1) - 1.0
    clamped = torch.minimum(nodes.clamp(min=0.0), last)
    beyond = (nodes - clamped).square()
    more, more_slope = more + _summed(weight * beyond), more_slope + _summed(slope * beyond)
    return _Taps(clamped.nan_to_num(0.0).long(), weight, slope, more, more_slope)


def _contracted(lattice: Lattice, taps: _Taps, cores: Tensor, order: int) -> tuple[Tensor, list[Tensor]]:
    """G (B, K), and its derivatives by each coordinate where `order` is 1."""
    shape, core, d = lattice.nodes.shape[1:], cores.unsqueeze(-1), len(lattice.nodes.shape) - 1
    index = lattice.which.view(-1, *([1] * (d + 1)))
    for axis, size in enumerate(shape):
        index = index * size + taps.held[..., axis, :].view(*taps.held.shape[:2], *_along(axis, d))
    distance = lattice.nodes.reshape(-1)[index].to(cores.dtype)
    core = core.view(-1, *([1] * (d + 1)))
    value, slopes = torch.where(distance < core, core * (2.0 * distance - core), distance * distance), list[Tensor]()
    for axis in reversed(range(d)):  # the last axis of `value` is summed over
        weight, slope = (t[..., axis, :].view(*t.shape[:2], *[1] * axis, -1) for t in (taps.weights, taps.slopes))
        if order == 1:
            slopes = [_summed(slope * value), *(_summed(weight * s) for s in slopes)]
        value = _summed(weight * value)
    h = lattice.spacing
    for axis in range(d):
        value = value + (h * h) * taps.more[..., axis]
    return value, [(1.0 / h) * slope + h * taps.more_slope[..., i] for i, slope in enumerate(slopes)]


def _along(axis: int, d: int) -> list[int]:
    """The shape of numbers along one of d axes."""
    return [-1 if i == axis else 1 for i in range(d)]


def _summed(values: Tensor) -> Tensor:
    """The sum over the last axis, one after the other."""
    total = values[..., 0]
    for i in range(1, values.shape[-1]):
        total = total + values[..., i]
    return total
