"""The end of a solve for the problems that no attempt has brought to theirs: more iterations, then other controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, smooth_normal
from torchgco.base.options import Positive, check_options
from torchgco.base.status import STALLED
from torchgco.base.tree import take
from torchgco.constraints.bounds import ControlBounds
from torchgco.kernels import open_loop, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.lagrangian.state import Iterate
from torchgco.problem.problem import Problem
from torchgco.search.attempts import Search
from torchgco.solvers.augmented_lagrangian import PENALTY_MAX, AugmentedLagrangian
from torchgco.solvers.contracts import Call

KNOTS = 10  # of the noise that changes stalled controls
SURE = 10.0  # times what outweighs the cost
TINY = 1e-12  # violation term that no division needs
STREAM = 1 << 20  # outer iteration that keys the noise: no solve makes so many


@dataclass(frozen=True)
class Finish:
    """Continues where a limit has ended a solve; from other controls where an infeasible trajectory has stalled.

    The multipliers and penalties of the best trajectory are kept. A trajectory may be stationary for any penalty, as a
    car at rest is that should stand next to its place: there the solve starts again close by.

    Args:
        solver: with limits that only the slowest problems reach.
        change: standard deviation of the change of stalled controls, as a share of half their range.

    Raises:
        InputError: a field out of its range.
    """

    solver: AugmentedLagrangian = AugmentedLagrangian()
    change: Positive = 0.1

    def __post_init__(self) -> None:
        check_options(self, "finish")

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        best = search.best
        self._attempt(search, best.limited, _from_best)
        best.next_attempt()
        stalled = (best.end.status == STALLED) & (best.end.best.violation > self.solver.violation_tolerance)
        self._attempt(search, stalled.nonzero().flatten(), self._from_changed)

    def _attempt(self, search: Search, rows: Tensor, start: Callable[[Call, Iterate], Call]) -> None:
        """One more solve of the problems in `rows`, from where `start` says."""
        best = search.best
        if rows.numel() == 0 or search.call.late:
            return
        end = best.attempt(start(search.call.take(rows), take(best.end.best, rows)), solver=self.solver)
        best.keep(rows, end)
        # The end of this solve says more than that of the attempt whose trajectory may have been kept.
        best.end.status[rows[end.status == STALLED]] = STALLED

    def _from_changed(self, call: Call, best: Iterate) -> Call:
        key = DrawKey(call.seed, call.ids, torch.full_like(call.ids, STREAM))
        U = best.U + self.change * half_ranges(call.problem, best.U) * smooth_normal(key, KNOTS, best.U)
        return replace(call, U0=U, warm=self._balanced(call.problem, U))

    def _balanced(self, problem: Problem, U: Tensor) -> Multipliers:
        """Multipliers of zero with penalties that outweigh the cost of U (B, N, m), and at least the initial penalty.

        With less, the first step would lead back to where the cost is lowest and the violation stationary. Close to
        such a point a violation changes with the square of `change`, and its penalty has to weigh more by that factor.
        """
        least, overweight = self.solver.initial_penalty, SURE / self.change**2
        unit, X = Multipliers.zero(problem, 1.0), open_loop(problem, U)
        cost, merit = value(Lagrangian(problem, unit, None, True), X, U)
        mu = overweight * (cost.abs() / (merit - cost).clamp(min=TINY)).nan_to_num(least, PENALTY_MAX, least)
        return replace(unit, mu=mu.clamp(min=least, max=PENALTY_MAX))


def _from_best(call: Call, best: Iterate) -> Call:
    return replace(call, U0=best.U, warm=best.multipliers)


def half_ranges(problem: Problem, U: Tensor) -> Tensor:
    """Half the range of each control between its bounds, (B, 1, m); 1 or the largest control where it is unbounded."""
    half = U.abs().amax(1, keepdim=True).clamp(min=1.0)
    for bounds in problem.constraints:
        if isinstance(bounds, ControlBounds):
            own = 0.5 * bounds.range.unsqueeze(1)
            half = torch.where(torch.isfinite(own), own, half)
    return half
