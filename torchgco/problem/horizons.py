"""Problems of one batch with horizons of different length: after its own last knot, time stops for a problem.

Its state is held, so that the last knot of the batch shows the state, and counts the terminal cost and rows, of its own
last knot. Stages after it cost nothing but what draws their controls to rest, which nothing else depends on; rows of
these knots, obstacles too, don't count.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.autodiff import gradient_and_hessian
from torchgco.base.errors import InputError
from torchgco.base.shapes import lead
from torchgco.base.tree import passed_on
from torchgco.base.values import taken_by
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import bounds_of
from torchgco.costs.base import Cost, FunctionCost, WrappedCost, add_blocks
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics.base import WrappedDynamics
from torchgco.problem.carried import carried_of, with_carried
from torchgco.problem.in_time import at_times, in_time, states_in_time
from torchgco.problem.problem import Problem

HORIZONS_FORM = "within horizons"  # what is kept with the form of the problem for this one


def for_solvers(problem: Problem, joins_knots: bool = False) -> Problem:
    """The problem in the form that solvers work on; itself without horizons, rows of two knots and a free time.

    Args:
        joins_knots: rows of two knots stay as they are.
    """
    if problem.time is not None:
        return in_time(problem)
    within = problem if problem.horizon is None else within_horizons(problem)
    carries = not joins_knots and any(row.joins_knots for row in within.constraints)
    return with_carried(within) if carries else within


def states_for_solvers(problem: Problem, X: Tensor, U: Tensor, factors: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """States X (B, N+1, n) and controls U (B, N, m) of a problem as those of its form `for_solvers`.

    Args:
        factors: of the stages' length, (B, S), where the time is free; else None.
    """
    if factors is not None:
        return states_in_time(problem, X, U, factors)
    carried = carried_of(problem)
    return (X if carried is None else torch.cat((X, carried.along(X, U, problem.along)), dim=-1)), U


def as_solved(problem: Problem, X: Tensor, U: Tensor, times: Any = None) -> tuple[Problem, Tensor, Tensor]:
    """The problem `for_solvers` with states X (B, N+1, n) and controls U (B, N, m) of the user's problem in its form.

    Args:
        times: of the knots (B, N+1), s, where the time is free; else None.
    """
    if problem.time is not None:
        return at_times(problem, X, U, times)
    return for_solvers(problem), *states_for_solvers(problem, X, U)


def within_horizons(problem: Problem) -> Problem:
    """The problem with its states held from each problem's last knot on; itself where no horizons are given.

    Constraints keep their places, rows and knots, and so multipliers their shapes.

    Raises:
        InputError: a cost or a constraint that can't end early, or has no row within some problem's horizon.
    """
    if problem.horizon is None or isinstance(problem.dynamics, _Dynamics):
        return problem
    running = problem.running
    parts: dict[str, object] = {
        "dynamics": _Dynamics(problem.dynamics, running.to(problem.x0.dtype)),
        "cost": _cost(problem, running),
        "constraints": tuple(_constraint(problem, i) for i in range(len(problem.constraints))),
    }
    return problem._with(parts, known=problem.known.of_lifted(HORIZONS_FORM))


def at_rest_after(problem: Problem, U: Tensor) -> Tensor:
    """Controls U (B, N, m), after each problem's last stage those that cost nothing there."""
    if problem.horizon is None:
        return U
    return torch.where(problem.running.unsqueeze(-1), U, _resting(problem))


def _resting(problem: Problem) -> Tensor:
    """Controls (B, N, m) at rest; the middle of their bounds where they aren't inside of these."""
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    for bounds in bounds_of(problem.constraints, "u"):
        controls, (lower, upper) = rest[:, bounds.knots], bounds.by_knot
        inside = (controls > lower) & (controls < upper)
        rest = rest.clone()
        rest[:, bounds.knots] = torch.where(inside, controls, _between(controls, lower, upper))
    return rest


