"""The guide region from a sampled trajectory (CPUF, Algorithm 5)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.lagrangian.penalties import GuideRegion


def guide_along(guide: GuideRegion, X_safe: Tensor, caught: Tensor, radius: Tensor) -> GuideRegion:
    """Balls of `radius` (B,) around X_safe (B, N+1, n) at the caught knots (B, N+1), none elsewhere."""
    return replace(
        guide,
        center=X_safe[..., guide.position],
        radius=torch.where(caught, radius.unsqueeze(-1), torch.inf),
    )
