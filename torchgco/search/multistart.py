"""Random restarts: many guesses, the best result kept. Guidance is useful only if it beats them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch

from torchgco.base.draws import DrawKey, smooth_normal
from torchgco.base.options import AtLeast, Count, check_options
from torchgco.base.status import STALLED, Status
from torchgco.guidance.mppi import diagonal
from torchgco.search.search import Best
from torchgco.solution import Solution
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Solver
from torchgco.solvers.session import Session

GAVE_UP = Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, STALLED  # where another guess might have done


@dataclass(frozen=True)
class MultiStart(Solver):
    """A local solver from the given guess, then from random guesses around it, until its iterations are spent.

    The best result is returned: one that arrives before one that is feasible, then the cheapest. Counts of iterations
    are those of all starts.

    Args:
        local: solves from each guess.
        starts: number of guesses at most, the given one included.
        budget: iterations per problem, of all its starts together, after which no further guess is tried: the last
            start may exceed it. None: all are tried.
        covariance: of the guesses around the given one, a diagonal (m,) or one number, in squared units of the
            controls.
        noise_knots: number of random values, evenly spaced in time; the noise is linear between them.

    Raises:
        InputError: a field out of its range; on `solve`, a covariance that doesn't fit the controls.
    """

    local: AugmentedLagrangian = AugmentedLagrangian()
    starts: Count = 8
    budget: Count | None = None
    covariance: Any = 1.0
    noise_knots: Annotated[int, AtLeast(2)] = 10

    def __post_init__(self) -> None:
        check_options(self, "multistart")

    def in_closed_loop(self, rounds: int) -> tuple[Solver, Solver]:
        """The solver itself, and the local solver."""
        return self, replace(self.local, max_outer_iterations=rounds).in_closed_loop(rounds)[1]

    def in_slots(self, slots: int) -> MultiStart:
        """The same solver with at most `slots` problems at a time."""
        return replace(self, local=self.local.in_slots(slots))

    def run(self, call: Call) -> Solution:
        """Solve a checked call; guesses are keyed by (seed, id, start), and the warm start serves the first."""
        solver, sigma = self.local, diagonal(self.covariance, call.problem, "multistart.covariance")
        session = Session(call, solver.inner.as_printed)
        scaled = session.call
        guidance = None if solver.guidance is None else solver.guidance.suited(scaled.problem)
        best = Best(scaled, solver.outer_loop(scaled, guidance), solver)
        left = call.problem.start_is_clear & torch.isfinite(call.problem.x0).all(-1)  # no guess helps an invalid start
        for start in range(1, self.starts):
            rows = (left if self.budget is None else left & (best.end.iterations < self.budget)).nonzero().flatten()
            if rows.numel() == 0:
                break
            if call.late:
                ended = best.end.status[rows]
                gave_up = torch.stack([ended == reason for reason in GAVE_UP]).any(0)
                best.end.status[rows] = torch.where(gave_up, int(Status.TIME_LIMIT), ended)
                break
            part = scaled.take(rows)
            key = DrawKey(call.seed, part.ids, torch.full_like(rows, start))
            noise = sigma.sqrt() * smooth_normal(key, self.noise_knots, part.U0)
            best.improve(rows, replace(part, U0=part.U0 + noise, warm=None), guidance=guidance)
        return session.finished(best.end, solver.violation_tolerance, solver.slots)
