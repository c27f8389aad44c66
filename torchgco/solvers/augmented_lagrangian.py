"""Augmented Lagrangian around a local solver, with a place for guidance (Algorithms 1 and 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.errors import InputError
from torchgco.lagrangian import Multipliers
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.batch import Loop
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.polish import Polish
from torchgco.solvers.state import Callback, Guidance, InnerEnd
from torchgco.status import Status


@dataclass(frozen=True)
class AugmentedLagrangian:
    """AL-iLQR; with `guidance`, the paper's GCO or whatever else speaks its protocol.

    Args:
        inner: the local solver.
        guidance: asked after every inner solve where the next one should be drawn to; None for none.
        initial_penalty, penalty_growth, penalty_max: mu, its factor eta per outer iteration, and its ceiling.
        grow_when_feasible: mu grows after every inner solve (as printed), or only while the violation is over its
            tolerance, which spares feasible iterates a stiffer problem.
        max_outer_iterations: outer limit; the paper's only end.
        violation_tolerance: what counts as feasible (metres for lengths), for the status and the best iterate.
        cost_tolerance: end early once an inner solve converged, its violation is under the tolerance and J_var
            changed by less than this share since the one before. None: never, as in the paper.
        hold_factor: where guidance puts another path in place of the iterate, the penalty is raised until the path that
            is left costs at least this times what the new one costs more (not in the paper).
        attempts: where guidance puts another path in place of the iterate, so many are tried from the same caught path,
            each to its end, and the best is kept; max_outer_iterations then counts for each (not in the paper).
        arrival: a feasible iterate has arrived where it ends within this share of the distance from start to goal. One
            that has is worth more than one that hasn't, whatever they cost, and ends the attempts. Where all attempts
            are made and the best path ends within twice that distance, a last one draws its end to the goal (guided
            problems alone). None: cost alone decides, as in the paper.
        thorough: all attempts are made, even after one has arrived; the cheapest path is kept.
        clip: inequalities push but never pull (`lagrangian.penalty_weights`); False as printed.
        slots: problems worked on at once; the others wait until a slot falls free. None: all. No result depends on it.
        polish: a last stage of Newton steps on what was found, elements one by one; None for none, as in the paper.
        record: keep the history of every element in `solution.trace`.

    Raises:
        InputError: a field out of its range.
    """

    inner: ILQR = ILQR()
    guidance: Guidance | None = None
    initial_penalty: float = 20.0
    penalty_growth: float = 2.2
    penalty_max: float = 1e12
    grow_when_feasible: bool = True
    max_outer_iterations: int = 10
    violation_tolerance: float = 1e-3
    cost_tolerance: float | None = None
    hold_factor: float = 10.0
    attempts: int = 1
    arrival: float | None = None
    thorough: bool = False
    clip: bool = False
    slots: int | None = None
    polish: Polish | None = None
    record: bool = False

    def __post_init__(self) -> None:
        if not self.initial_penalty > 0:
            raise InputError("solver.initial_penalty", "above 0", self.initial_penalty)
        if not self.penalty_growth >= 1:
            raise InputError("solver.penalty_growth", "at least 1", self.penalty_growth)
        if not self.penalty_max >= self.initial_penalty:
            raise InputError("solver.penalty_max", "at least initial_penalty", self.penalty_max)
        if self.max_outer_iterations < 1:
            raise InputError("solver.max_outer_iterations", "at least 1", self.max_outer_iterations)
        if not self.violation_tolerance > 0:
            raise InputError("solver.violation_tolerance", "above 0", self.violation_tolerance)
        if self.attempts < 1:
            raise InputError("solver.attempts", "at least 1", self.attempts)
        if self.arrival is not None and not 0 < self.arrival < 1:
            raise InputError("solver.arrival", "between 0 and 1, or null", self.arrival)
        if self.slots is not None and self.slots < 1:
            raise InputError("solver.slots", "at least 1, or null", self.slots)
        if not self.hold_factor >= 1:
            raise InputError("solver.hold_factor", "at least 1", self.hold_factor)
        if self.cost_tolerance is not None and not self.cost_tolerance > 0:
            raise InputError("solver.cost_tolerance", "above 0, or null", self.cost_tolerance)

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve every problem of the batch.

        Args:
            problem: B problems.
            U0: initial controls (B, N, m).
            seed, ids: key the random draws; an element's result depends on (seed, id), not on its place. ids is
                int64 (B,), 0..B-1 unless given.
            warm: multipliers and penalties to start from, as a former solution's `multipliers`.
            callback: told of the progress after every pass.

        Raises:
            InputError: U0, ids or warm don't fit the problem, or it isn't float64 and is to be polished.
        """
        if self.polish is not None:
            self.polish.check(problem)
        solution = Loop(self, problem, U0, seed, ids, warm, callback).run()
        return solution if self.polish is None else self.polish.refine(problem, solution)

    def verdict(self, inner: InnerEnd) -> Tensor:
        """Why an element ends: its outer limit, or the early test (CONVERGED); else RUNNING."""
        status = torch.full_like(inner.outer, Status.RUNNING)
        over = inner.outer >= self.max_outer_iterations
        status[over & inner.refused] = Status.LINE_SEARCH_FAILED
        status[over & ~inner.refused] = Status.MAX_ITERATIONS
        if self.cost_tolerance is not None:
            settled = (inner.cost - inner.last_cost).abs() <= self.cost_tolerance * inner.cost.abs()
            done = inner.converged & settled & (inner.violation <= self.violation_tolerance)
            status[done] = Status.CONVERGED
        return status
