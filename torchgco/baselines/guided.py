"""FATROP from a proposal along the best path of the roadmap: shows what the search gains for another solver."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import check_options
from torchgco.baselines.casadi import CasADiSolver
from torchgco.kernels import kernels_of
from torchgco.problem.problem import Problem
from torchgco.search.proposals import PathProposals, propose
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver


class Guess(NamedTuple):
    """Initial guesses."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether U follows a path
    iterations: Tensor  # (B,) int64: of all candidates


@dataclass(frozen=True)
class GuidedCasADi(Solver):
    """A `CasADiSolver` whose initial guess is a path proposal; the given guess where there is no path.

    The proposal may lie in an obstacle (`PathProposals.max_penetration`): an interior-point solver pushes it out.

    Args:
        solver: solves each problem from that guess.
        passes: make the proposals, for all problems at once.

    Raises:
        InputError: a field of another kind.
    """

    solver: CasADiSolver = CasADiSolver("fatrop")
    passes: tuple[PathProposals, ...] = (PathProposals(num_paths=4, relax_iterations=0, max_penetration=1.0),)

    def __post_init__(self) -> None:
        check_options(self, "solver")
        object.__setattr__(self, "passes", tuple(self.passes))
        if not self.passes or self.passes[0].continues:
            raise InputError("solver.passes", "path proposals, the first for problems without any", self.passes)

    def prepare(self, problem: Problem) -> Solver:
        """As `CasADiSolver.prepare`; the guess is part of the solve.

        Raises:
            InputError: as from `CasADiSolver.prepare`; no position, or initial offsets that don't fit the controls.
        """
        for proposals in self.passes:
            for follow in proposals.follow:
                follow.starts(problem, problem.at_rest[1])
        kernels_of(problem)  # compiled now, so that no solve waits for it
        return PreparedGuided(self, self.solver.prepare(problem))

    def run(self, call: Call) -> Solution:
        """As `CasADiSolver.run`; `guided` is 1 where the guess follows a path; its candidates count in `iterations`."""
        return self.prepare(call.problem).run(call)

    def guess(self, problem: Problem, U0: Tensor) -> Guess:
        """The initial guesses of a solve: controls along the best path, U0 (B, N, m) where there is none."""
        zero = torch.zeros(problem.B, dtype=torch.int64, device=U0.device)
        guess = Guess(U0.clone(), torch.zeros_like(zero, dtype=torch.bool), zero)
        rows = (problem.start_is_clear & torch.isfinite(problem.x0).all(-1)).nonzero().flatten()
        if rows.numel() > 0:
            plan = propose(self.passes, problem.take(rows))
            guess.found[rows], guess.iterations[rows] = plan.found, plan.iterations
            guess.U[rows[plan.found]] = plan.U[plan.found]
        return guess


@dataclass(frozen=True)
class PreparedGuided(Solver):
    """A GuidedCasADi with the program of one batch, built."""

    guided: GuidedCasADi
    prepared: Solver

    kernels: ClassVar[str | None] = "casadi"

    def run(self, call: Call) -> Solution:
        """As `GuidedCasADi.run`; InputError for another problem than the prepared one."""
        guess = self.guided.guess(call.problem, call.U0)
        solution = self.prepared.run(replace(call, U0=guess.U))
        return replace(solution, guided=guess.found.long(), iterations=guess.iterations + solution.iterations)
