"""Homotopy classes: which paths between the same ends can be bent into each other without crossing an obstacle."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchgco.roadmap.geometry import Inflated, length, points_along
from torchgco.roadmap.mapped import sweep_alike

COMPARED_POINTS = 65  # at which two paths in space are compared


def classes(paths: Tensor, obstacles: Inflated) -> Tensor:
    """The first path of the class of each path, (B, K) int64, of polylines (B, K, P, d) that share their ends.

    In the plane two paths are of one class where they have equal winding angles around every obstacle. Around balls in
    space all paths are of one class: there, two paths count as one where they are nowhere farther apart than the
    largest obstacle's size.
    """
    found = _wind_alike(paths, obstacles) if paths.shape[-1] == 2 else _are_close(paths, obstacles)
    alike = found.cpu().numpy()  # which takes a small share of PyTorch's time for a few numbers
    first = np.ones(alike.shape[:2], dtype=bool)
    label = np.tile(np.arange(alike.shape[1]), (len(alike), 1))
    for k in range(1, alike.shape[1]):
        same = alike[:, k, :k] & first[:, :k]
        first[:, k] = ~same.any(-1)
        label[:, k] = np.where(first[:, k], k, same.argmax(-1))
    return torch.from_numpy(label).to(paths.device)


def _wind_alike(paths: Tensor, obstacles: Inflated) -> Tensor:
    """(B, K, K): the angles that two paths sweep around each obstacle are the same, up to full turns."""
    middles = torch.cat([part.centers for part in obstacles.kinds], dim=1)
    seen = paths.unsqueeze(2) - middles[:, None, :, None]  # (B, K, M, P, 2)
    a, b = seen[..., :-1, :], seen[..., 1:, :]
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    swept = torch.atan2(cross, (a * b).sum(-1)).sum(-1)
    turned = (swept.unsqueeze(2) - swept.unsqueeze(1)).abs() > math.pi
    alike = ~(turned & (obstacles.sizes > 0)[:, None, None]).any(-1)
    return alike & sweep_alike(paths, obstacles) if obstacles.maps else alike


def _are_close(paths: Tensor, obstacles: Inflated) -> Tensor:
    """(B, K, K): nowhere farther apart than the largest obstacle's size, at the same shares of their lengths."""
    flat = paths.flatten(0, 1)
    share = torch.linspace(0.0, 1.0, COMPARED_POINTS, dtype=flat.dtype, device=flat.device)
    points = points_along(flat, share * length(flat).unsqueeze(-1)).view(*paths.shape[:2], COMPARED_POINTS, -1)
    apart = (points.unsqueeze(2) - points.unsqueeze(1)).square().sum(-1).amax(-1).sqrt()
    return apart <= obstacles.largest.unsqueeze(-1)
