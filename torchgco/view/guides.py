"""What guidance did in a solve: guide regions and sampled trajectories, seen through a guidance that only looks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.problem import Problem
from torchgco.solvers.contracts import Advice, Guidance


class Guided(NamedTuple):
    """The guide region of a problem after one outer iteration."""

    number: int  # the problem's id
    outer: int  # the outer iteration
    balls: np.ndarray  # (K, d + 1): centres and radii, m, at the guided knots
    sample: np.ndarray  # (N+1, d): the trajectory that the balls lie along, m


@dataclass(frozen=True)
class Watched:
    """Another guidance, whose advice is passed on as it is and noted in `seen`.

    Args:
        guidance: that advises.
        seen: what it advised, in the order of the calls.
    """

    guidance: Guidance
    seen: list[Guided] = field(default_factory=list)

    def suited(self, problem: Problem) -> Self | None:
        suited = self.guidance.suited(problem)
        return None if suited is None else replace(self, guidance=suited)

    def start(self, problem: Problem, X: Tensor) -> GuideRegion | None:
        return self.guidance.start(problem, X)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        advice = self.guidance.update(problem, X, U, penalty, key)
        region = advice.penalty
        if isinstance(region, GuideRegion):
            for row in region.is_active.nonzero().flatten().tolist():
                center, radius = (part[row].detach().cpu().double().numpy() for part in (region.center, region.radius))
                here = np.isfinite(radius)
                balls = np.column_stack((center[here], radius[here]))
                self.seen.append(Guided(int(key.ids[row]), int(key.outer[row]), balls, center))
        return advice
