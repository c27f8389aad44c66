"""Plain MPPI: the sampler alone, iterated open loop."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch

from torchgco.base.draws import DrawKey
from torchgco.base.errors import GuidanceWarning, InputError
from torchgco.base.options import Count, Positive
from torchgco.base.status import Status
from torchgco.baselines.hold import rolled_out
from torchgco.guidance.gco import suited_sampler
from torchgco.guidance.mppi import MPPI
from torchgco.kernels import measured
from torchgco.lagrangian.quality import is_better
from torchgco.obstacles.base import ADMITTED
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver


@dataclass(frozen=True)
class IteratedMPPI(Solver, named="solver"):
    """Algorithm 3 repeated, each time around its last mean; the best iterate is kept.

    Feasible before infeasible; of feasible iterates the cheapest, of infeasible ones the least violated. The initial
    guess doesn't count. A limit of time is looked at after each repetition.

    Args:
        sampler: draws and weighs the samples.
        iterations: number of repetitions.
        violation_tolerance: violation (metres for lengths) up to which an iterate counts as feasible.

    Raises:
        InputError: a field out of its range.
    """

    sampler: MPPI = MPPI()
    iterations: Count = 20
    violation_tolerance: Positive = ADMITTED

    def run(self, call: Call) -> Solution:
        """Sample around U0; draws are keyed by (seed, id, iteration).

        Raises:
            InputError: the parts of the problem can't be evaluated for samples.
        """
        problem, ids = call.problem, call.ids
        sampler, lost = suited_sampler(self.sampler, problem)
        if sampler is None:
            raise InputError("problem", "parts that can be evaluated for many samples at once", lost)
        if lost is not None:
            warnings.warn(lost, GuidanceWarning, stacklevel=2)
        U = best = call.U0
        best_cost = best_violation = torch.full_like(problem.x0[:, 0], torch.inf)
        done = 0
        while done < self.iterations and not (done and call.late):
            X, U = sampler.improve(problem, U, DrawKey(call.seed, ids, torch.full_like(ids, done)))
            cost, worst = problem.cost.total(X, U), measured(problem, X, U)
            better = is_better(cost, worst, best_cost, best_violation, self.violation_tolerance)
            best = torch.where(better.view(-1, 1, 1), U, best)
            best_cost = torch.where(better, cost, best_cost)
            best_violation = torch.where(better, worst, best_violation)
            done += 1
        solution = rolled_out(problem, best, self.violation_tolerance, done)
        if done < self.iterations:
            solution.status[solution.status == Status.INFEASIBLE] = Status.TIME_LIMIT
        return solution
