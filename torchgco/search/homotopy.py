"""Which ways between the same ends are different ways: those that no bending turns into each other."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchgco.guidance.roadmap import Scene, points_along

POINTS = 65  # at which two ways in space are compared


def distinct(ways: Tensor, scene: Scene) -> Tensor:
    """The first way of every class, (B, K) bool, of polylines (B, K, P, d) that share their ends.

    In the plane two ways are of one class where they wind alike around every obstacle. Around balls in space any way
    can be bent into any other: there those count as one that are nowhere farther apart than the largest r_obs + r_veh.
    """
    alike = _wind_alike(ways, scene) if ways.shape[-1] == 2 else _are_close(ways, scene)
    first = torch.ones_like(alike[..., 0])
    for k in range(1, ways.shape[1]):
        first[:, k] = ~(alike[:, k, :k] & first[:, :k]).any(-1)
    return first


def _wind_alike(ways: Tensor, scene: Scene) -> Tensor:
    """(B, K, K): the angles that two ways sweep around an obstacle are the same or differ by full turns."""
    seen = ways.unsqueeze(2) - scene.centers[:, None, :, None]  # (B, K, M, P, 2)
    a, b = seen[..., :-1, :], seen[..., 1:, :]
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    swept = torch.atan2(cross, (a * b).sum(-1)).sum(-1)
    turned = (swept.unsqueeze(2) - swept.unsqueeze(1)).abs() > math.pi
    return ~(turned & (scene.distances > 0)[:, None, None]).any(-1)


def _are_close(ways: Tensor, scene: Scene) -> Tensor:
    """(B, K, K): nowhere farther apart than the largest r_obs + r_veh, at the same shares of their lengths."""
    flat = ways.flatten(0, 1)
    length = (flat[:, 1:] - flat[:, :-1]).square().sum(-1).sqrt().sum(-1, keepdim=True)
    share = torch.linspace(0.0, 1.0, POINTS, dtype=flat.dtype, device=flat.device)
    points = points_along(flat, share * length).view(*ways.shape[:2], POINTS, -1)
    apart = (points.unsqueeze(2) - points.unsqueeze(1)).square().sum(-1).amax(-1).sqrt()
    return apart <= scene.distances.amax(-1).view(-1, 1, 1)
