"""Polish: from a good trajectory to one that is feasible and stationary to many digits.

An augmented Lagrangian stops at a violation of about a millimetre. From there Newton's method on the optimality
conditions needs a handful of steps. The states are eliminated, so the dynamics hold exactly throughout. The dual of a
quadratic program finds the active rows. Every step is rolled out, with a line search.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Count, NonNegative, Positive, check_options
from torchgco.base.shapes import computing_on
from torchgco.base.status import Status
from torchgco.base.tree import copied, put
from torchgco.kernels import chord_clearance, current, measured
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, binding
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution
from torchgco.solvers.ending import final_status, optimality
from torchgco.solvers.polish.active_set import multipliers, projected
from torchgco.solvers.polish.condensed import Condensed
from torchgco.solvers.polish.line_search import MERIT_NOISE, descend

STIFFNESS = 1e4  # curvature added across the active rows, times the Hessian's mean diagonal; no solution changes
# Shares of the mean of `_mean_along`, added to the diagonal until the model is convex.
SHIFTS = (0.0, 1e-3, 1e-2, 1e-1, 1.0)
NEAR_ROWS = 1e-2  # rows with c above minus this share of their slope's length are in the program from the start
PIVOT = 1e-3  # the smallest pivot that is convex enough, as a share of the mean of `_mean_along`
ACTIVE = 1e-3  # as NEAR_ROWS: rows that count as active in the KKT residual
PROGRAM_ROUNDS = 10  # rounds of adding the rows that a step would violate to a program


@dataclass(frozen=True)
class Polish:
    """Active-set Newton in the controls alone: violation below 1e-8, and a small KKT residual.

    Problems are taken one at a time, so no result depends on the rest of the batch, and memory is that of one dense
    problem: some (N m)^2 numbers. On a GPU this is slow: one problem is too little work for it.

    Args:
        iterations: Newton steps at most.
        tolerance: target of the violation (metres for lengths, all else in the units of its constraint).
        stationarity: target of the relative KKT residual. Iteration ends once both targets are met.
        reach: problems with a larger violation are left alone, as are those with an invalid start or values that
            aren't finite.
        cost_rise: share by which J_var may rise; removing a millimetre of violation raises the cost.
        curvature: use second derivatives of constraints and dynamics, where the model stays convex on the active
            rows; False: those of the cost alone (Gauss-Newton), whose steps converge linearly.

    Raises:
        InputError: a field out of its range.
    """

    iterations: Count = 15
    tolerance: Positive = 1e-8
    stationarity: Positive = 1e-8
    reach: Positive = 1e-2
    cost_rise: NonNegative = 1e-2
    curvature: bool = True

    def __post_init__(self) -> None:
        check_options(self, "polish")

    def refine(self, problem: Problem, solution: Solution) -> Solution:
        """The solution with the problems that could be improved replaced: X, U, gains, multipliers, cost, violation.

        A trajectory is replaced where its violation falls below the tolerance, or stays within it (or within its value
        before) while the KKT residual falls; never where its cost would rise by more than `cost_rise`, or the straight
        segments between knots would cut an obstacle deeper than before. The status of a replaced trajectory is that of
        the new one. `iterations` grows by the Newton steps, even where the trajectory isn't replaced.

        Raises:
            InputError: a problem that isn't float64, or a solution of other problems.
        """
        problem = current_problem(problem)
        if problem.x0.dtype != torch.float64:  # whose rounding exceeds any useful tolerance
            raise InputError("polish", "a problem in torch.float64", problem.x0.dtype)
        if not isinstance(solution, Solution):
            raise InputError("solution", "a Solution", type(solution).__name__)
        problem.check_controls(solution.U, "solution.U")
        solution.multipliers.check(problem)
        with computing_on(problem.x0.device):
            return self._refined(current(problem).held_at(solution.X[:, 0]), solution)

    def _refined(self, problem: Problem, solution: Solution) -> Solution:
        result = copied(replace(solution, trace=None, search=None, account=None))
        near = (measured(problem, solution.X, solution.U) <= self.reach) & torch.isfinite(solution.cost)
        for b in (near & problem.start_is_clear).nonzero().flatten():
            rows = b.view(1)
            part, before = problem.take(rows), solution.take(rows)
            after, steps = self._polished(part, before)
            if after is not before:
                put(result, rows, after)
            result.iterations[rows] = before.iterations + steps
        return replace(result, trace=solution.trace, search=solution.search, account=solution.account)

    def _polished(self, problem: Problem, solution: Solution) -> tuple[Solution, int]:
        """The solution of one problem, `solution` itself if nothing better was found; and the number of steps."""
        X, U, pairs = solution.X, solution.U, zip(problem.constraints, solution.multipliers.lam, strict=True)
        held = (binding(part.sense, part.value(X, U), lam).flatten() for part, lam in pairs)
        lam = torch.cat([solution.cost.new_zeros(0), *held])
        first = best = now = _Point.at(problem, solution.X, solution.U, lam)
        weight, steps = 0.0, 0
        while steps < self.iterations:
            if now.worst <= self.tolerance and now.residual <= self.stationarity:
                break
            moved = self._step(now, weight)
            if moved is None:
                break
            now, weight = moved
            steps += 1
            if self._is_better(now, best, first):
                best = now
        return solution if best is first else best.put_into(solution), steps

    def _is_better(self, new: _Point, old: _Point, first: _Point) -> bool:
        if not new.cost <= first.cost + self.cost_rise * abs(first.cost):
            return False
        if new.clearance < min(0.0, first.clearance):
            return False  # a long step may leap over an obstacle between two knots
        gained = new.worst <= self.tolerance < old.worst
        return gained or (new.worst <= max(self.tolerance, old.worst) and new.fitted < old.fitted)

    def _step(self, point: _Point, weight: float) -> tuple[_Point, float] | None:
        """The next point and the weight of its merit; None where neither model gives a step that lowers it."""
        for exact in (True, False) if self.curvature else (False,):
            convex = _convex(point, exact)
            found = None if convex is None else _program(point, *convex)
            if found is None:
                continue
            step, lam = found
            heavier = max(weight, 2.0 * float(lam.abs().max())) if lam.numel() else weight
            moved = descend(point.model, step, lam, heavier)
            if moved is not None:
                return _Point.at(point.model.problem, *moved, lam), heavier
        return None


@dataclass(frozen=True)
class _Point:
    """A trajectory of one problem, linearised, and its quality."""

    model: Condensed
    lam: Tensor  # (r,)
    cost: float
    worst: float  # violation
    residual: float  # relative KKT residual with lam
    clearance: float  # smallest distance along the chords to where bodies touch, m

    @classmethod
    def at(cls, problem: Problem, X: Tensor, U: Tensor, lam: Tensor) -> _Point:
        model = Condensed.around(problem, X, U)
        cost = float(problem.cost.total(X, U))
        slack = float((lam * model.c).abs().max()) / (1.0 + abs(cost)) if lam.numel() else 0.0
        clearance = float(chord_clearance(problem, X))
        worst = float(measured(problem, X, U))
        return cls(model, lam, cost, worst, max(_slope(model, lam), slack), clearance)

    @cached_property
    def fitted(self) -> float:
        """The KKT residual with least-squares multipliers: those of a solver that stopped early don't fit yet."""
        model = self.model
        rows = (model.equality | (model.c >= -ACTIVE * model.slopes.norm(dim=-1))).nonzero().flatten()
        A = model.dense(rows)
        A = A / A.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(A.dtype).tiny)
        none = torch.zeros_like(rows, dtype=torch.bool)
        pushes = multipliers(A @ A.mT, -(A @ model.gradient), model.equality[rows], none)
        if pushes is None:
            return self.residual
        rest = model.gradient + pushes @ A
        return min(self.residual, float(rest.abs().max()) / (1.0 + float(model.gradient.abs().max())))

    def put_into(self, solution: Solution) -> Solution:
        """The solution with its trajectory replaced by this one, and gains along it."""
        problem, X, U = self.model.problem, self.model.X, self.model.U
        fitted = Multipliers(self.model.by_constraint(self.lam), solution.multipliers.mu)
        K, d, left = optimality(Lagrangian(problem, fitted, None, True), X, U)
        cost, worst = torch.full_like(solution.cost, self.cost), torch.full_like(solution.violation, self.worst)
        # The status follows from the new trajectory, not from the limit that ended the solve before.
        ended = torch.full_like(solution.status, Status.MAX_ITERATIONS)
        status = final_status(ended, left, worst, ADMITTED, bool(problem.constraints))
        return replace(solution, X=X, U=U, K=K, d=d, multipliers=fitted, cost=cost, violation=worst, status=status)


