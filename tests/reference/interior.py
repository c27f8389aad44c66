"""Primal-dual steps from dense linear systems in NumPy, after Waechter and Biegler (2006), for one problem.

Variables are w = [x_1, ..., x_N, u_0, ..., u_{N-1}], with multipliers y of the gaps x_{k+1} = step(x_k, u_k), e of the
equalities and z of the inequalities c + s = 0, s > 0. Derivatives of all orders are PyTorch's, of the whole problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, Problem, StateBounds
from torchgco.lagrangian.barrier import BarrierOptions

Array = np.ndarray


@dataclass(frozen=True)
class Program:
    """A problem of a batch as functions of w."""

    problem: Problem  # B = 1

    def states_and_controls(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """X (1, N+1, n) and U (1, N, m)."""
        problem = self.problem
        split = problem.N * problem.n
        X = torch.cat((problem.x0.unsqueeze(1), w[:split].view(1, problem.N, problem.n)), dim=1)
        return X, w[split:].view(1, problem.N, problem.m)

    def cost(self, w: Tensor) -> Tensor:
        return self.problem.cost.total(*self.states_and_controls(w))[0]

    def gaps(self, w: Tensor) -> Tensor:
        """step(x_k, u_k) - x_{k+1}, (N n)."""
        X, U = self.states_and_controls(w)
        model = self.problem.dynamics
        ahead = [model.at(k).step(X[:, k], U[:, k]) for k in range(self.problem.N)]
        return (torch.stack(ahead, dim=1) - X[:, 1:]).flatten()

    def rows(self, w: Tensor, sense: str) -> Tensor:
        """All rows of one sense, constraint by constraint."""
        X, U = self.states_and_controls(w)
        found = [c.value(X, U).flatten() for c in self.problem.constraints if c.sense == sense]
        return torch.cat([w.new_zeros(0), *found])

    def equalities(self, w: Tensor) -> Tensor:
        return self.rows(w, "equality")

    def inequalities(self, w: Tensor) -> Tensor:
        return self.rows(w, "inequality")


@dataclass(frozen=True)
class Linear:
    """Values and slopes at w."""

    slope: Array  # of the cost
    gap: Array
    e: Array
    c: Array
    G: Array  # slopes of the gaps
    E: Array
    C: Array


@dataclass(frozen=True)
class Point:
    """An iterate."""

    w: Array
    y: Array
    e: Array
    z: Array
    s: Array
    mu: float
    scale: float  # of the cost
    last: float = 0.0  # the last shift of the curvature that was needed


@dataclass(frozen=True)
class Step:
    """A Newton step, with the longest step lengths that keep slacks and multipliers of inequalities above 0."""

    w: Array
    y: Array
    e: Array
    z: Array
    s: Array
    primal: float
    dual: float
    mu: float
    shift: float


def slopes_of(function: Callable[[Tensor], Tensor], w: Array) -> tuple[Array, Array]:
    """Values and derivatives."""
    at = torch.from_numpy(w)
    values = function(at)
    if values.numel() == 0:
        return np.zeros(0), np.zeros((0, len(w)))
    slopes = torch.autograd.functional.jacobian(function, at, vectorize=True)
    return values.numpy(), np.asarray(slopes)


def linear(program: Program, w: Array, scale: float) -> Linear:
    _, slope = slopes_of(program.cost, w)
    gap, G = slopes_of(program.gaps, w)
    e, E = slopes_of(program.equalities, w)
    c, C = slopes_of(program.inequalities, w)
    return Linear(scale * slope, gap, e, c, G, E, C)


def curvature(program: Program, point: Point) -> Array:
    """Second derivatives of the Lagrangian by w."""
    y, e, z = (torch.from_numpy(part) for part in (point.y, point.e, point.z))

    def lagrangian(w: Tensor) -> Tensor:
        constrained = y @ program.gaps(w) + e @ program.equalities(w) + z @ program.inequalities(w)
        return point.scale * program.cost(w) + constrained

    return np.asarray(torch.autograd.functional.hessian(lagrangian, torch.from_numpy(point.w), vectorize=True))


def residual(at: Linear, point: Point) -> Array:
    """Slopes of the Lagrangian by w."""
    return at.slope + at.G.T @ point.y + at.E.T @ point.e + at.C.T @ point.z


def begin(
    program: Program, X: Tensor, U: Tensor, mu: float, how: BarrierOptions, warm: tuple[Array, Array] | None = None
) -> Point:
    """The first iterate: slacks, multipliers (of inequalities and equalities, `warm`) and the scale of the cost."""
    w = torch.cat((X[0, 1:].flatten(), U.flatten())).numpy().copy()
    at = linear(program, w, 1.0)
    first = lambda x: _stage_cost(program, x, U[0, 0])
    derivatives = torch.autograd.functional
    parts = [
        torch.from_numpy(at.slope), derivatives.hessian(program.cost, torch.from_numpy(w)).diagonal(),
        derivatives.jacobian(first, program.problem.x0[0]),
        derivatives.hessian(first, program.problem.x0[0]).diagonal(),
    ]  # fmt: skip
    largest = max(float(part.abs().max()) for part in parts)
    scale = how.nlp_scaling_obj_target_gradient / largest if largest > 0 else 1.0
    s = np.maximum(-at.c, how.bound_push * room(program))
    z, e = (mu / s, np.zeros_like(at.e)) if warm is None else (scale * warm[0], scale * warm[1])
    if warm is None:
        z = np.where(loose(program, at, w, scale, s, how.held), 1.0, z)
    z = np.maximum(z, mu / (how.kappa_sigma * s))
    point = Point(w, np.zeros_like(at.gap), e, z, s, mu, scale)
    at = linear(program, w, scale)
    # The costates make the Lagrangian stationary in the states.
    states = slice(0, program.problem.N * program.problem.n)
    y = np.linalg.solve(at.G[:, states].T, -residual(at, point)[states])
    return replace(point, y=y if abs(y).max() <= how.constr_mult_init_max else 0 * y)


def loose(program: Program, at: Linear, w: Array, scale: float, s: Array, held: float) -> Array:
    """Bounds whose variable the cost hardly holds: its curvature, and that of all it leads to, is small beside 1 / s.

    Of bounds on the given start, which no variable moves, none.
    """
    problem = program.problem
    N, n, m = problem.N, problem.n, problem.m
    costs = scale * abs(curvature_of_cost(program, w).diagonal())
    squares = at.G**2
    for k in range(N - 1, -1, -1):
        rows = slice(k * n, (k + 1) * n)
        after = costs[rows].copy()  # x_{k+1}
        for first, count in (((k - 1) * n, n if k else 0), (N * n + k * m, m)):
            moved = slice(max(first, 0), max(first, 0) + count)
            costs[moved] += squares[rows, moved].T @ after
    bounds = [
        np.full(part.value(*problem.at_rest).numel(), isinstance(part, ControlBounds | StateBounds))
        for part in problem.constraints
        if part.sense == "inequality"
    ]
    is_bound = np.concatenate([np.zeros(0, dtype=bool), *bounds]) & abs(at.C).any(1)
    return is_bound & (abs(at.C) @ costs * np.maximum(s, 1.0) <= held)


def room(program: Program) -> Array:
    """Of every inequality, half the range between two bounds of a variable, 1 at most and for all other rows."""
    problem = program.problem
    X, U = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1), problem.x0.new_zeros(1, problem.N, problem.m)
    found = [torch.zeros(0)]
    for part in problem.constraints:
        if part.sense != "inequality":
            continue
        rows = torch.ones_like(part.value(X, U))
        if isinstance(part, ControlBounds | StateBounds):
            lower, upper = part.by_knot
            half = 0.5 * (upper - lower).expand(1, rows.shape[1], -1)
            rows = torch.cat((half[..., part.above], half[..., part.below]), dim=-1).clamp(max=1.0)
        found.append(rows.flatten())
    return torch.cat(found).numpy()


def _stage_cost(program: Program, x: Tensor, u: Tensor) -> Tensor:
    """The cost of stage 0, whose derivatives by x count in the scale."""
    return program.problem.cost.stage(x.unsqueeze(0), u.unsqueeze(0), 0)[0]


def next_barrier(at: Linear, point: Point, how: BarrierOptions) -> float:
    """mu of the step at an iterate, smaller where its barrier problem is solved well enough."""
    usual, rows = how.s_max, len(point.e) + len(point.z)
    sum_z = abs(point.e).sum() + abs(point.z).sum()
    mean = (abs(point.y).sum() + sum_z) / (len(point.y) + rows)
    dual = abs(residual(at, point)).max() * usual / max(usual, mean)
    primal = max(abs(np.concatenate((at.gap, at.e, at.c + point.s))).max(), 0.0)
    factor, mu, smallest = usual / max(usual, sum_z / max(rows, 1)), point.mu, how.tol * how.mu_floor
    for _ in range(100):
        off = abs(point.s * point.z - mu).max() * factor if len(point.z) else 0.0
        if max(dual, primal, off) > how.barrier_tol_factor * mu or mu <= smallest:
            break
        mu = max(smallest, min(how.mu_linear_decrease_factor * mu, mu**1.5))
    return mu


def shifted(K: Array, variables: int, last: float, how: BarrierOptions) -> tuple[Array, float]:
    """The KKT matrix with the least shift of the ladder that gives it its inertia, and that shift."""
    shift = 0.0
    while True:
        whole = K.copy()
        whole[:variables, :variables] += shift * np.eye(variables)
        if int((np.linalg.eigvalsh(whole) < 0).sum()) == len(K) - variables:
            return whole, shift
        if shift == 0:
            less = max(how.min_hessian_perturbation, how.perturb_dec_fact * last)
            shift = how.first_hessian_perturbation if last == 0 else less
        else:
            shift *= how.perturb_inc_fact_first if last == 0 else how.perturb_inc_fact


def newton_step(program: Program, point: Point, how: BarrierOptions) -> Step:
    """The step of an iterate: one linear system for the variables and all multipliers."""
    at = linear(program, point.w, point.scale)
    mu = next_barrier(at, point, how)
    A = np.concatenate((at.G, at.E, at.C))
    soft = np.concatenate((0 * point.y, how.jacobian_regularization_value + 0 * point.e, point.s / point.z))
    K = np.block([[curvature(program, point), A.T], [A, -np.diag(soft)]])
    K, shift = shifted(K, len(point.w), point.last, how)
    # Of the inequalities: C dw + ds = -(c + s) and s dz + z ds = mu - s z, without ds.
    right = -np.concatenate((residual(at, point), at.gap, at.e, at.c + mu / point.z))
    step = np.linalg.solve(K, right)
    step += np.linalg.solve(K, right - K @ step)
    ends = np.cumsum([len(part) for part in (point.w, point.y, point.e)])
    dw, dy, de, dz = np.split(step, ends)
    ds = -(at.c + point.s) - at.C @ dw
    tau = max(how.tau_min, 1 - mu)
    return Step(dw, dy, de, dz, ds, _longest(point.s, ds, tau), _longest(point.z, dz, tau), mu, shift)


def _longest(values: Array, change: Array, tau: float) -> float:
    """The longest step, 1 at most, that leaves a share 1 - tau of every value."""
    falling = change < 0
    return min([1.0, *(-tau * values[falling] / change[falling])])


def moved(program: Program, point: Point, step: Step, alpha: float, how: BarrierOptions) -> Point:
    """The iterate after a step of length alpha."""
    w = point.w + alpha * step.w
    c = program.inequalities(torch.from_numpy(w)).numpy()
    s = np.maximum(-c, point.s + alpha * step.s)
    z = np.clip(point.z + step.dual * step.z, step.mu / s / how.kappa_sigma, step.mu / s * how.kappa_sigma)
    return Point(
        w, point.y + alpha * step.y, point.e + alpha * step.e, z, s, step.mu, point.scale,
        step.shift if step.shift > 0 else point.last,
    )  # fmt: skip


def kkt_residual(program: Program, X: Tensor, U: Tensor, e: Array, z: Array) -> float:
    """The largest violated condition of optimality, for multipliers e of equalities and z of inequalities.

    The slopes of the Lagrangian by the controls, with costates that make it stationary in the states; gaps and rows;
    complementarity and signs.
    """
    w = torch.cat((X[0, 1:].flatten(), U.flatten())).numpy()
    at = linear(program, w, 1.0)
    split = program.problem.N * program.problem.n
    slope = at.slope + at.E.T @ e + at.C.T @ z
    y = np.linalg.solve(at.G[:, :split].T, -slope[:split])
    slope = (slope + at.G.T @ y)[split:]
    parts = (slope, at.gap, at.e, np.maximum(at.c, 0), z * at.c, np.minimum(z, 0))
    return max(float(abs(part).max(initial=0.0)) for part in parts)


def curvature_of_cost(program: Program, w: Array) -> Array:
    """Second derivatives of the cost by w."""
    return np.asarray(torch.autograd.functional.hessian(program.cost, torch.from_numpy(w)))
