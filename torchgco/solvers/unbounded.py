"""Problems without an optimum: costs that fall without end."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.dynamics.rollout import open_loop as rolled_out
from torchgco.kernels import cost_scale, cost_unit, measured, open_loop
from torchgco.lagrangian.state import Iterate
from torchgco.problem.problem import Problem
from torchgco.solvers.ending import STATIONARY

# Falls of the cost from that of the guess, as multiples of the size of that cost plus the cost unit of all stages.
DEEP_FALL = 1e6  # a fall that asks for a closer look
BOTTOMLESS = 1e20  # one that needs none: IPOPT's diverging_iterates_tol
FAR_CONTROLS = 1e6  # times 1 + the guess's own controls: a way of controls that asks for a look
FARTHER = 10.0, 1e3, 1e6  # times the way from the guess, for that look
POLE_WAYS, POLE_PLACES, POLE_ROUNDS = (-8.0, 2.0), 41, 9  # powers of ten of the way, places tried, and how often
GROWING = 1e-3  # controls that moved by less than this share of the largest move stay where they are


def beyond_rounding(violation: Tensor, U: Tensor) -> Tensor:
    """Violations (B,), and 0 where the last digits of controls U (B, N, m) make as much: costs that fall go far."""
    rounding = torch.finfo(U.dtype).eps * U.abs().flatten(1).amax(-1)
    return torch.where(violation <= rounding, 0.0, violation)


def falls_without_end(problem: Problem, U0: Tensor, best: Iterate, left: Tensor, tolerance: float) -> Tensor:
    """Whether the cost of feasible trajectories falls without end, (B,) bool.

    It does where the controls that have moved most from the guess U0 (B, N, m) go on in their directions, at no
    violation, and the cost falls as it did, or by as much for every power of ten, as a logarithm does. That is tried
    where the cost lies deep below that of the guess, for this may also be a reward that ends, such as one at wide
    bounds; where a Newton step would still save a share `left` (B,) of the cost; and where controls have gone very far.
    """
    unit = problem.N * cost_unit(problem)
    way = (best.U - U0).abs().flatten(1).amax(-1) / (1.0 + U0.abs().flatten(1).amax(-1))
    open_ended = (left > STATIONARY) | (way >= FAR_CONTROLS)
    falls = ((best.cost < -DEEP_FALL * unit) | open_ended) & (beyond_rounding(best.violation, best.U) <= tolerance)
    rows = falls.nonzero().flatten()
    if rows.numel() == 0:
        return falls
    X, U0, U, cost, unit = (z[rows] for z in (best.X, U0, best.U, best.cost, unit))
    fixed = problem.take(rows).held_at(X[:, 0])
    before = fixed.cost.total(open_loop(fixed, U0), U0)
    farther, clear = _farther(fixed, U0, U, tolerance)
    costs = torch.stack([cost, *farther])
    fall, size, times = before - costs, before.abs() + unit, cost.new_tensor([1.0, *FARTHER]).unsqueeze(-1)
    linear = (fall >= 0.5 * times * fall[0]).all(0) & (fall[0] >= DEEP_FALL * size)
    rate = (costs[:-1] - costs[1:]) / times.log10().diff(dim=0)
    without = (cost - cost_scale(fixed).constant).abs() + unit
    by_decades = (rate >= 0.5 * rate[0]).all(0) & (rate[0] > STATIONARY * without) & open_ended[rows]
    falls[rows] = (fall[0] >= BOTTOMLESS * size) | ((linear | by_decades) & clear)
    stuck = (torch.isinf(left[rows]) & ~falls[rows]).nonzero().flatten()
    if stuck.numel() > 0:  # no control Hessian was convex enough: the cost may fall without end at a pole
        falls[rows[stuck]] = _falls_at_a_pole(fixed.take(stuck), U[stuck], without[stuck], tolerance)
    return falls


def _falls_at_a_pole(problem: Problem, U: Tensor, size: Tensor, tolerance: float) -> Tensor:
    """Whether the cost falls as it did, the nearer the controls come to a place down its slope, (b,) bool.

    Places (b, P) between the two around the best one are tried again and again: at a pole, and at that of a logarithm,
    later rounds gain at least about as much as earlier ones; near a minimum, next to nothing.
    """
    (slope,) = gradients_at_once(lambda V: problem.cost.total(rolled_out(problem.dynamics, problem.x0, V), V), U)
    slope = torch.where(torch.isfinite(slope), slope, 0.0)
    scale = U.abs().flatten(1).amax(-1) / slope.abs().flatten(1).amax(-1).clamp(min=torch.finfo(U.dtype).tiny)
    places = scale.unsqueeze(-1) * torch.logspace(*POLE_WAYS, POLE_PLACES, dtype=U.dtype, device=U.device)
    each, best = torch.arange(len(U), device=U.device).repeat_interleave(POLE_PLACES), list[Tensor]()
    many = problem.take(each)
    for _ in range(POLE_ROUNDS):
        V = U[each] - places.view(-1, 1, 1) * slope[each]
        path = open_loop(many, V)
        costs = torch.where(measured(many, path, V) <= tolerance, many.cost.total(path, V), torch.inf)
        lowest, index = costs.nan_to_num(torch.inf, torch.inf, torch.inf).view(-1, POLE_PLACES).min(-1)
        best.append(lowest)
        ends = [places.gather(1, (index + by).clamp(0, POLE_PLACES - 1).unsqueeze(-1)) for by in (-1, 1)]
        places = ends[0] + (ends[1] - ends[0]) * torch.linspace(0.0, 1.0, POLE_PLACES, dtype=U.dtype, device=U.device)
    first, later = best[0] - best[POLE_ROUNDS // 2], best[POLE_ROUNDS // 2] - best[-1]
    return (later >= 0.5 * first) & (later > STATIONARY * size)


def _farther(problem: Problem, U0: Tensor, U: Tensor, tolerance: float) -> tuple[list[Tensor], Tensor]:
    """The costs (b,) at multiples of the way from U0 to U (b, N, m), and whether none of these places is violated."""
    move, clear = U - U0, torch.ones_like(U[:, 0, 0], dtype=torch.bool)
    large = move.abs() >= GROWING * move.abs().flatten(1).amax(-1).view(-1, 1, 1)
    costs = list[Tensor]()
    for times in FARTHER:
        beyond = U + torch.where(large, (times - 1) * move, 0.0)
        path = open_loop(problem, beyond)
        costs.append(problem.cost.total(path, beyond))
        clear &= beyond_rounding(measured(problem, path, beyond), beyond) <= tolerance
    return costs, clear