def _between(controls: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """The middle of bounds; one inside of the bound where there is only one."""
    inside = torch.where(torch.isfinite(lower), lower + 1.0, torch.where(torch.isfinite(upper), upper - 1.0, controls))
    return torch.where(torch.isfinite(upper - lower), 0.5 * (lower + upper), inside)


@dataclass(frozen=True)
class _Dynamics(WrappedDynamics):
    """A model whose states are held after each problem's last stage."""

    running: Tensor  # (B, N): 1 in the stages of a problem, 0 after them
    k: Any = field(default=None, repr=False)  # the stage or the stages (K,), set by `at`

    batched: ClassVar[tuple[str, ...]] = ("model", "running")

    def at(self, k: int | Tensor) -> Self:
        return replace(self, model=self.model.at(k), k=k)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.where(self._runs(x), self.model.step(x, u), x)

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        fx, fu = self.model.jacobians(x, u)
        runs, identity = self._runs(x).unsqueeze(-1), torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return torch.where(runs, fx, identity), torch.where(runs, fu, 0.0)

    def _runs(self, x: Tensor) -> Tensor:
        if self.k is None:
            raise InputError("dynamics", "a stage, as in `dynamics.at(k).step(x, u)`", "none")
        return _of_stages(self.running, self.k, x[..., 0]).unsqueeze(-1) > 0


def _of_stages(values: Tensor, k: int | Tensor, like: Tensor) -> Tensor:
    """Values (B, N) of stage k or stages k (K,), shaped to fit `like` (B,), (B, S) or (B, K)."""
    at_k = values[:, k]
    return lead(at_k, like) if isinstance(k, int) else at_k  # type: ignore[return-value]


def _cost(problem: Problem, running: Tensor) -> Cost:
    cost, resting = problem.cost, _resting(problem)
    if isinstance(cost, BoundQuadratic) and cost.kernel == "quadratic":
        return cost.ending(problem.stages, running, resting)
    if isinstance(cost, FunctionCost):
        if cost.terminal_function is not None and taken_by(cost.terminal_function).knot:
            raise InputError("horizon", "a terminal function without an argument k: `knot_values` serve", "one with it")
        cost = replace(cost, values=cost.values.ending_at(problem.stages))
    X, U = problem.at_rest
    first = cost.take(slice(None))
    n, z = problem.n, torch.cat((X[:, 0], U[:, 0]), dim=-1)
    _, H = gradient_and_hessian(lambda z: first.stage(z[..., :n], z[..., n:], 0), z)
    weight = H.diagonal(dim1=-2, dim2=-1)[:, n:].abs()
    weight = torch.where(torch.isfinite(weight) & (weight > 0), weight, 1.0)
    kind = _Stages if type(cost).expand is Cost.expand else _OwnExpansion
    return kind(cost, running.to(X.dtype), resting, weight)


@dataclass(frozen=True)
class _Stages(WrappedCost):
    """A cost whose stages after each problem's last one draw the controls to rest."""

    running: Tensor  # (B, N): 1 in the stages of a problem, 0 after them
    resting: Tensor  # (B, N, m)
    weight: Tensor  # (B, m): curvatures of the first stage's cost, so that no scale depends on these stages

    batched: ClassVar[tuple[str, ...]] = ("cost", "running", "resting", "weight")

    (terminal,) = passed_on("cost", "terminal")

    def rest_controls(self, like: Tensor) -> Tensor:
        return torch.where(self.running.unsqueeze(-1) > 0, self.cost.rest_controls(like), self.resting)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        value, rest, weight = self.cost.stage(x, u, k), self.resting[:, k], self.weight
        if u.dim() == 3:
            weight = weight.unsqueeze(1)
            rest = rest.unsqueeze(1) if isinstance(k, int) else rest
        resting_cost = 0.5 * (weight * (u - rest).square()).sum(-1)
        return torch.where(_of_stages(self.running, k, value) > 0, value, resting_cost)


class _OwnExpansion(_Stages):
    """Where the cost has its own `expand`."""

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        self.cost.expand(X, U, H)
        blocks, weight = torch.zeros_like(H[:, :-1]), self.weight.unsqueeze(1)
        slope = weight * (U - self.resting)
        add_blocks(blocks, X.shape[-1], None, slope, None, torch.diag_embed(weight.expand_as(slope)))
        H[:, :-1] = torch.where(self.running[..., None, None] > 0, H[:, :-1], blocks)


def counted(constraint: Constraint, horizon: Tensor, N: int) -> Tensor:
    """At which of its knots a constraint counts for each problem, (B, K) bool.

    Those up to the last knot, or of rows with controls the last stage; and knot N where it is the only one that comes
    as late: it stands for the last knot of each problem.
    """
    knots = torch.arange(N + 1, device=horizon.device)[constraint.knots]
    of_controls = getattr(constraint, "of", "x" if constraint.holds_at(N) else "xu") != "x"
    last = horizon.unsqueeze(-1)
    within = knots < last if of_controls else knots <= last
    has_last = (knots == last).any(-1, keepdim=True)
    return within | ((knots == N) & ~has_last)


def _constraint(problem: Problem, i: int) -> Constraint:
    constraint, horizon = problem.constraints[i], problem.horizon
    assert horizon is not None
    counts = counted(constraint, horizon, problem.N)
    missing = ~counts.any(-1)
    if counts.shape[1] > 0 and bool(missing.any()):
        b = int(missing.nonzero()[0, 0])
        raise InputError("horizon", f"a knot of constraints[{i}] within each", f"{int(horizon[b])} of problem {b}")
    return constraint.ending(horizon, problem.N, counts.to(problem.x0.dtype), f"constraints[{i}]")
