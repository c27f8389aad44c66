"""Problems that stay packed for iLQR in C from one inner solve to the next."""

from __future__ import annotations

import math

import torch

from torchgco.base.status import Status
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.native import structures as c
from torchgco.native.engine import Engine, run
from torchgco.native.kept_problem import KeptProblem
from torchgco.native.packing import is_bounded
from torchgco.problem.problem import Problem

ZEROED = "regularisation", "inner", "iterations", "rung", "status", "converged", "refused", "lost", "alpha", "used"
STATE_TYPES = {
    **dict.fromkeys(("inner", "iterations", "rung"), torch.int64),
    **dict.fromkeys(("status", "converged", "refused", "lost"), torch.int32),
}


class KeptDescent(KeptProblem):
    """Kept problems for inner solves: the same bits as `solvers.ilqr.descend`, which packs its problems again.

    Args:
        engine, problem: see `KeptProblem`.
        options: of the descent; phr: the form of inequalities' terms, as of a `Lagrangian`.
    """

    def __init__(self, engine: Engine, problem: Problem, options: c.Options, phr: bool) -> None:
        super().__init__(engine, problem)
        B, like = problem.B, problem.x0
        self.mu = like.new_zeros(B)
        names = ("cost", "merit", *ZEROED)
        state = {name: torch.zeros(B, dtype=STATE_TYPES.get(name, torch.float64)) for name in names}
        bounded = int(engine.cost is None and is_bounded(problem.cost))
        self.packed.fill({"mu": self.mu, "phr": phr, "bounded": bounded, "options": options, **state})
        self.packed.fill({"limit": options.max_iterations, "replicas": engine.replicas_of(B)})
        self.worst = like.new_zeros(B)
        self._measured = self.packed.copy()
        self._measured.fill({"merit": self.worst})
        # The same memory by NumPy, which takes a small share of PyTorch's time for a few numbers.
        self._x0, self._X, self._U = (tensor.numpy() for tensor in (problem.x0, self.X, self.U))
        self._lam, self._mu = [tensor.numpy() for tensor in self.lam], self.mu.numpy()
        self._state = {name: tensor.numpy() for name, tensor in state.items()}

    def solve(self, U: torch.Tensor, multipliers: Multipliers) -> bool:
        """One inner solve of every problem from controls U (B, N, m), into `X` and `U`.

        False where C can't make it alone, as rollouts diverge or aren't finite; `X` and `U` then hold nothing.
        """
        B, library, state = self.problem.B, self.engine.library, self._state
        self._X[:, 0], self._U[:], self._mu[:] = self._x0, U.numpy(), multipliers.mu.numpy()
        for target, lam in zip(self._lam, multipliers.lam, strict=True):
            target[:] = lam.numpy()
        for name in ZEROED:
            state[name][:] = 0
        run(library.tgco_open_loop, B, self.engine.lanes, self.packed)
        run(library.tgco_value, B, self.engine.lanes, self.packed)
        if not math.isfinite(state["merit"].sum() + self._X.sum()):  # what overflows is left to others, too
            return False
        run(library.tgco_ilqr, B, self.engine.lanes, self.packed)
        return not ((state["status"] == Status.RUNNING).any() or state["lost"].any())

    def violation(self) -> torch.Tensor:
        """The largest violation (B,) of `X` and `U`, of problems that the library `measures`."""
        run(self.engine.library.tgco_violation, self.problem.B, self.engine.lanes, self._measured)
        return self.worst.clone()