def _slope(model: Condensed, lam: Tensor) -> float:
    """The largest component of the Lagrangian's gradient, divided by 1 + that of the cost's."""
    return float(model.lagrangian_gradient(lam).abs().max()) / (1.0 + float(model.gradient.abs().max()))


def _convex(point: _Point, exact: bool) -> tuple[Tensor, Tensor] | None:
    """Factor L (v, v) of a positive definite Hessian and the matching gradient (v,); None if no shift helps.

    The active rows fix the step across them, so curvature added there doesn't change it. A Hessian that is also
    indefinite along them is shifted.
    """
    model, lam = point.model, point.lam
    H = model.hessian(lam if exact else None)
    mean, along = H.diagonal().abs().mean(), _mean_along(model, H)
    if _holds(factor := torch.linalg.cholesky_ex(H), along):
        return factor[0], model.gradient
    pushing = ((lam > 0) | model.equality) & (model.slopes.abs().amax(-1) > 0)
    rows = pushing.nonzero().flatten()
    A = model.dense(rows)
    length = A.norm(dim=-1).clamp(min=torch.finfo(A.dtype).tiny)
    A, c = A / length.unsqueeze(-1), model.c[rows] / length
    H = H + STIFFNESS * mean * (A.mT @ A)
    for shift in SHIFTS:
        if _holds(factor := torch.linalg.cholesky_ex(H + torch.diag((shift * along).expand(H.shape[0]))), along):
            return factor[0], model.gradient + STIFFNESS * mean * (c @ A)
    return None


