"""Points at which solutions are differentiated, and there the solution as a function of its KKT residual.

A solver ends within its tolerances, derivatives need more: a few iterations of the interior point from there. Where
they lead elsewhere, the trajectory was no minimum of the problem. With smoothing they lead to the solution of the
barrier problem instead, in which every inequality pushes a little. Trajectories that `gco` has cleared between knots
are ones of the same problem with larger obstacles: these are tried next, and their growth is then a constant.

With K symmetric, a vector-Jacobian product is one solve with the upstream gradients as right hand sides, whose solution
autodiff takes through the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NoReturn

import torch
from torch import Tensor, _add_batch_dim, _remove_batch_dim  # type: ignore[import]
from torch._C._functorch import is_legacy_batchedtensor  # type: ignore[import]
from torch.autograd.function import once_differentiable

from torchgco.base.draws import scattered
from torchgco.base.gradients import not_recording
from torchgco.base.status import SOLVED, Status
from torchgco.base.status import Differentiability as Why
from torchgco.base.tree import copied, put, take
from torchgco.kernels import chord_clearance, cost_scale, interior_of, measured
from torchgco.lagrangian.kkt import KktSolve, RightSides
from torchgco.lagrangian.quality import leaves_goal
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.ending import STATIONARY, judged_between, touches
from torchgco.solvers.interior import InteriorPoint
from torchgco.solvers.session import Session

# With a tolerance of 1e-13, rounding ends some polishes before they meet it.
POLISH = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9, warm_barrier=1e-8, max_iterations=40)
# Share of 1 + the largest state or control by which a polish may move one. A solver ends where a share STATIONARY of
# the cost may be left to save, which is of second order in what moves.
STATIONARY_MOVE = STATIONARY**0.5
LEFT_OPEN = 1e-6  # of rows' right hand sides of 1: what dependent rows leave open is about 1, others leave rounding
# s z = mu at the end of a polish, 1e-13: where slack and multiplier are within this factor of each other, both about
# sqrt(mu), which of them is 0 at the minimum isn't known.
TOLD = 1e2
SAME_SLOPES = 1e-4  # share by which derivatives with and without such rows may differ


@dataclass(frozen=True)
class Points:
    """Where B solutions are differentiated.

    Attributes:
        solution: polished where that is possible, else as the solver left it.
        problem: that of which the solution is a minimum, with obstacles grown by `growth` (B,), m.
        active: rows that hold, (B, R) bool, constraint by constraint and knot by knot.
        costates: (B, N+1, n).
        reason: (B,) int64, a `Differentiability`.
        give: slack / multiplier (B, R) of rows in a barrier, 0 of rows that hold as equalities; None: all these do.
        gap: mu / multiplier (B, R) of rows in a barrier, what their slack should be; None as `give`.
    """

    solution: Solution
    problem: Problem
    growth: Tensor
    active: Tensor
    costates: Tensor
    reason: Tensor
    give: Tensor | None = None
    gap: Tensor | None = None

    @property
    def lam(self) -> Tensor:
        """Multipliers of the rows that hold, 0 of others, (B, R)."""
        flat = [lam.flatten(1) for lam in self.solution.multipliers.lam]
        return torch.where(self.active, torch.cat([self.growth.new_zeros(len(self.growth), 0), *flat], dim=1), 0.0)

    def take(self, rows: Tensor) -> Points:
        """Those of the problems `rows`, places (b,)."""
        tensors = self.growth, self.active, self.costates, self.reason, self.give, self.gap
        return Points(self.solution.take(rows), self.problem.take(rows), *take(tensors, rows))


def points_of(problem: Problem, solution: Solution, smoothing: float = 0.0) -> Points:
    """The points of solutions, with every reason against derivatives; with smoothing, mu in units of the cost."""
    result = copied(replace(solution, trace=None, search=None, account=None))
    solved = (solution.status == Status.CONVERGED) | (solution.status == Status.FEASIBLE)
    # What only touches an obstacle between two knots is stationary for the rows at them all the same.
    solved |= touches(problem, solution)
    reason = torch.full_like(solution.status, int(Why.NOT_SOLVED))
    growth = torch.zeros_like(solution.cost)
    _polish(problem, solved.nonzero().flatten(), growth, result, reason, smoothing)
    room = clearance(problem, solution.X)
    grown = solved & (reason != Why.DIFFERENTIABLE) & (room > 0) & torch.isfinite(room)
    growth, first = torch.where(grown, room, growth), reason.clone()
    _polish(problem, grown.nonzero().flatten(), growth, result, reason, smoothing)
    reason = torch.where(reason == Why.DIFFERENTIABLE, reason, first)
    growth = torch.where(reason == Why.DIFFERENTIABLE, growth, 0.0)
    problem = problem.grown(growth) if bool((growth > 0).any()) else problem
    if smoothing > 0:
        active, give, gap = rows_in_barrier(problem, result, smoothing)
    else:
        (active, untold), give, gap = rows_that_hold(problem, result), None, None
        weak = (untold.any(-1) & (reason == Why.DIFFERENTIABLE)).nonzero().flatten()
        reason[weak] = _weakness(problem.take(weak), result.take(weak), active[weak], untold[weak])
    kkt = solve_at(problem, result, active, probe(problem, active), give)
    for where, why in ((~(kkt.left.amax(0) <= LEFT_OPEN), Why.DEPENDENT_ROWS), (~kkt.definite, Why.NOT_STRICT)):
        reason[where & (reason == Why.DIFFERENTIABLE)] = int(why)
    return Points(result, problem, growth, active, kkt.costates, reason, give, gap)


def _polish(problem: Problem, rows: Tensor, growth: Tensor, result: Solution, reason: Tensor, smoothing: float) -> None:
    """Polish the solutions of the problems `rows`, with obstacles grown by `growth` (B,), in place; and say why not."""
    if rows.numel() == 0:
        return
    subset, old, by = problem.take(rows), result.take(rows), growth[rows]
    asked = subset.grown(by) if bool((by > 0).any()) else subset
    call = replace(Call.checked(asked, old.U, warm=old.multipliers), X0=old.X)
    end = POLISH.solved(call, smoothing=smoothing)
    new = Session(call, own_units=True).trajectories(end)
    stays = torch.maximum(_moved(new.X, old.X), _moved(new.U, old.U)) <= STATIONARY_MOVE
    stays = end.status == SOLVED if smoothing > 0 else stays
    stays &= ~(chord_clearance(subset, new.X) < chord_clearance(subset, old.X).clamp(max=0.0))
    leaves = (stays | (end.status == SOLVED)) & leaves_goal(subset, new.X, old.X)
    why = torch.where(stays, int(Why.DIFFERENTIABLE), int(Why.NOT_SMOOTHED if smoothing > 0 else Why.MOVED))
    reason[rows] = torch.where(leaves, int(Why.LEAVES_GOAL), why)
    kept = (reason[rows] == Why.DIFFERENTIABLE).nonzero().flatten()
    if kept.numel() > 0:
        best = take(new, kept)
        worst, more = measured(subset.take(kept), best.X, best.U), old.iterations[kept] + end.iterations[kept]
        parts = {"X": best.X, "U": best.U, "multipliers": best.multipliers, "cost": best.cost}
        if smoothing > 0:  # constraints hold, but it is another cost that can't be improved
            status = torch.full_like(more, int(Status.FEASIBLE))
            parts["status"] = judged_between(subset.take(kept), best.X, best.U, status)
        put(result, rows[kept], replace(old.take(kept), **parts, violation=worst, iterations=more))


def _moved(new: Tensor, old: Tensor) -> Tensor:
    """The largest change (B,) of states or controls, as a share of 1 + the largest one."""
    return ((new - old).abs() / (1.0 + old.abs().amax(dim=(1, 2), keepdim=True))).flatten(1).amax(-1)


def clearance(problem: Problem, X: Tensor) -> Tensor:
    """The smallest distance (B,) at the knots from obstacles, m; infinite without any."""
    least = torch.full_like(X[:, 0, 0], torch.inf)
    for obstacle in problem.obstacles:
        apart = obstacle.distances(X)
        if apart[0].numel() > 0:
            least = torch.minimum(least, apart.flatten(1).amin(-1))
    return least


def rows_that_hold(problem: Problem, solution: Solution) -> tuple[Tensor, Tensor]:
    """Which rows hold as equalities, and of which inequalities that isn't known, (B, R) bool."""
    unit, none = (
        cost_scale(problem).unit.view(-1, 1, 1),
        torch.zeros_like(solution.status, dtype=torch.bool)[:, None][:, :0],
    )
    hold, untold = [none], [none]
    for constraint, lam in zip(problem.constraints, solution.multipliers.lam, strict=True):
        slack, pushes = -constraint.value(solution.X, solution.U), lam / unit
        equal = torch.full_like(slack, constraint.sense == "equality", dtype=torch.bool)
        ratio = pushes.abs() / slack.abs()
        hold.append((equal | (pushes > slack)).flatten(1))
        untold.append((~equal & (ratio > 1.0 / TOLD) & (ratio < TOLD)).flatten(1))
    return torch.cat(hold, dim=1), torch.cat(untold, dim=1)


