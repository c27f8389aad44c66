"""Contact: how far the vehicles of missions are from touching the obstacles, of any kind, at rest or moving.

Distances are the judge's, which no solver shares, so that a planner that measures wrongly is found out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.tree import PerElement
from torchgco.judging.judge import CLEARANCES, by_kind
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Contact(PerElement):
    """The obstacles of B planning problems, as vehicles touch them: at CONTACT_FACTOR of the full radii.

    A constraint that is given as a function has no distance and is left out, as by the judge.
    """

    obstacles: tuple[Any, ...]  # as at time 0

    batched: ClassVar[tuple[str, ...]] = ("obstacles",)

    @classmethod
    def among(cls, problem: Problem) -> Self:
        """The obstacles among a problem's constraints.

        Raises:
            InputError: obstacles of a kind that can't be judged.
        """
        found = tuple(part for part in problem.constraints if isinstance(part, Obstacles))
        for part in found:
            by_kind(CLEARANCES, part)
        return cls(found)

    @property
    def moving(self) -> bool:
        """Whether any obstacle moves."""
        return any(part.moving for part in self.obstacles)

    def distance(self, p: Tensor, t: float) -> Tensor:
        """Smallest distances (B,), m, of positions p (B, 3), m, at time t, s: negative in contact.

        Infinite where there is no obstacle.
        """
        return self._nearest(torch.stack((p, p), dim=1), t, 0.0)

    def distances(self, p: Tensor, dt: float) -> Tensor:
        """The same (B, K) of positions p (B, K, 3) at times k dt, s."""
        found = [self.distance(p[:, k], k * dt) for k in range(p.shape[1])]
        return torch.stack(found, dim=1) if found else p[..., 0]

    def along(self, p: Tensor, dt: float) -> Tensor:
        """Smallest distances (B,) on the straight ways between positions p (B, K, 3), K above 0, at times k dt, s."""
        return self._nearest(p, 0.0, dt) if p.shape[1] > 1 else self.distance(p[:, 0], 0.0)

    def _nearest(self, p: Tensor, t: float, dt: float) -> Tensor:
        nearest = torch.full_like(p[:, 0, 0], torch.inf)
        for part in self.obstacles:
            now = replace(part.later(t), dt=dt) if part.moving else part
            nearest = torch.minimum(nearest, by_kind(CLEARANCES, part)(now, p)[1])
        return nearest
