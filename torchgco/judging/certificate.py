"""Certificates of returned trajectories: whether each obeys its dynamics, clears the obstacles between the knots too,
keeps its bounds and is a stationary point, or by how much it fails.

The problem's own functions (step, cost, rows) are used, and no solver code: derivatives come from autograd, multipliers
from a separate least-squares fit, or from anywhere: those given are tested. docs/words.md defines the terms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchgco.base.autodiff import gradients, jacobian, slope_along
from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import check_shape, computing_on
from torchgco.constraints.base import Distance, least
from torchgco.constraints.bounds import bounds_of
from torchgco.judging.judge import doubled, in_double
from torchgco.judging.steps import step_errors
from torchgco.obstacles.base import Obstacles
from torchgco.problem.alone import row_by_row
from torchgco.problem.horizons import within_horizons
from torchgco.problem.in_time import at_times, factor_controls
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.times import Paths, paths

HARDLY_SEEN = 1e-6  # share of the cost that a control is held to change over its range at least
LITTLE = 1e-3  # share of a control's size: by as much as its slopes change over that, they count at least
NEGLIGIBLE = 1e-9  # smallest scale of a control, as a share of the largest scale among all controls
ACTIVE_WITHIN = 1e-3  # an inequality with at most this slack (m for obstacles) may have a multiplier


@dataclass(frozen=True)
class Certificate:
    """One value per problem, (B,); NaN for problems that were not asked for, and where X or U isn't finite."""

    # Largest |x_{k+1} - step(x_k, u_k)| and, where the start isn't free, |X_0 - x_0| over all states, in their units. A
    # residual of rounding size (1e-12 in float64) proves that X is the planning model's rollout of U; it says nothing
    # about the model's quality.
    dynamics_residual: Tensor
    # Smallest distance to the surface of the full r_obs + r_veh (of a box: grown by r + r_veh, where r rounds it) from
    # the first knot to the last, or a lower bound of it, m; infinite without obstacles. At 0 or more, no obstacle is
    # touched between the knots either, under the conditions that `certify` states. The same of positions that keep a
    # distance, with both paths.
    clearance: Tensor
    # Largest excess over control and state bounds, in their units; 0 proves that they hold at every knot.
    bound_violation: Tensor
    # Largest component of the Lagrangian's gradient with respect to U, and to what is free in the start, with the
    # multipliers (inequalities: at least 0) that make it smallest in the least-squares sense, as a share of the largest
    # terms that cancel in the gradient of J_var with respect to the same control, of which those that cancel within the
    # code of the cost are known by its curvature alone: see `_least_scales`. No unit of cost or control changes it.
    # Near 0 it proves a stationary point to first order, not a minimum, and says nothing about rows that are
    # violated. Of multipliers that are given: the larger of two numbers without units, which are those of IPOPT's end
    # test (Waechter and Biegler 2006, equation 5) with scales of the trajectory instead of fixed ones. The first is the
    # largest component of the Lagrangian's gradient, as a share of the largest terms that cancel in it with respect to
    # the same control; the second the largest product of a multiplier and its row, as a share of the cost.
    kkt_residual: Tensor
    step_error: Tensor  # whether dt is short enough: see `StepErrors`; NaN without a known field, too
    step_cost: Tensor