def _mean_along(model: Condensed, H: Tensor) -> Tensor:
    """Mean magnitude of the diagonal of H (v, v), reduced to the directions in which the equalities let a step go.

    A terminal weight may be a thousand times as stiff as the rest of H, and a shift in proportion to it would stop all
    steps, even where a terminal equality fixes the components that the weight is about.
    """
    if not bool(model.equality.any()):
        return H.diagonal().abs().mean()
    across, _ = torch.linalg.qr(model.dense(model.equality.nonzero().flatten()).mT)
    H = H - across @ (across.mT @ H)
    return (H - (H @ across) @ across.mT).diagonal().abs().mean()


def _holds(factor: tuple[Tensor, Tensor], mean: Tensor) -> bool:
    """Whether a factorisation succeeded, with pivots large enough to keep steps bounded."""
    return not bool(factor[1]) and bool(factor[0].diagonal().square().min() > PIVOT * mean)


def _program(point: _Point, L: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor] | None:
    """Step (v,) and multipliers (r,) of min g'd + 1/2 d'LL'd with A d + c <= 0 (or = 0); None if not found.

    Rows far from their limit are left out at first, and added if the step found without them would violate them.
    """
    model, lam = point.model, point.lam
    size = model.slopes.norm(dim=-1)
    member = (model.equality | (lam > 0) | (model.c > -NEAR_ROWS * size)) & (size > 0)
    g = torch.linalg.solve_triangular(L, gradient.unsqueeze(-1), upper=False).squeeze(-1)
    for _ in range(PROGRAM_ROUNDS):
        rows = member.nonzero().flatten()
        if rows.numel() > 2 * gradient.numel():
            return None  # the linearised rows contradict each other, or the model is flat
        A = model.dense(rows)
        moves = A.abs().amax(-1) > 1e-12 * size[rows]  # the first knots of some models can't be moved at all
        rows, A = rows[moves], A[moves]
        V = torch.linalg.solve_triangular(L, A.mT.contiguous(), upper=False)
        pushes = multipliers(V.mT @ V, model.c[rows] - V.mT @ g, model.equality[rows], lam[rows] > 0)
        if pushes is None:
            pushes = projected(V, model.c[rows] - V.mT @ g, model.equality[rows])
        if pushes is None:
            return None
        step = -torch.linalg.solve_triangular(L.mT, (g + V @ pushes).unsqueeze(-1), upper=True).squeeze(-1)
        broken = (model.c + model.change(step) > MERIT_NOISE * size) & ~member & (size > 0)
        if not bool(broken.any()):
            return step, torch.zeros_like(lam).index_put((rows,), pushes)
        member = member | broken
    return None
