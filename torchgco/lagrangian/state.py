"""The running state of the solvers, and how an augmented-Lagrangian solve ends."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.tree import copied
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.penalties import Penalty
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Iterate:
    """A trajectory with its multipliers, cost and violation."""

    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    multipliers: Multipliers
    cost: Tensor  # (B,): J_var
    violation: Tensor  # (B,)


@dataclass
class InnerState:
    """The state of inner solves; the first dimension of every tensor is the running batch, b problems."""

    rows: Tensor  # place in the batch
    X: Tensor  # (b, N+1, n)
    U: Tensor  # (b, N, m)
    cost: Tensor  # (b,): J_var
    merit: Tensor  # (b,): L_M
    regularisation: Tensor  # mu_r
    inner: Tensor  # iterations of this inner solve
    iterations: Tensor
    rung: Tensor  # int64: first rung of the next line search


@dataclass(frozen=True)
class PassEnd:
    """How a pass ended for every running problem, (B,)."""

    ended: Tensor  # bool: the inner solve has ended
    converged: Tensor  # bool
    stuck: Tensor  # bool: no step length was acceptable, and no regularisation is left to try
    status: Tensor  # int64: RUNNING, or why the whole solve of the problem ends here
    alpha: Tensor  # step length of the last iteration
    used: Tensor  # mu_r of the last iteration
    failed: Tensor  # bool: the backward pass failed, and no iteration was made


@dataclass
class State(InnerState):
    """The state of outer loops."""

    multipliers: Multipliers
    penalty: Penalty | None  # of guidance
    outer: Tensor  # inner solves ended
    guided: Tensor  # outer iterations with guidance on
    replaced: Tensor  # bool: guidance replaced the iterate, and isn't called again
    last_cost: Tensor  # J_var at the end of the previous inner solve
    best: Iterate  # best iterate that ended an inner solve; infinite violation before the first


@dataclass(frozen=True)
class SolveEnd:
    """How every problem of a call ended, (B, ...), in the units that the solver worked in."""

    best: Iterate  # the best that ended an inner solve, else the last
    last: Iterate
    status: Tensor  # int64: a Status, or STOPPED
    iterations: Tensor
    outer: Tensor
    guided: Tensor

    @classmethod
    def blank(cls, problem: Problem, U: Tensor) -> SolveEnd:
        """An end to be filled in, for controls like U (B, N, m)."""
        count = torch.zeros(problem.B, dtype=torch.int64, device=U.device)
        X, worth = U.new_zeros(problem.B, problem.N + 1, problem.n), U.new_zeros(problem.B)
        best = Iterate(X, U.clone(), Multipliers.zero(problem, 0.0), worth, worth.clone())
        return cls(best, copied(best), count, count.clone(), count.clone(), count.clone())
