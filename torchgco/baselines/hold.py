"""Hold: the initial guess flown unchanged. It shows how weak the outcome `feasible` alone is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.options import Positive
from torchgco.base.status import Status
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import measured
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver


@dataclass(frozen=True)
class Hold(Solver, named="solver"):
    """Solves nothing: returns the trajectory of U0.

    Args:
        violation_tolerance: violation (metres for lengths) up to which a trajectory counts as feasible.

    Raises:
        InputError: a field out of its range.
    """

    violation_tolerance: Positive = ADMITTED

    def run(self, call: Call) -> Solution:
        """U0 rolled out."""
        return rolled_out(call.problem, call.U0, self.violation_tolerance, iterations=0)


def rolled_out(problem: Problem, U: Tensor, violation_tolerance: float, iterations: int) -> Solution:
    """A solution without gains or multipliers from controls that no local solver refined: FEASIBLE at best."""
    X = open_loop(problem.dynamics, problem.x0, U)
    cost, worst = problem.cost.total(X, U), measured(problem, X, U)
    status = torch.full((problem.B,), int(Status.FEASIBLE), device=U.device)
    status[worst > violation_tolerance] = Status.INFEASIBLE
    status[~problem.start_is_clear] = Status.INVALID_START
    status[~(torch.isfinite(cost) & torch.isfinite(worst))] = Status.NON_FINITE
    none = torch.zeros_like(status)
    return Solution(
        X=X, U=U.clone(), K=U.new_zeros(*U.shape, problem.n), d=torch.zeros_like(U),
        multipliers=Multipliers.zero(problem, 0.0), cost=cost, violation=worst, status=status,
        iterations=torch.full_like(none, iterations), outer_iterations=none, guided=none.clone(),
    )  # fmt: skip
