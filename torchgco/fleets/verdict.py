"""The quality of a fleet's controls: each vehicle as `judge` has it, and how close any two come, between knots too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.constraints.base import ADMITTED, CONTACT_FACTOR
from torchgco.dynamics.rollout import open_loop
from torchgco.fleets.fleet import Fleet
from torchgco.judging.judge import Verdict, judge
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem
from torchgco.problem.times import PIECES_AT_MOST, between


@dataclass(frozen=True)
class FleetVerdict:
    """One value per fleet, (B,), of vehicles that are simulated from their controls alone."""

    vehicles: tuple[Verdict, ...]  # of each vehicle among its own obstacles
    cost: Tensor  # the sum of all vehicles
    # Smallest distance between two centres that keep one, at any time, m; infinite where none do.
    least_distance: Tensor
    apart: Tensor  # (B, V) bool: whether a vehicle keeps its distances at the knots, and touches nobody between them
    violation: Tensor  # largest of the vehicles and of pairs at the knots
    clearance: Tensor  # smallest distance to contact of vehicles and pairs, between the knots too, m
    feasible: Tensor  # bool: every vehicle is, pairs keep their distance at the knots, and none touches between them
    reached: Tensor  # bool: feasible, and every vehicle with a stated goal has reached it
    makespan: Tensor  # s, after which all stay within their goals' radii; NaN where one doesn't, or states no goal


def judge_fleet(fleet: Fleet, U: Sequence[Tensor]) -> FleetVerdict:
    """Judge controls (B, N, m) of each vehicle.

    Raises:
        InputError: as `judge`.
    """
    verdicts: list[Any] = [None] * fleet.V
    X: list[Tensor] = [*U]
    for problem, whose in fleet.forms:
        controls = torch.cat([U[v] for v in whose])
        verdict, states = judge(problem, controls), open_loop(problem.dynamics, problem.x0, controls)
        for place, v in enumerate(whose):
            rows = slice(place * fleet.B, (place + 1) * fleet.B)
            verdicts[v], X[v] = take(verdict, rows), states[rows]
    i, j = fleet.pairs_kept
    keep, p = fleet.distances[i, j], fleet.places(X)
    at_knots = (p[:, i] - p[:, j]).norm(dim=-1).amin(-1)
    least = torch.minimum(at_knots, _least(fleet, X, U))
    touches = ~((keep - at_knots <= ADMITTED) & (least >= CONTACT_FACTOR * keep))  # places that aren't finite do
    close = touches.long().new_zeros(fleet.B, fleet.V).index_add(1, i, touches.long()).index_add(1, j, touches.long())
    short, touch = (keep - at_knots).amax(-1).clamp(min=0.0), (least - CONTACT_FACTOR * keep).amin(-1)
    violation = torch.stack([v.violation for v in verdicts]).amax(0).maximum(short)
    own = torch.stack([v.clearance for v in verdicts]).amin(0)
    feasible = torch.stack([v.feasible for v in verdicts]).all(0) & ~touches.any(-1)
    cost, reached = torch.stack([v.cost for v in verdicts]).sum(0), feasible & served(fleet, verdicts).all(-1)
    return FleetVerdict(
        tuple(verdicts), cost, least.amin(-1), close == 0, violation, torch.minimum(own, touch), feasible, reached,
        makespan(fleet, X),
    )  # fmt: skip


def served(fleet: Fleet, verdicts: Sequence[Verdict]) -> Tensor:
    """Which vehicles are feasible among their own obstacles, and at the goals that they state, (B, V) bool."""
    each = zip(verdicts, fleet.members, strict=True)
    return torch.stack([v.feasible & (v.reached | (not states_goal(one))) for v, one in each], dim=1)


def states_goal(one: Problem) -> bool:
    """Whether a vehicle's goal was given, not read from its cost."""
    return one.goal is not None and not one.goal.assumed


def makespan(fleet: Fleet, X: Sequence[Tensor]) -> Tensor:
    """When the last vehicle comes to stay within its goal's radius, (B,), s; NaN where one doesn't, or states none."""
    last = X[0].new_zeros(fleet.B)
    for one, x in zip(fleet.members, X, strict=True):
        if not states_goal(one):
            return torch.full_like(last, torch.nan)
        assert one.goal is not None
        away = (x[..., one.position] - one.goal.position.unsqueeze(1)).norm(dim=-1)
        out = ~(away <= one.goal.radius.view(-1, 1))
        k = torch.arange(x.shape[1], device=x.device)
        stays = torch.where(out, k + 1, 0).amax(-1).to(last.dtype)
        last = torch.maximum(last, torch.where(out[:, -1], torch.nan, stays))
    return fleet.dt * last


def _least(fleet: Fleet, X: Sequence[Tensor], U: Sequence[Tensor]) -> Tensor:
    """Smallest distances (B, Q) of the pairs, along chords that paths leave by no more than 1e-3 m."""
    p = fleet.places(X)
    off = torch.stack([leaves_chords(*part) for part in zip(fleet.members, X, U, strict=True)]).amax(0)
    pieces = (off / ADMITTED).nan_to_num(1.0, 1.0, 1.0).sqrt().ceil().clamp(1, PIECES_AT_MOST).long()
    i, j = fleet.pairs_kept
    found = p.new_empty(fleet.B, len(i))
    for count in pieces.unique().tolist():
        rows = (pieces == count).nonzero().flatten()
        fine = p[rows]
        if count > 1:
            members, x, u = [one.take(rows) for one in fleet.members], [x[rows] for x in X], [u[rows] for u in U]
            inner = fleet.places([_within(*one, count) for one in zip(members, x, u, strict=True)])
            inner = inner.unflatten(2, (fleet.N, count - 1))
            ahead = torch.cat((fine[:, :, :-1].unsqueeze(3), inner), dim=3).flatten(2, 3)
            fine = torch.cat((ahead, fine[:, :, -1:]), dim=2)
        for b, way in zip(rows.tolist(), fine, strict=True):  # one fleet at a time: bounds the memory
            away = way[i] - way[j]
            found[b] = segment_distance(away[:, :-1], away[:, 1:]).amin(-1)
    return found


def leaves_chords(one: Problem, X: Tensor, U: Tensor) -> Tensor:
    """By how much the positions of a vehicle leave their chords halfway between knots, (B,), m."""
    p, middle = X[..., one.position], _within(one, X, U, 2)[..., one.position]
    return (middle - 0.5 * (p[:, :-1] + p[:, 1:])).norm(dim=-1).amax(-1)


def _within(one: Problem, X: Tensor, U: Tensor, count: int) -> Tensor:
    """States (B, N (count - 1), n) at the ends of all but the last of `count` pieces of each stage."""
    dt = float(one.dynamics.dt)
    k = torch.arange(one.N, device=X.device).repeat_interleave(count - 1)
    h = dt / count * torch.arange(1, count, dtype=X.dtype, device=X.device).repeat(one.N)
    return between(one.dynamics, X, U, k, h, torch.full_like(h, dt))
