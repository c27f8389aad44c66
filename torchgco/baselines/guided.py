"""FATROP from a plan along the roadmap's best path: what the geometric proposal gives to a solver that isn't ours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.baselines.casadi import CasADiSolver, PreparedCasADi
from torchgco.guidance.detour import Detour
from torchgco.lagrangian import Multipliers
from torchgco.native.dispatch import engine_of
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.batch import check_call
from torchgco.solvers.state import Callback


class Guess(NamedTuple):
    """Where a solver is to start."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether U follows a path
    iterations: Tensor  # (B,) int64: of all paths that were followed


@dataclass(frozen=True)
class GuidedCasADi:
    """A `CasADiSolver` whose initial guess is what `Detour.propose` follows; the given one where there is no path.

    Its plan may lie in an obstacle (`Detour.depth`): an interior-point solver pushes it out itself.

    Args:
        solver: solves each problem from that guess.
        detour: finds and follows the paths, of all problems at once.
    """

    solver: CasADiSolver = CasADiSolver("fatrop")
    detour: Detour = Detour(ways=4, settle=0, depth=1.0)

    def prepare(self, problem: Problem) -> PreparedGuided:
        """As `CasADiSolver.prepare`; the guess belongs to the solve.

        Raises:
            InputError: what `CasADiSolver.prepare` raises; a problem without a position, or pushes that don't fit it.
        """
        self.detour.check(problem)
        engine_of(problem)  # compiled now, so that no solve waits for it
        return PreparedGuided(self, self.solver.prepare(problem))

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
    ) -> Solution:
        """As `CasADiSolver.solve`; `guided` is 1 where the guess was a path's, and `iterations` counts the following.

        Raises:
            InputError: U0 or ids don't fit the problem, and what `prepare` raises.
        """
        return self.prepare(problem).solve(problem, U0, seed, ids, warm, callback)

    def guess(self, problem: Problem, U0: Tensor) -> Guess:
        """Where `solve` starts: controls that follow each best path, U0 (B, N, m) where there is none."""
        zero = torch.zeros(problem.B, dtype=torch.int64, device=U0.device)
        guess = Guess(U0.clone(), torch.zeros_like(zero, dtype=torch.bool), zero)
        rows = (problem.start_is_clear & torch.isfinite(problem.x0).all(-1)).nonzero().flatten()
        if rows.numel() > 0:
            plan = self.detour.propose(problem.take(rows))
            guess.found[rows], guess.iterations[rows] = plan.found, plan.iterations
            guess.U[rows[plan.found]] = plan.U[plan.found]
        return guess


@dataclass(frozen=True)
class PreparedGuided:
    """A GuidedCasADi with the program of one batch, built."""

    guided: GuidedCasADi
    prepared: PreparedCasADi

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
    ) -> Solution:
        """As `GuidedCasADi.solve`.

        Raises:
            InputError: another problem than the prepared one; U0 or ids don't fit it.
        """
        check_call(problem, U0, ids)
        guess = self.guided.guess(problem, U0)
        solution = self.prepared.solve(problem, guess.U, seed, ids, warm, callback)
        return replace(solution, guided=guess.found.long(), iterations=guess.iterations + solution.iterations)
