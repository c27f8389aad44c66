"""Whether a trajectory passes its gates in their order, measured along all of it by maths of its own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.obstacles.base import ADMITTED
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem
from torchgco.problem.times import Paths, paths


class Passes(NamedTuple):
    """How each problem passes each of its gates, (B, G), after those before it."""

    passed: Tensor  # bool
    when: Tensor  # int64: the knot by which it is; N + 1 of those that aren't
    # m: the least on the way through it, from a ball's centre, or in a square's plane along the farther side; of one
    # that isn't passed, the least after the gates before it; infinite: not crossed, or after one that isn't passed.
    distance: Tensor
    place: Tensor  # (B, G, d), m: where that is on the way through it; NaN of one that isn't passed


class Meetings(NamedTuple):
    """What a trajectory does at one gate on its way to each knot from 1 to N, (B, N)."""

    time: Tensor  # in knots: until which the gate may be passed on this way
    next: Tensor  # the time from which on the gate after it may be passed, if that before this one was passed earlier
    distance: Tensor  # m; see `Passes`
    at: Tensor  # in knots: when it is as far as this
    passes: Tensor  # bool


def passages(problem: Problem, X: Tensor, U: Tensor, along: Sequence[Paths] | None = None) -> dict[int, Passes]:
    """How trajectories X (B, N+1, n), U (B, N, m) pass gates on the paths that the integrator takes.

    Args:
        along: these paths, where they are known.

    Returns:
        By the places of the constraints that are gates.
    """
    numbers = [i for i, row in enumerate(problem.constraints) if isinstance(row.bare, GateBalls | GateSquares)]
    if not numbers:
        return {}
    along = paths(problem, X, U) if along is None else along
    order = torch.cat([path.rows for path in along]).argsort()
    by_gate = {}
    for i in numbers:
        ways = []
        for path in along:
            way = passes(problem.constraints[i].take(path.rows), path.X)
            assert way is not None
            ways.append(way._replace(when=-(-way.when // path.pieces)))
        by_gate[i] = Passes(*(torch.cat(column)[order] for column in zip(*ways, strict=True)))
    return by_gate


def passes(constraint: Constraint, X: Tensor) -> Passes | None:
    """How X (B, N+1, n), straight from knot to knot, passes the gates of a constraint; None where it has none."""
    gates = constraint.bare
    if isinstance(gates, GateBalls):
        return through_balls(gates.centers, gates.sizes, X[..., gates.components])
    return _through_squares(gates, X[..., gates.components]) if isinstance(gates, GateSquares) else None


def crossings(ways: Iterable[Passes], b: int = 0) -> np.ndarray:
    """Places (C, d), m, where trajectory b passes gates, constraint by constraint."""
    places = [way.place[b][way.passed[b]].detach().cpu().double().numpy() for way in ways]
    return np.concatenate(places) if places else np.empty((0, 0))


def through_balls(centers: Tensor, radii: Tensor, p: Tensor) -> Passes:
    """How positions p (B, N+1, d) pass balls (B, G, d) of radii (B, G): where lines come within these, and 1e-3 m."""
    k, move = torch.arange(p.shape[1] - 1, dtype=p.dtype, device=p.device), p.diff(dim=1)
    square = move.square().sum(-1).clamp(min=torch.finfo(p.dtype).tiny)

    def meetings(g: int) -> Meetings:
        center, reach = centers[:, g].unsqueeze(1), radii[:, g : g + 1] + ADMITTED
        a = p[:, :-1] - center
        away = segment_distance(a, p[:, 1:] - center)
        # Where on the line it is within the ball: |a + share move| <= reach.
        middle = -(a * move).sum(-1) / square
        half = (middle.square() - (a.square().sum(-1) - reach.square()) / square).clamp(min=0.0).sqrt()
        enters, leaves = ((middle + shift).clamp(0.0, 1.0) for shift in (-half, half))
        meets = away <= reach
        return Meetings(k + torch.where(meets, leaves, 1.0), k + enters, away, k + middle.clamp(0.0, 1.0), meets)

    return _in_order(p, map(meetings, range(centers.shape[1])))


def _through_squares(gates: GateSquares, p: Tensor) -> Passes:
    """A square is passed from a knot at least 1e-3 m behind its plane to the next one that is as far ahead of it.

    Where the way between them crosses the plane for the last time, it is within the square and 1e-3 m.
    """
    k = torch.arange(p.shape[1], device=p.device).expand(p.shape[:2])

    def meetings(g: int) -> Meetings:
        q = (p - gates.centers[:, g].unsqueeze(1)) @ gates.axes[:, g].mT  # (B, N+1, d): along the normal first
        s = q[..., 0]
        side = (s >= ADMITTED).to(k) - (s <= -ADMITTED).to(k)
        left = torch.where(side != 0, k, 0).cummax(-1).values  # the knot outside the plane that was left last
        crosses = (side[:, 1:] > 0) & (side.gather(1, left)[:, :-1] < 0)
        under = torch.where(s <= 0, k, 0).cummax(-1).values[:, :-1]
        a, b = (q.gather(1, (under + i).unsqueeze(-1).expand_as(q[:, 1:])) for i in (0, 1))
        share = torch.where(crosses, -a[..., 0] / (b[..., 0] - a[..., 0]), 0.0)
        away = (a + share.unsqueeze(-1) * (b - a))[..., 1:].abs().amax(-1)
        away = torch.where(crosses, away, torch.inf)
        time = under + share  # a square that comes twice, one after the other, is crossed twice
        later = torch.nextafter(time, torch.full_like(time, torch.inf))
        return Meetings(time, later, away, time, away <= gates.half_widths[:, g : g + 1] + ADMITTED)

    return _in_order(p, map(meetings, range(gates.centers.shape[1])))


def _in_order(p: Tensor, gates: Iterable[Meetings]) -> Passes:
    """The first passage of each gate along p (B, N+1, d) after that of the gate before."""
    (B, K, _), passed = p.shape, []
    k = torch.arange(K - 1, device=p.device)
    since, left = p.new_zeros(B, 1), torch.zeros(B, 1, dtype=torch.bool, device=p.device)
    for time, next_, away, at, passes in gates:
        later = (time >= since) & ~left
        first = torch.where(later & passes, k, K - 1).amin(-1, keepdim=True)  # K - 1: none
        left = first == K - 1
        until = torch.where(~passes & (k > first), k, K - 1).amin(-1, keepdim=True)
        way = later & (left | ((k >= first) & (k < until)))
        least, nearest = torch.where(way, away, torch.inf).min(-1, keepdim=True)
        moment = at.gather(1, nearest)
        knot = moment.long().clamp(0, K - 2)
        a, b = (p.gather(1, (knot + i).unsqueeze(-1).expand(-1, -1, p.shape[-1])) for i in (0, 1))
        place = torch.where(left.unsqueeze(-1), torch.nan, a + (moment - knot).unsqueeze(-1) * (b - a))
        passed.append((~left, first + 1, least, place))
        since = torch.where(left, since, torch.maximum(since, next_.gather(1, first.clamp(max=K - 2))))
    return Passes(*(torch.cat(column, dim=1) for column in zip(*passed, strict=True)))
