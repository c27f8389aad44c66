"""The choice among attempts: arrived before feasible before cheap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from tests.problems import planar_batch
from tests.search.gates import LOCAL, Solve
from tests.search.rows import restarts
from torchgco import GCO, ILQR, AugmentedLagrangian, Goal, LineSearch, Problem, QuadraticCost, Solution
from torchgco.kernels.in_c import NativeKernels
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.search.search import Best
from torchgco.search.steps import ATTEMPT_SEED_STEP
from torchgco.solvers.contracts import Advice, Call


@dataclass(frozen=True)
class Given(GCO):
    """Guidance that proposes constant controls instead of samples: one of `levels` per attempt."""

    levels: tuple[float, ...] = ()

    def update(self, problem, X, U, penalty, key) -> Advice:
        level = self.levels[key.seed // ATTEMPT_SEED_STEP]
        return Advice(penalty, torch.full_like(U, level), torch.ones_like(X[:, 0, 0], dtype=torch.bool))


STAYS, ARRIVES = 1e-3, 4.0  # constant controls; the first are cheap


def given(monkeypatch) -> tuple[Problem, torch.Tensor, AugmentedLagrangian]:
    """A problem in which moving is expensive, zero controls, and a solver that improves nothing."""
    monkeypatch.setattr(LineSearch, "ratio_min", 1e9)
    problem, U0 = planar_batch(B=1, N=25, obstacles=3, seed=3)
    cost = QuadraticCost(Q=[1e-3] * 6, R=[5.0, 5.0], Qf=[1, 1, 0, 0, 0, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    inner = ILQR(tolerance=1e-9, max_iterations=1)
    local = AugmentedLagrangian(inner, max_outer_iterations=3, violation_tolerance=10.0, penalty_growth=1.0)
    return replace(problem, cost=cost, goal=Goal([1.0, 0.4], 1e3)), U0, local


def choose(levels: tuple[float, ...], monkeypatch, share: float, **options) -> Solution:
    """The choice among given trajectories, all caught, none improved; `share` is the goal tolerance."""
    problem, U0, local = given(monkeypatch)
    monkeypatch.setattr("torchgco.lagrangian.quality.GOAL_TOLERANCE", share)
    monkeypatch.setattr("torchgco.solvers.caught.caught_knots", lambda problem, X, *_: torch.ones_like(X[..., 0]) > 0)
    monkeypatch.setattr(NativeKernels, "outer_passes", lambda *_, **__: None)  # which test it in C
    last = ()  # no clearing of chords: trajectories here do collide
    return restarts(local, None, Given(levels=levels), len(levels), last=last, **options).solve(problem, U0)


@pytest.mark.parametrize(
    ("levels", "share", "options", "attempts", "kept"),
    [
        ((ARRIVES, STAYS), 1e-9, {}, 2, STAYS),
        ((ARRIVES, STAYS), 0.5, {}, 1, ARRIVES),
        ((STAYS, ARRIVES), 0.5, {}, 2, ARRIVES),
        ((STAYS, ARRIVES), 0.5, dict(every=True), 2, ARRIVES),
        ((ARRIVES, STAYS), 0.5, dict(every=True), 2, ARRIVES),
        ((ARRIVES, ARRIVES), 0.5, dict(every=True), 2, ARRIVES),
    ],
)
def test_an_arrived_trajectory_is_preferred_to_a_cheaper_one(
    levels, share, options, attempts, kept, solves: list[Solve], monkeypatch
) -> None:
    solution = choose(levels, monkeypatch, share, **options)
    assert len(solves) == 1 + attempts
    assert bool(solution.U.mean() > 3.0) == (kept == ARRIVES)


@pytest.mark.parametrize("by_arrival", [True, False])
def test_an_arrived_iterate_is_kept_within_an_attempt_too(by_arrival: bool, monkeypatch) -> None:
    """The first inner solve arrives; then guidance replaces it by a cheaper trajectory that stays."""
    monkeypatch.setattr("torchgco.lagrangian.quality.GOAL_TOLERANCE", 0.5)
    problem, U0, local = given(monkeypatch)
    call = Call.checked(problem, torch.full_like(U0, ARRIVES))
    end = local.outer_loop(call, Given(levels=(STAYS,)), by_arrival=by_arrival)
    assert bool(end.best.U.mean() > 3.0) == by_arrival


def test_arrived_comes_before_feasible_and_feasible_before_cheap() -> None:
    """Of any two ends (arrived, violation, cost), the better one is kept, in either order."""
    problem, U0 = planar_batch(B=1, N=5, obstacles=1)
    problem = replace(problem, goal=Goal([1.0, 0.4], 1.0))
    call = Call.checked(problem, U0)

    def end(arrived: bool, violation: float, cost: float) -> SolveEnd:
        made = SolveEnd.blank(problem, U0)
        made.best.X[:, -1, :2] = torch.tensor([1.0, 0.4]) if arrived else -1.0
        made.best.violation[:], made.best.cost[:], made.status[:] = violation, cost, int(cost)
        made.iterations[:], made.outer[:], made.guided[:] = 1, 2, 3
        return made

    ordered = [(True, 0.0, 2), (True, 0.0, 3), (False, 0.0, 1), (True, 0.1, 1), (False, 0.2, 1)]
    for i, better in enumerate(ordered):
        for worse in ordered[i + 1 :]:
            for one, other in ((better, worse), (worse, better)):
                best = Best(call, end(*one), LOCAL)
                best.keep(torch.tensor([0]), end(*other))
                assert (float(best.end.best.violation), float(best.end.best.cost)) == better[1:]
                assert int(best.end.status) == better[2]
                assert (int(best.end.iterations), int(best.end.outer), int(best.end.guided)) == (2, 4, 6)