def certify(
    problem: Problem,
    X: Tensor,
    U: Tensor,
    asked: Tensor | None = None,
    multipliers: Sequence[Tensor] | None = None,
    times: Tensor | None = None,
) -> Certificate:
    """See `torchgco.certify`."""
    problem = current_problem(problem)
    problem, X, U = row_by_row(in_double(problem)), doubled(X, "X", problem), doubled(U, "U", problem)
    problem.check_controls(U, "U")
    check_shape(X, (problem.B, problem.N + 1, problem.n), "X")
    asked = torch.ones(problem.B, dtype=torch.bool, device=U.device) if asked is None else asked
    check_shape(asked, (problem.B,), "asked")
    if asked.dtype != torch.bool:
        raise InputError("asked", "a tensor of bool", asked.dtype)
    if multipliers is not None:
        multipliers = _checked_multipliers(problem, multipliers)
    with computing_on(problem.x0.device):
        seconds = None if times is None else doubled(times, "times", problem)
        columns = _certified(*at_times(problem, X, U, seconds), asked, multipliers)
        steps = columns.new_full((2, problem.B), torch.nan)
        if (rows := (~columns[0].isnan()).nonzero().flatten()).numel() > 0:
            subset, t = problem.take(rows), None if seconds is None else seconds[rows]
            lams = None if multipliers is None else [lam[rows] for lam in multipliers]
            errors = step_errors(subset, X[rows], U[rows], t, lams)
            steps[:, rows] = torch.stack((errors.step_error, errors.step_cost))
        return Certificate(*columns, *steps)


def _checked_multipliers(problem: Problem, multipliers: Sequence[Tensor]) -> list[Tensor]:
    count = len(problem.constraints)
    if not isinstance(multipliers, list | tuple) or len(multipliers) != count:
        raise InputError("multipliers", f"{count} tensors, one per constraint", shown(multipliers))
    lams = [doubled(lam, f"multipliers[{i}]", problem) for i, lam in enumerate(multipliers)]
    for i, (lam, shape) in enumerate(zip(lams, problem.row_shapes, strict=True)):
        check_shape(lam, (problem.B, *shape), f"multipliers[{i}]")
    return lams


def _certified(problem: Problem, X: Tensor, U: Tensor, asked: Tensor, multipliers: Sequence[Tensor] | None) -> Tensor:
    """The columns of a certificate but those of the steps, (4, B)."""
    columns = torch.full((4, problem.B), torch.nan, dtype=X.dtype, device=X.device)
    finite = torch.isfinite(X).flatten(1).all(-1) & torch.isfinite(U).flatten(1).all(-1)
    for b in (asked & finite).nonzero().flatten():
        # One at a time: no number depends on the other problems, and memory stays that of one problem.
        row = b.view(1)
        single, x, u = within_horizons(problem.take(row)), X[row], U[row]
        lams = None if multipliers is None else [lam[row] for lam in multipliers]
        kkt = _fitted_kkt(single, x, u) if lams is None else _given_kkt(single, x, u, lams)
        columns[:, b] = torch.stack(
            (_dynamics_residual(single, x, u), _clearance(single, x, u), _bound_violation(single, x, u), kkt)
        )
    return columns


def frame_columns(certificate: Certificate) -> dict[str, Any]:
    """The certificate as arrays, by the names of a study's columns."""
    parts = vars(certificate).items()
    return {"clearance_full" if name == "clearance" else name: value.cpu().numpy() for name, value in parts}


# One problem: every tensor below has a batch of one ---------------------------------------------------------------


