"""Paths through gates: leg by leg, from each to the next."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.roadmap.geometry import Scene, points_along
from torchgco.roadmap.known import Known
from torchgco.roadmap.roadmap import Roadmap


def paths_through(roadmap: Roadmap, scene: Scene, count: int, rows: Tensor, known: Known) -> tuple[Tensor, Tensor]:
    """`roadmap.paths`, and through the gates of a scene that has some.

    Of the paths of each leg the first ones follow each other, and so do the second ones: corners
    (B', count, (G+1) (HOPS+1), d), and whether there is a path along every leg (B',).
    """
    if scene.gates is None:
        return roadmap.paths(scene, count, rows, known)
    stops = torch.cat((scene.start.unsqueeze(1), scene.gates, scene.goal.unsqueeze(1)), dim=1)
    legs = [
        roadmap.paths(replace(scene, start=stops[:, g], goal=stops[:, g + 1], gates=None), count, rows)
        for g in range(stops.shape[1] - 1)
    ]
    corners, found = zip(*legs, strict=True)
    return torch.cat(corners, dim=2), torch.stack(found).all(0)


def timed(path: Tensor, places: Tensor, stages: Tensor, N: int) -> Tensor:
    """Positions (R, N+1, d) on paths (R, P, d) of G + 1 legs, which are at gate g at the knots places (R, G).

    They move slowly at both ends, and rest at the last from knot `stages` (R,) on, which need not be whole.
    """
    legs = places.shape[1] + 1
    along = torch.cat((torch.zeros_like(path[:, :1, 0]), path.diff(dim=1).norm(dim=-1).cumsum(-1)), dim=1)
    corners = path.shape[1] // legs
    reached = torch.cat((torch.zeros_like(along[:, :1]), along[:, corners - 1 :: corners]), dim=1)  # (R, G+2)
    knots = torch.cat((torch.zeros_like(places[:, :1]), places, stages.unsqueeze(-1)), dim=1).to(path)
    k = torch.arange(N + 1, dtype=path.dtype, device=path.device).expand(len(path), -1)
    knots, k = (
        share.square() * (3.0 - 2.0 * share) for share in ((t / knots[:, -1:]).clamp(max=1.0) for t in (knots, k))
    )
    right = torch.searchsorted(knots.contiguous(), k.contiguous(), right=True).clamp(1, legs)
    first, last = knots.gather(1, right - 1), knots.gather(1, right)
    share = ((k - first) / (last - first).clamp(min=1e-12)).clamp(0.0, 1.0)
    return points_along(path, torch.lerp(reached.gather(1, right - 1), reached.gather(1, right), share))
