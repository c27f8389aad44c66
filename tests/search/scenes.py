"""Obstacles in the roadmap's form, from plain numbers."""

from __future__ import annotations

from typing import Any

import torch

from torchgco.obstacles.base import Solids
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.homotopy import classes

NONE = float("nan")  # the radius of an absent sphere


def spheres(centers: Any, radii: Any) -> Solids:
    """Spheres (B, M, d) with radii (B, M), NaN where absent."""
    o, R = (torch.as_tensor(value, dtype=torch.float64) for value in (centers, radii))
    return Solids(o, R.nan_to_num(0.0), R.isnan())


def inflated(centers: Any, radii: Any, boxes: Cuboids | None = None) -> Inflated:
    """The same as obstacles, with boxes."""
    return Inflated(spheres(centers, radii), boxes)


def first_of_class(paths: torch.Tensor, obstacles: Inflated) -> torch.Tensor:
    """Whether each path (B, K, P, d) is the first of its homotopy class, (B, K)."""
    return classes(paths, obstacles) == torch.arange(paths.shape[1])