def _dynamics_residual(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    gap = (X[:, 1:] - problem.along.step(X[:, :-1], U)).abs().amax()
    moved = (X[:, 0] - problem.x0).abs()
    if problem.free_start is not None:
        moved = moved.masked_fill(problem.free_start, 0.0)
    return torch.maximum(gap, moved.amax())


def _bound_violation(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    worst = X.new_zeros(())
    for bounds in bounds_of(problem.constraints):
        lower, upper = bounds.by_knot
        z = (U if bounds.of == "u" else X)[:, bounds.knots, : upper.shape[-1]]  # a free time is another state
        excess = torch.maximum(z - upper, lower - z)
        worst = torch.maximum(worst, excess.amax())
    return worst


def _clearance(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    nearest, path = X.new_full((), torch.inf), paths(problem, X, U)[0]
    stages = path.pieces * int(problem.stages[0])  # the chords after them are points
    k = torch.arange(problem.N, device=X.device).repeat_interleave(path.pieces)
    for distance in (constraint.bare for constraint in problem.constraints):
        if isinstance(distance, Distance):
            distance = distance if path.pieces == 1 else distance.in_pieces(path.pieces)
            chords = distance.measured(path.X)[1][0]
            bulge = _bulge(distance, problem, path, U[:, k], k)  # (N|1, P|1)
            gaps = chords.unflatten(-1, (bulge.shape[-1], -1)) - bulge.unsqueeze(-1)
            nearest = torch.minimum(nearest, least(gaps[:stages].flatten(1).unsqueeze(0))[0])
    return nearest


def _bulge(distance: Distance, problem: Problem, path: Paths, U: Tensor, k: Tensor) -> Tensor:
    """How far a part's places may leave their chord of each piece, of stages k by controls U, (N|1, P|1), m: along a
    known field, else where the states change evenly."""
    if not problem.bends:
        return distance.even_bulge(path.X)[0]
    dynamics, X, dt = problem.dynamics.at(k), path.X, problem.dynamics.dt / path.pieces
    field = lambda x: dynamics.field(x, U)
    velocity = lambda x: slope_along(distance.places, (x,), (field(x),))
    half = X[:, :-1] + 0.5 * dt * field(X[:, :-1])
    samples = [slope_along(velocity, (x,), (field(x),))[0] for x in (X[:, :-1], half, X[:, 1:])]
    a = torch.stack(samples)  # (3, N, P, d)
    change = a.diff(dim=0).norm(dim=-1).amax(0)
    return dt**2 / 8.0 * (a.norm(dim=-1).amax(0) + change)


def _fitted_kkt(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    cost = gradients(problem.cost.total, X, U)
    active = _active_rows(problem, X, U)
    gX, gU = (torch.cat([cost[i], *(rows[i] for _, rows in active)]) for i in (0, 1))
    reduced, terms, start = _reduced(problem, X, U, gX, gU)
    free = _free(problem)
    slopes = torch.cat((reduced.flatten(1), start[0][:, free]), dim=1).cpu().numpy()
    if not np.isfinite(slopes).all():  # where the code refuses states, or is no number there, no multipliers fit
        return torch.full_like(X[0, 0, 0], torch.nan)
    senses = [equality for equality, (rows, _) in active for _ in rows]
    rest = X.new_tensor(_fit(slopes[0], slopes[1:], np.array(senses, dtype=bool)))
    return _share(rest, U[0], torch.cat((terms.amax(0), start[1][free])), _least_scales(problem, X, U))


def _given_kkt(problem: Problem, X: Tensor, U: Tensor, multipliers: list[Tensor]) -> Tensor:
    multipliers = [*multipliers, *_of_factors(problem, X, U, multipliers)]
    rows = [constraint.value(X, U) for constraint in problem.constraints]
    lams = [
        torch.where(torch.isfinite(c), lam if constraint.sense == "equality" else lam.clamp(min=0.0), 0.0)
        for constraint, lam, c in zip(problem.constraints, multipliers, rows, strict=True)
    ]  # a bound at infinity pushes nobody
    reduced, terms, start = _reduced(problem, X, U, *gradients(_lagrangian(problem, lams), X, U))
    free = _free(problem)
    rest = torch.cat((reduced[0].flatten(), start[0][0, free]))
    unfit = _share(rest, U[0], torch.cat((terms.amax(0), start[1][free])), _least_scales(problem, X, U))
    cost = (problem.cost.total(X, U) - problem.cost_scale.constant)[0].abs()
    cost = cost + problem.cost_scale.size[0]
    products = [torch.where(lam != 0, lam * c, 0.0).abs().flatten() for lam, c in zip(lams, rows, strict=True)]
    return torch.cat((unfit.view(1), *(product / cost for product in products))).amax()


def _lagrangian(problem: Problem, lams: Sequence[Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """The cost with the first constraints, as many as there are multipliers lams."""

    def value(x: Tensor, u: Tensor) -> Tensor:
        parts = zip(problem.constraints, lams, strict=False)
        pushes = (torch.where(lam != 0, lam * c.value(x, u), 0.0).flatten(1).sum(-1) for c, lam in parts)
        return sum(pushes, problem.cost.total(x, u))

    return value


def _of_factors(problem: Problem, X: Tensor, U: Tensor, multipliers: list[Tensor]) -> list[Tensor]:
    """Multipliers of the bounds on factors of time, the last constraints: those that what is left asks for."""
    bounds: list[Any] = list(problem.constraints[len(multipliers) :])
    if not bounds:
        return []
    reduced, _, start = _reduced(problem, X, U, *gradients(_lagrangian(problem, multipliers), X, U))
    lams = []
    for bound in bounds:
        slopes = reduced[:, bound.knots] if bound.of == "u" else start[0].unsqueeze(1)
        upper, lower = -slopes[..., bound.above], slopes[..., bound.below]
        lam = torch.cat((upper, lower), dim=-1).clamp(min=0.0)
        lams.append(torch.where(bound.value(X, U) >= -ACTIVE_WITHIN, lam, 0.0))
    return lams


def _free(problem: Problem) -> Tensor:
    """Which components of the start are free, (n,) bool."""
    return torch.zeros_like(problem.x0[0], dtype=torch.bool) if problem.free_start is None else problem.free_start[0]


def _least_scales(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The least scales (m,) of slopes by controls, where fewer terms are seen to cancel: the largest of three.

    Within a stage's cost terms cancel unseen, and of a control on which nothing depends, as where time alone costs, no
    terms cancel: what is left of rounding and of far rows' multipliers isn't measured by itself. So slopes count at
    least by how much they change over `LITTLE` of the controls' sizes; as one with which a step to where it is 0 saves
    `HARDLY_SEEN` squared of the cost; and as `HARDLY_SEEN` of the cost over the range of the control's bounds.
    """
    cost, bounds = problem.cost.total(X, U)[0], problem.control_bounds
    try:
        curvatures, scale = _curvatures(problem, X, U), problem.cost_scale
    except RuntimeError:  # an operation of the cost or the model has no such derivatives
        least = torch.zeros_like(U[0, 0])
    else:
        changes = LITTLE * (curvatures @ U[0].abs().amax(0))
        worth = (cost - scale.constant[0]).abs() + scale.size[0]
        least = torch.maximum(changes, HARDLY_SEEN * (2.0 * worth * curvatures.diagonal()).sqrt()).nan_to_num(0.0, 0.0)
    if bounds is None:
        return least
    return torch.maximum(least, (HARDLY_SEEN * cost.abs() / bounds.range[0]).nan_to_num(0.0, 0.0))


def _curvatures(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The largest second derivatives of J_var by control i of a stage and j of it or the one before, (m, m), each a sum
    of magnitudes: directly, and by the state that follows.
    """
    m, k = U.shape[-1], torch.arange(U.shape[-1], device=U.device)
    by_x, by_u = X.new_zeros(2 * m, *X.shape), U.new_zeros(2 * m, *U.shape)
    by_u[k, ..., k] = 1.0
    fu = jacobian(lambda u: problem.along.step(X[:, :-1], u), U)[0]  # (1, N, n, m)
    by_x[m:, :, 1:] = fu.movedim(-1, 0)
    slopes = lambda x, u: torch.cat([g.flatten(1) for g in gradients(problem.cost.total, x, u)], dim=1)
    changes = torch.func.vmap(lambda x, u: slope_along(slopes, (X, U), (x, u)))(by_x, by_u)
    changes = changes.abs().view(2, m, -1).sum(0)
    of_x, of_u = changes.split((X.numel(), U.numel()), dim=-1)
    by_state = of_x.view(m, *X.shape[1:])[:, 1:].unsqueeze(-2) @ fu[0].abs()  # (m, N, 1, m)
    return (of_u.view(m, *U.shape[1:]) + by_state.squeeze(-2)).amax(1).mT


def _share(rest: Tensor, U: Tensor, scale: Tensor, least: Tensor) -> Tensor:
    """The largest component of a gradient by U (N, m) and what is free in the start, (N m + f,), as a share of those
    of `scale` (m + f,), for controls at least `least` (m,)."""
    rest = rest.abs()
    rest = torch.cat((rest[: U.numel()].view_as(U).amax(0), rest[U.numel() :]))
    scale = torch.maximum(scale, NEGLIGIBLE * scale.amax())
    scale = torch.cat((torch.maximum(scale[: len(least)], least), scale[len(least) :]))
    return torch.where(rest > 0, rest / scale, 0.0).amax()


def _fit(g: np.ndarray, A: np.ndarray, equality: np.ndarray) -> np.ndarray:
    """g + A'lam with least-squares lam, at least 0 where not an equality."""
    length = np.linalg.norm(A, axis=1)
    moves = length > 1e-12 * max(1.0, length.max(initial=0.0))
    A, equality = A[moves] / length[moves, None], equality[moves]
    cone = np.concatenate((A, -A[equality]))  # an equality's multiplier may have either sign
    rest = g
    if len(cone):
        try:
            lam = scipy.optimize.nnls(cone.T, -g, maxiter=10 * len(cone))[0]
        except RuntimeError:  # no convergence (nearly dependent rows): the clipped free fit is an upper bound too
            lam = np.linalg.lstsq(cone.T, -g, rcond=None)[0].clip(min=0.0)
        rest = g + lam @ cone
    return rest


def _active_rows(problem: Problem, X: Tensor, U: Tensor) -> list[tuple[bool, tuple[Tensor, ...]]]:
    """Per constraint with rows that may be active: whether it is an equality, and the rows' gradients, (q, N+1, n) by X
    and (q, N, m) by U, without dynamics."""
    active = []
    for constraint in problem.constraints:
        equality = constraint.sense == "equality"
        is_obstacle = isinstance(constraint, Obstacles)
        spare = (constraint.distances(X) if is_obstacle else -constraint.value(X, U))[0]  # m, or in the units of c
        knots, columns = (spare <= (torch.inf if equality else ACTIVE_WITHIN)).nonzero(as_tuple=True)
        q = knots.numel()
        if q > 0:
            twins = constraint.take(torch.zeros(q, dtype=torch.int64, device=X.device))
            which = torch.arange(q, device=X.device), knots, columns
            rows = lambda x, u, twins=twins, which=which: twins.value(x, u)[which]
            # Row j is computed from repetition j of the trajectory.
            active.append((equality, gradients(rows, X.repeat(q, 1, 1), U.repeat(q, 1, 1))))
    return active


def _reduced(
    problem: Problem, X: Tensor, U: Tensor, gX: Tensor, gU: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Total derivatives (q, N, m) with respect to U, by the adjoint recursion through the dynamics for q rows at once.

    Also, for the first row, the sums (N, m) of the magnitudes of its terms; and both with respect to the start, (q, n)
    and (n,).
    """
    n, N = problem.n, problem.N
    twins = problem.along.take(torch.zeros(n, dtype=torch.int64, device=X.device))
    x, u = X[:, :-1].repeat(n, 1, 1), U.repeat(n, 1, 1)
    fx, fu = gradients(lambda x, u: twins.step(x, u).diagonal(dim1=0, dim2=2), x, u)  # (n, N, n), (n, N, m)
    total, terms, of_start = torch.empty_like(gU), torch.empty_like(gU[0]), torch.empty_like(gX[0, 0])
    adjoint = gX[:, N]
    for k in range(N - 1, -1, -1):
        total[:, k] = gU[:, k] + adjoint @ fu[:, k]
        terms[k] = gU[0, k].abs() + adjoint[0].abs() @ fu[:, k].abs()
        if k < N - 1:  # a next factor of time is nothing but a state: what cancels, cancels in that
            chosen = factor_controls(problem, k)
            terms[k, chosen] = of_start @ fu[:, k, chosen].abs()
        of_start = gX[0, k].abs() + adjoint[0].abs() @ fx[:, k].abs()
        adjoint = gX[:, k] + adjoint @ fx[:, k]
    return total, terms, (adjoint, of_start)
