"""One solve from the call to the solution: units of cost, the record, and the verdict."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchgco.base.errors import TraceWarning
from torchgco.base.status import STOPPED, Status, is_over
from torchgco.base.tree import is_users, put, spread, take
from torchgco.constraints.base import Constraint
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import kernels_of, measured, reproducible
from torchgco.lagrangian.lagrangian import Iterate, Lagrangian, SolveEnd
from torchgco.lagrangian.quality import violation
from torchgco.problem.covered import covered_goals
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.ending import Optimality, Recorder, final_status, optimality
from torchgco.solvers.unbounded import falls_without_end

# Where a required goal is covered by an obstacle, the reason is known; these say only how the solve came to its end.
GAVE_UP = Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, Status.NOT_POSITIVE_DEFINITE
UNLIKE = 1e-6  # difference of two rollouts' steps, as a share of the largest state, that no rounding explains


class Session:
    """One solve of a call.

    Args:
        given: the call in the user's units.
        as_printed: the form of the algorithm, as of `ILQR`.
        own_units: `call` has costs in their own units, as it has as printed; else in units of `Problem.cost_unit`, so
            that scaling all weights changes no iterate. `unit` (B,) are these. The costs of ends are then PyTorch's.
        record: keep the history of every problem in `recorder`.
    """

    def __init__(self, given: Call, as_printed: bool = False, own_units: bool = False, record: bool = False) -> None:
        self.given, self.as_printed, self._own_costs = given, as_printed, own_units
        self.call, self.unit = given, torch.ones_like(given.problem.x0[:, 0])
        if not (as_printed or own_units):
            self.call, self.unit = given.in_cost_units()
        self.recorder = Recorder() if record else None

    @property
    def constant(self) -> Tensor:
        """What was taken from each problem's cost, (B,)."""
        return torch.zeros_like(self.unit) if self.call is self.given else self.given.problem.cost_scale.constant

    @property
    def scales(self) -> tuple[Tensor, Tensor]:
        """Units and constants of the costs, by place in the batch that the user passed."""
        return spread(self.unit, self.call.rows), spread(self.constant, self.call.rows)

    def finished(self, end: SolveEnd, tolerance: float, slots: int | None = None) -> Solution:
        """The best trajectories with gains and statuses, in the user's units.

        Args:
            tolerance: violation up to which a trajectory is feasible.
            slots: problems whose gains are computed together; None: all.
        """
        problem, looked = self.call.problem, self._looked_at(end.best, slots)
        result, unlike = self._by_users_model(self._returned(end.best, looked.gains, looked.worst, looked.sensitive))
        K, d, left = looked.gains[..., :-1].contiguous(), looked.gains[..., -1].contiguous(), looked.left
        left = torch.where(unlike, left.clamp(min=1.0), left)
        if problem.free_start is not None:  # stationary for this start alone, unless the interior point chose it
            left = torch.where(problem.free_start.any(-1) & ~is_over(end.status), left.clamp(min=1.0), left)
        limit = Status.TIME_LIMIT if self.given.late else Status.MAX_ITERATIONS
        ended = torch.where(end.status == STOPPED, int(limit), end.status)
        constrained = bool(problem.constraints) or problem.free_start is not None
        finite = torch.isfinite(result.cost) & torch.isfinite(result.violation)
        finite &= torch.isfinite(result.X).flatten(1).all(-1)
        ended = torch.where(finite | (ended == Status.INVALID_START), ended, int(Status.NON_FINITE))
        status = final_status(ended, left, result.violation, tolerance, constrained)
        user = self.given.problem
        covered = covered_goals(user)
        if bool(covered.any()):
            gave_up = torch.stack([status == reason for reason in GAVE_UP]).any(0)
            status = torch.where(gave_up & covered, int(Status.INFEASIBLE), status)
        falls = falls_without_end(user, self.given.U0, result, left, tolerance)
        status = torch.where(falls, int(Status.UNBOUNDED), status)
        return Solution(
            result.X, result.U, K, d, result.multipliers, result.cost, result.violation, status,
            end.iterations, end.outer, end.guided,
            None if self.recorder is None else self.recorder.frame(*self.scales),
        )  # fmt: skip

    def _by_users_model(self, best: Iterate) -> tuple[Iterate, Tensor]:
        """The trajectories with states of the user's own model, and where (B,) those of its compiled code are others.

        They may be: at a jump of the model, for which rounding decides; where the model gives NaN and compiled code
        doesn't; and where what the model does depends on more than its arguments, which the TraceWarning says.
        """
        user = self.given.problem
        unlike = torch.zeros_like(best.cost, dtype=torch.bool)
        if not kernels_of(user).compiled or not is_users(user.dynamics) or best.U.numel() == 0:
            return best, unlike
        X = best.X[:, 1:]
        gap = (user.along.step(best.X[:, :-1], best.U) - X).abs() / (1.0 + X.abs().amax(dim=(1, 2), keepdim=True))
        unlike = ~(gap.flatten(1).amax(-1) <= UNLIKE) & torch.isfinite(best.X).flatten(1).all(-1)
        rows = unlike.nonzero().flatten()
        if rows.numel() > 0:
            odd, U = user.take(rows), best.U[rows]
            X = open_loop(odd.dynamics, best.X[rows, 0], U)
            if bool(torch.isfinite(X).all()):
                told = "compiled code gives other states than the model, whose own are returned, for problems"
                warnings.warn(f"{told} {rows.tolist()}", TraceWarning, stacklevel=2)
            new = Iterate(X, U, take(best.multipliers, rows), odd.cost.total(X, U), violation(odd.constraints, X, U))
            put(best, rows, new)
        return best, unlike

    def trajectories(self, end: SolveEnd) -> Iterate:
        """The best trajectories in the user's units, as PyTorch's rollouts give them, with costs and violations."""
        best = end.best
        seen = kernels_of(self.call.problem).judged(self._lagrangian(best), best.X, best.U)
        return self._returned(best, seen.step.gains.movedim(0, 1), seen.worst, seen.sensitive)

    def _returned(self, best: Iterate, gains: Tensor, worst: Tensor, sensitive: Tensor) -> Iterate:
        """The same with gains (B, N, m, n+1), violations (B,) and sensitive ones (B,) that are known."""
        user, X, U = self.given.problem, best.X, best.U
        rows = sensitive.nonzero().flatten()
        if rows.numel() > 0:
            X, U = reproducible(self.call.problem, X, U, rows, gains[rows, ..., :-1])
        cost = best.cost if rows.numel() == 0 and self._own_costs else user.cost.total(X, U)
        if any(isinstance(part, Constraint) for part in user.users):
            worst = violation(user.constraints, X, U)
        elif rows.numel() > 0:
            worst = measured(self.call.problem, X, U)
        return Iterate(X, U, best.multipliers.scaled(self.unit), cost, worst)

    def _looked_at(self, best: Iterate, slots: int | None = None) -> Optimality:
        B, whole, cost = self.call.problem.B, self._lagrangian(best), best.cost if self._own_costs else None
        if slots is None or slots >= B:
            return optimality(whole, best.X, best.U, cost)
        parts = [slice(i, i + slots) for i in range(0, B, slots)]
        each = [optimality(whole.take(rows), *take((best.X, best.U, cost), rows)) for rows in parts]
        return Optimality(*(torch.cat(column) for column in zip(*each, strict=True)))

    def _lagrangian(self, best: Iterate) -> Lagrangian:
        return Lagrangian(self.call.problem, best.multipliers, None, not self.as_printed)
