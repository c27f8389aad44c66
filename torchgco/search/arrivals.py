"""Where the time is free and obstacles move: guesses along ways that arrive at times of their own.

A gap that is open now is shut later, so what a trajectory costs has a minimum for each that it takes, which a local
solve doesn't leave. The lattice in space and time ends its ways at whichever layer costs least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.constraints.gates import gates_of
from torchgco.problem.in_time import factor_state, factors_in
from torchgco.problem.problem import Problem
from torchgco.roadmap.timed import TimedScene, TimedWays, library_for, timed_ways
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.timed import DEARER, PROBLEMS_AT_ONCE, Timed, guesses_in_time
from torchgco.search.timed_scenes import Span, can_search, scene_in_time
from torchgco.solvers.contracts import Call

FINER = 0.5, 0.25  # shares of the usual spacing: the first gap that can be reached decides on the time
PUSH = 0.7  # share of the strongest acceleration, which along both axes is as much along each: the least time takes it


@dataclass(frozen=True)
class Arrivals:
    """Guesses for problems with a free time, along up to `ways` ways of each.

    Args:
        ways: classes of ways, at most.
    """

    ways: int

    @classmethod
    def of(cls, rows: Sequence[object], problem: Problem) -> Arrivals | None:
        """As many as a table's row among what moves; None where there is none, or it can't serve these problems."""
        row = next((one for one in rows if isinstance(one, Timed)), None)
        at = problem.position
        if row is None or gates_of(problem) is not None or not can_search(problem):
            return None
        return None if library_for(at.stop - at.start) is None else cls(row.ways)

    def calls(self, problem: Problem, call: Call) -> tuple[Tensor, Tensor, Call]:
        """Which problem each guess is of (C,), its number among those of the problem (C,), and a call from all guesses.

        Args:
            problem: the user's, whose time has one factor.
            call: of the problem in free time, with states and controls to begin with.
        """
        X = _free(call)
        factors = factors_in(problem, X)[:, 0]
        sound = torch.isfinite(problem.x0).all(-1).tolist()  # no way leads from NaN
        found: list[TimedWays] = [TimedWays([], X.new_zeros(0).numpy(), 1.0) for _ in range(problem.B)]
        for finer in FINER:
            left = [b for b, ways in enumerate(found) if sound[b] and not ways.points]
            for first in range(0, len(left), PROBLEMS_AT_ONCE):
                rows = left[first : first + PROBLEMS_AT_ONCE]
                scenes = [_scene(problem, b, X[b], float(factors[b]), finer) for b in rows]
                for b, ways in zip(rows, timed_ways(scenes, self.ways, DEARER), strict=True):
                    found[b] = ways
        each = torch.tensor([b for b, ways in enumerate(found) for _ in ways.points], dtype=torch.int64)
        each = each.to(problem.x0.device)
        number = torch.cat([torch.arange(len(ways.points)) for ways in found]).to(each.device)
        factors, X, U = guesses_in_time(problem, call.problem, each, found)
        many = call.take(each)
        x0 = many.problem.x0.clone()
        x0[:, problem.n] = factors[:, 0]
        begun = many.problem._with({"x0": x0}, many.problem.known)
        return each, number, replace(many, problem=begun, X0=X, U0=U, callback=None)


def _scene(problem: Problem, b: int, X: Tensor, factor: float, finer: float) -> TimedScene:
    one, dt = problem.take(torch.tensor([b], device=X.device)), float(problem.dynamics.dt)
    assert one.time is not None
    whole = problem.N * dt
    span = Span(factor * dt, float(one.time.least) * whole, float(one.time.most) * whole, float(one.time.weight), PUSH)
    return scene_in_time(one, X[:, : problem.n], finer, span)


def _free(call: Call) -> Tensor:
    """Trajectories without obstacles, (B, N+1, n), in their own times; the guess where there is none."""
    bare = without_obstacles(call.problem)
    X = call.X0
    assert X is not None
    if bare is None:
        return X
    end = WITHOUT_OBSTACLES.solved(replace(call, problem=bare, warm=None, callback=None), X)
    good = torch.isfinite(end.best.cost) & (end.best.violation <= WITHOUT_OBSTACLES.violation_tolerance)
    good &= torch.isfinite(end.best.X[..., factor_state(call.problem)]).all(-1)
    return torch.where(good.view(-1, 1, 1), end.best.X, X)