def rows_in_barrier(problem: Problem, solution: Solution, mu: float) -> tuple[Tensor, Tensor, Tensor]:
    """Which rows hold, with the give and gap of those in the barrier, (B, R) all.

    Slack times multiplier is mu there, and 0 of equalities, of bounds that coincide and of rows that no variable moves.
    """
    none = solution.cost.new_zeros(len(solution.cost), 0)
    active, give, gap = [none.bool()], [none], [none]
    for constraint, lam in zip(problem.constraints, solution.multipliers.lam, strict=True):
        slack, equal = -constraint.value(solution.X, solution.U), constraint.sense == "equality"
        inside = (slack * lam > 0.5 * mu) & (not equal)
        active.append((inside | (lam > 0) | equal).flatten(1))
        give.append(torch.where(inside, slack / lam, 0.0).flatten(1))
        gap.append(torch.where(inside, mu / lam, 0.0).flatten(1))
    return torch.cat(active, dim=1), torch.cat(give, dim=1), torch.cat(gap, dim=1)


def solve_at(
    problem: Problem, solution: Solution, active: Tensor, right: RightSides, give: Tensor | None = None
) -> KktSolve:
    """The systems at solutions."""
    point = solution.X, solution.U, solution.multipliers.lam
    return interior_of(problem).kkt(problem, *point, active, right, give, gains_of(problem, solution))


