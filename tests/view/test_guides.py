"""A guidance that only looks: it passes advice on, and notes guide regions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from tests.view.scenes import N, problem, trajectories
from torchgco import Problem
from torchgco.base.draws import DrawKey
from torchgco.experiments.reports.view import Watched
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.solvers.contracts import Advice


@dataclass(frozen=True)
class Middle:
    """Draws the middle knot of the problems with an odd id to where it is."""

    def suited(self, problem: Problem) -> Self | None:
        return self if problem.B > 1 else None

    def start(self, problem: Problem, X: Tensor) -> GuideRegion:
        return GuideRegion.inactive(X, X.new_ones(len(X)), problem.position)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        region = self.start(problem, X)
        region.radius[key.ids % 2 == 1, N // 2] = 0.3
        return Advice(region)


def test_regions_are_noted_with_their_problem_and_iteration() -> None:
    task, X = problem(3), trajectories(3)["gco"]
    watched = Watched(Middle()).suited(task)
    assert watched is not None and Watched(Middle()).suited(task.take(torch.tensor([0]))) is None
    key = DrawKey(0, torch.tensor([4, 5, 7]), torch.tensor([1, 2, 3]))
    penalty = watched.start(task, X)
    assert penalty is not None and not penalty.is_active.any()
    advice = watched.update(task, X, X, penalty, key)
    assert torch.equal(advice.penalty.radius, Middle().update(task, X, X, penalty, key).penalty.radius)  # type: ignore
    assert [(one.number, one.outer) for one in watched.seen] == [(5, 2), (7, 3)]
    for one, states in zip(watched.seen, X[1:], strict=True):
        np.testing.assert_array_equal(one.balls, [[*states[N // 2], 0.3]])
        np.testing.assert_array_equal(one.sample, states)
