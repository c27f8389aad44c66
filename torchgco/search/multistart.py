"""Many random guesses, the best result kept: what guidance must beat to be worth anything."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchgco.draws import DrawKey, standard_normal
from torchgco.errors import InputError
from torchgco.lagrangian import Multipliers, is_better
from torchgco.problem import Problem
from torchgco.shapes import check_shape, tensor
from torchgco.solution import Solution
from torchgco.solvers.attempts import has_arrived
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.batch import check_call
from torchgco.solvers.state import Callback
from torchgco.tree import copied, put


@dataclass(frozen=True)
class MultiStart:
    """A local solver from the given guess, then from random ones around it, until its iterations are spent.

    An arrived and feasible result beats a feasible one, which beats all others; among equals the cheaper one is kept.

    Args:
        solver: solves from each guess; without guidance, unless guided starts are what is wanted.
        starts: guesses, at most, the given one included.
        budget: iterations of each problem, of all its starts together and counted as `Solution.iterations` does, after
            which no further guess is tried: the last start may exceed it. None: all are tried.
        covariance: of the guesses around the given one, a diagonal (m,) or one number, in the units of the inputs.
        knots: guesses are linear between so many random points in time.
        arrival: share of the distance from start to goal within which a path has arrived.

    Raises:
        InputError: a field out of its range.
    """

    solver: AugmentedLagrangian = AugmentedLagrangian()
    starts: int = 8
    budget: int | None = None
    covariance: Any = 1.0
    knots: int = 10
    arrival: float = 0.09

    def __post_init__(self) -> None:
        for name, least in (("starts", 1), ("knots", 2)):
            if getattr(self, name) < least:
                raise InputError(f"multistart.{name}", f"at least {least}", getattr(self, name))
        if self.budget is not None and self.budget < 1:
            raise InputError("multistart.budget", "at least 1, or null", self.budget)
        if not 0 < self.arrival < 1:
            raise InputError("multistart.arrival", "between 0 and 1", self.arrival)

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve from U0 (B, N, m) and around it; guesses are keyed by (seed, id, start). warm serves the first start.

        `iterations` and `outer_iterations` of the solution are those of all starts together.

        Raises:
            InputError: U0, ids, warm or the covariance don't fit the problem.
        """
        ids = check_call(problem, U0, ids)
        sigma = self._sigma(problem)
        best = self.solver.solve(problem, U0, seed, ids, warm, callback)
        left = problem.start_is_clear & torch.isfinite(problem.x0).all(-1)  # elsewhere no guess helps
        for start in range(1, self.starts):
            rows = (left if self.budget is None else left & (best.iterations < self.budget)).nonzero().flatten()
            if rows.numel() == 0:
                break
            part = problem.take(rows)
            guess = U0[rows] + self._noise(DrawKey(seed, ids[rows], torch.full_like(rows, start)), problem.N, sigma)
            new = self.solver.solve(part, guess, seed, ids[rows], None, _for_part(callback, rows))
            best = self._joined(part, best, rows, new)
        return best

    def _joined(self, problem: Problem, best: Solution, rows: Tensor, new: Solution) -> Solution:
        """`best` with what is better in `new`, of the elements in `rows`; the iterations of both."""
        old, limit = best.take(rows), self.solver.violation_tolerance
        arrived, before = (has_arrived(problem, path, self.arrival, limit) for path in (new, old))
        better = is_better(new.cost, new.violation, old.cost, old.violation, limit)
        better = torch.where(arrived == before, better, arrived).nonzero().flatten()
        result = copied(replace(best, trace=None))
        put(result, rows[better], new.take(better))
        result.iterations[rows] = old.iterations + new.iterations
        result.outer_iterations[rows] = old.outer_iterations + new.outer_iterations
        return result

    def _noise(self, key: DrawKey, N: int, sigma: Tensor) -> Tensor:
        """(B, N, m), linear between knots."""
        m = sigma.numel()
        z = standard_normal(key, self.knots * m, range(1), sigma.dtype).view(self.knots, m, -1).permute(2, 0, 1)
        place = torch.linspace(0, self.knots - 1, N, dtype=sigma.dtype, device=sigma.device)
        left = place.floor().clamp(max=self.knots - 2).long()
        return sigma.sqrt() * torch.lerp(z[:, left], z[:, left + 1], (place - left).view(-1, 1))

    def _sigma(self, problem: Problem) -> Tensor:
        sigma = tensor(self.covariance, "multistart.covariance", problem.x0)
        sigma = sigma.expand(problem.m) if sigma.dim() == 0 else sigma
        check_shape(sigma, (problem.m,), "multistart.covariance")
        if not bool((sigma > 0).all()):
            raise InputError("multistart.covariance", "variances above 0", sigma.tolist())
        return sigma


def _for_part(callback: Callback | None, rows: Tensor) -> Callback | None:
    """The callback of a batch for a solve of its problems `rows` alone."""
    if callback is None:
        return None
    return lambda progress: callback(replace(progress, rows=rows[progress.rows]))