def gains_of(problem: Problem, solution: Solution) -> Tensor:
    """The gains (B, N, m, n) of solutions; 0 for states and controls that the user's problem doesn't have."""
    K = solution.K.nan_to_num(0.0, 0.0, 0.0)
    return torch.nn.functional.pad(K, (0, problem.n - K.shape[-1], 0, problem.m - K.shape[-2]))


def probe(problem: Problem, active: Tensor) -> RightSides:
    """A right hand side of every row, gap, state and control, none of which is special; the same for all problems."""
    B, N, like = problem.B, problem.N, problem.x0
    a, b, c = (
        scattered(like.new_zeros(shape)).expand(1, B, *shape[1:])
        for shape in ((1, N + 1, problem.n + problem.m), (1, N, problem.n), (1, active.shape[1]))
    )
    return RightSides(a, b, c)


def _weakness(problem: Problem, solution: Solution, active: Tensor, untold: Tensor) -> Tensor:
    """WEAKLY_ACTIVE (B,) where it matters for derivatives which of the rows `untold` hold, else DIFFERENTIABLE."""
    if problem.B == 0:
        return torch.zeros_like(solution.status)
    z = []
    for rows in (active | untold, active & ~untold):
        z.append(solve_at(problem, solution, rows, probe(problem, rows)).z[0].flatten(1))
    change, size = (z[0] - z[1]).abs().amax(-1), torch.maximum(z[0].abs(), z[1].abs()).amax(-1)
    return torch.where(change <= SAME_SLOPES * size, int(Why.DIFFERENTIABLE), int(Why.WEAKLY_ACTIVE))


NO_SECOND = (
    "solutions have no second derivatives: take differences of gradients, or, for a sum of squares, J'J of the Jacobian"
)


