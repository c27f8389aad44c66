"""Problems without an optimum: costs that fall without end."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.draws import uniform
from torchgco.dynamics.rollout import open_loop as rolled_out
from torchgco.kernels import cost_scale, measured, open_loop
from torchgco.lagrangian.lagrangian import Iterate
from torchgco.problem.problem import Problem
from torchgco.solvers.ending import STATIONARY

# Falls of the cost from that of the guess, as multiples of the size of that cost plus the cost unit of all stages.
DEEP_FALL = 1e6  # a fall that asks for a closer look
BOTTOMLESS = 1e20  # one that needs none: IPOPT's diverging_iterates_tol
FAR_CONTROLS = 1e6  # times 1 + the guess's own controls: a way of controls that asks for a look
FARTHER = 10.0, 1e3, 1e6  # times the way from the guess, for that look
ROUNDING = 1e-12  # share of a row's size that sums of hundreds of numbers lose
LAST_DIGITS = 4.0  # times the largest control's: a control is the sum of some numbers of its size
OF_A_RAY = 1e-7  # share by which the solver's directions may be off: the tolerance of HiGHS for its rays
OTHERWISE, OTHERS = 1e-3, 2  # how much larger or smaller other controls are that show a row's size, and how many
POLE_WAYS, POLE_PLACES, POLE_ROUNDS = (-8.0, 2.0), 41, 9  # powers of ten of the way, places tried, and how often
GROWING = 1e-3, 1e-9  # controls that moved by less than such a share of the largest move stay where they are


def beyond_rounding(problem: Problem, U: Tensor, violation: Tensor, share: float) -> Tensor:
    """Violations (B,) of controls U (B, N, m), or where controls went far those of rows that aren't lost in their sums.

    Where costs fall without end, a row is the difference of numbers that are many times as large. Their size follows
    from what the row makes of other controls, each up to a thousandth larger or smaller: rows count that are violated
    by more than a share of it, and by more than the last digits of the controls.
    """
    rows = ((violation > 0) & torch.isfinite(violation)).nonzero().flatten()
    if rows.numel() > 0:
        rows = rows[U[rows].abs().flatten(1).amax(-1) >= FAR_CONTROLS]
    if rows.numel() == 0:
        return violation
    far, U, counted = problem.take(rows), U[rows], torch.zeros_like(violation[rows])
    digits = LAST_DIGITS * torch.finfo(U.dtype).eps * U.abs().amax(dim=(1, 2), keepdim=True)
    X = open_loop(far, U)
    others = [U * (1.0 + OTHERWISE * (2.0 * uniform(i, U.shape[1:], U) - 1.0)) for i in range(OTHERS)]
    paths = [open_loop(far, V) for V in others]
    for constraint in far.constraints:
        value = constraint.value(X, U)
        if value[0].numel() == 0:
            continue
        changes = [(constraint.value(path, V) - value).abs() for path, V in zip(paths, others, strict=True)]
        size = torch.stack(changes).amax(0) / OTHERWISE
        violated = constraint.violation(X, U)
        beyond = torch.where((value.abs() <= share * size) | (violated <= digits), 0.0, violated)
        counted = torch.maximum(counted, beyond.flatten(1).amax(-1))
    return violation.index_put((rows,), counted)


def falls_without_end(problem: Problem, U0: Tensor, best: Iterate, left: Tensor, tolerance: float) -> Tensor:
    """Whether the cost of feasible trajectories falls without end, (B,) bool.

    It does where the controls that have moved most from the guess U0 (B, N, m) go on in their directions, at no
    violation, and the cost falls as it did, or by as much for every power of ten, as a logarithm does. That is tried
    where the cost lies deep below that of the guess, for this may also be a reward that ends, such as one at wide
    bounds; where a Newton step would still save a share `left` (B,) of the cost; and where controls have gone very far.
    """
    unit = problem.N * cost_scale(problem).unit
    way = (best.U - U0).abs().flatten(1).amax(-1) / (1.0 + U0.abs().flatten(1).amax(-1))
    open_ended = (left > STATIONARY) | (way >= FAR_CONTROLS)
    violated = beyond_rounding(problem.held_at(best.X[:, 0]), best.U, best.violation, OF_A_RAY)
    falls = ((best.cost < -DEEP_FALL * unit) | open_ended) & (violated <= tolerance)
    rows = falls.nonzero().flatten()
    if rows.numel() == 0:
        return falls
    X, U0, U, cost, unit = (z[rows] for z in (best.X, U0, best.U, best.cost, unit))
    fixed = problem.take(rows).held_at(X[:, 0])
    before = fixed.cost.total(open_loop(fixed, U0), U0)
    fall, size, without = before - cost, before.abs() + unit, (cost - cost_scale(fixed).constant).abs() + unit
    goes_on = fall >= BOTTOMLESS * size
    times = cost.new_tensor([1.0, *FARTHER]).unsqueeze(-1)
    for growing in GROWING:
        costs, clear = _farther(fixed, U0, U, growing, tolerance)
        costs = torch.cat([cost.unsqueeze(0), costs])
        linear = (before - costs >= 0.5 * times * fall).all(0) & (fall >= DEEP_FALL * size)
        rate = (costs[:-1] - costs[1:]) / times.log10().diff(dim=0)
        by_decades = (rate >= 0.5 * rate[0]).all(0) & (rate[0] > STATIONARY * without) & open_ended[rows]
        goes_on |= (linear | by_decades) & clear
    falls[rows] = goes_on
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


def _farther(problem: Problem, U0: Tensor, U: Tensor, growing: float, tolerance: float) -> tuple[Tensor, Tensor]:
    """The costs (F, b) at multiples of the way from U0 to U (b, N, m), and whether none of these places is violated."""
    move, clear = U - U0, torch.ones_like(U[:, 0, 0], dtype=torch.bool)
    large = move.abs() >= growing * move.abs().flatten(1).amax(-1).view(-1, 1, 1)
    costs = list[Tensor]()
    for times in FARTHER:
        beyond = U + torch.where(large, (times - 1) * move, 0.0)
        path = open_loop(problem, beyond)
        costs.append(problem.cost.total(path, beyond))
        clear &= beyond_rounding(problem, beyond, measured(problem, path, beyond), OF_A_RAY) <= tolerance
    return torch.stack(costs), clear
