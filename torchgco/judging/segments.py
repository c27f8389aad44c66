"""Distances from straight lines between knots."""

from __future__ import annotations

import torch
from torch import Tensor


def segment_distance(a: Tensor, b: Tensor) -> Tensor:
    """Distance (...) of the origin from the segment between a and b (..., d)."""
    along = b - a
    length = along.square().sum(-1)
    share = (-(a * along).sum(-1) / length.clamp(min=torch.finfo(a.dtype).tiny)).clamp(0.0, 1.0)
    return (a + share.unsqueeze(-1) * along).norm(dim=-1)