@dataclass(frozen=True)
class System:
    """The linear systems of B solutions; see `lagrangian.kkt`."""

    problem: Problem
    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    multipliers: tuple[Tensor, ...]
    active: Tensor  # (B, R) bool
    give: Tensor | None = None  # (B, R)
    K: Tensor | None = None  # (B, N, m, n)

    def once(self, x: Tensor, u: Tensor, gaps: Tensor | None, rows: Tensor) -> tuple[Tensor, ...]:
        """`solve` of one right hand side, or of all those that `is_grads_batched` and `vectorize` hide in one."""
        parts = [x, u, torch.zeros_like(x[:, 1:]) if gaps is None else gaps, rows]
        if not any(map(is_legacy_batchedtensor, parts)):
            return tuple(z[0] for z in self.solve(*(z.unsqueeze(0) for z in parts)))
        level = torch._C._vmapmode_increment_nesting() - 1
        torch._C._vmapmode_decrement_nesting()
        hidden = next(z for z in parts if is_legacy_batchedtensor(z))
        count = _remove_batch_dim(hidden, level, 1, 0).shape[0]
        plain = [_remove_batch_dim(z, level, count, 0) for z in parts]
        if any(map(is_legacy_batchedtensor, plain)):
            raise RuntimeError("solutions: one `vectorize` or `is_grads_batched` within another isn't served")
        return tuple(_add_batch_dim(z, 0, level) for z in self.solve(*plain))

    def solve(self, x: Tensor, u: Tensor, gaps: Tensor | None, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """-K^-1 of right hand sides x (C, B, N+1, n), u (C, B, N, m), gaps (C, B, N, n), rows (C, B, R); as these."""
        gaps = torch.zeros_like(x[:, :, 1:]) if gaps is None else gaps
        if self.problem.B == 0:
            return x, u, gaps, rows
        with not_recording():
            n = self.problem.n
            a = torch.cat((x, torch.nn.functional.pad(u, (0, 0, 0, 1))), dim=-1)
            right = RightSides(a, gaps, rows)
            point = self.X, self.U, self.multipliers, self.active
            step = interior_of(self.problem).kkt(self.problem, *point, right, self.give, self.K)
        return step.z[..., :n], step.z[:, :, :-1, n:], step.y, step.v


class Solved(torch.autograd.Function):
    """X, U, multipliers (B, R) and costs as functions of a `Residual`'s parts."""

    @staticmethod
    def forward(
        system: System, values: tuple[Tensor, ...], x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, lagrangian: Tensor
    ) -> tuple[Tensor, ...]:
        return tuple(value.clone() for value in values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.system = inputs[0]
        ctx.save_for_backward(*inputs[2:])
        ctx.save_for_forward(*inputs[2:])

    @staticmethod
    def backward(ctx: Any, X: Tensor, U: Tensor, lam: Tensor, cost: Tensor) -> tuple[Any, ...]:
        return None, None, *Adjoint.apply(ctx.system, X, U, lam, cost, *Fixed.apply(*ctx.saved_tensors))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor, ...]:
        return Forward.apply(ctx.system, *tangents[2:], *ctx.saved_tensors)  # type: ignore[return-value]


class Last(torch.autograd.Function):
    """A function whose derivatives would be second ones."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> NoReturn:
        raise RuntimeError(NO_SECOND)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        raise RuntimeError(NO_SECOND)


class Forward(Last):
    """Tangents of X, U, multipliers and costs from those of the residual's parts; of the parts, too, as `Adjoint`."""

    @staticmethod
    def forward(
        system: System, x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, lagrangian: Tensor, *parts: Tensor
    ) -> tuple[Tensor, ...]:
        X, U, _, lam = system.once(x, u, gaps, rows)
        return X, U, lam, lagrangian.clone()


class Adjoint(Last):
    """Gradients by the residual's parts, from upstream ones of X, U, multipliers and costs, of which it is linear.

    It is a function of its own, of the parts too, for two reasons: a rule for many right hand sides at once, and that a
    second derivative by the parts is refused. Autodiff would take it at a fixed solution, without an error.
    """

    @staticmethod
    def forward(system: System, X: Tensor, U: Tensor, lam: Tensor, cost: Tensor, *parts: Tensor) -> tuple[Tensor, ...]:
        return *system.once(X, U, None, lam), cost.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.system, ctx.parts = inputs[0], [torch.empty_like(z, device="meta") for z in inputs[5:]]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, cost: Tensor) -> tuple[Any, ...]:
        X, U, _, lam = ctx.system.once(x, u, gaps, rows)
        return None, X, U, lam, cost.clone(), *(torch.zeros_like(z, device=x.device) for z in ctx.parts)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], system: System, *arguments: Tensor) -> tuple[Any, Any]:
        X, U, lam, cost = (
            z.expand(info.batch_size, *z.shape) if dim is None else z.movedim(dim, 0)
            for z, dim in zip(arguments[:4], in_dims[1:5], strict=True)
        )
        return (*system.solve(X, U, None, lam), cost.clone()), (0,) * 5


class Fixed(Last):
    """The residual's parts, for gradients at which they are held: a derivative that leads here is a second one."""

    generate_vmap_rule = True

    @staticmethod
    def forward(*parts: Tensor) -> tuple[Tensor, ...]:
        return tuple(z.view_as(z) for z in parts)
