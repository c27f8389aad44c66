"""Fleets as one problem each, solved by the interior point from guesses of all trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.base import CONTACT_FACTOR
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import bent, in_conflict, widths
from torchgco.fleets.joint import joint_problem
from torchgco.fleets.plans import Plans, Solve
from torchgco.solvers.interior import InteriorPoint

MOST_STATES = 64  # the time of an iteration grows with their third power: of 16 discs, or four quadrotors
MOST_HALFWAY = 8  # vehicles: 28 pairs
# Guesses are near: a large barrier would push them apart again.
SOLVER = InteriorPoint(tolerance=1e-6, initial_barrier=1e-2, max_iterations=200)


def around(fleet: Fleet, alone: Plans, side: float, solve: Solve) -> list[Plans]:
    """All vehicles in conflict on one side of their ways, as on a roundabout."""
    wide = widths(fleet, in_conflict(fleet, alone))
    vehicles = enumerate(zip(alone.X, fleet.members, strict=True))
    guess = [bent(x, one.position, side, wide[:, v]) for v, (x, one) in vehicles]
    return together(fleet, guess, alone.U, alone, solve)


def together(fleet: Fleet, X: list[Tensor], U: list[Tensor], before: Plans, solve: Solve) -> list[Plans]:
    """Plans from a guess of all trajectories; none where the vehicles can't be one problem.

    They keep halfway between the knots the distance that they keep at these. Of many pairs no code is made for that,
    which takes long: they keep so much more at the knots that they don't touch between them at the guess's speeds.
    """
    problem = joint_problem(fleet, halfway := fleet.V <= MOST_HALFWAY)
    if problem is None:
        return []
    by = torch.zeros_like(X[0][:, 0, 0]) if halfway else nearer_between(fleet, fleet.places(X))
    found = solve(problem.grown(by), solver=SOLVER, X0=torch.cat(X, dim=-1), U0=torch.cat(U, dim=-1))
    sizes = [one.n for one in fleet.members], [one.m for one in fleet.members]
    states, controls = found.X.split(sizes[0], -1), found.U.split(sizes[1], -1)
    gains = [part.split(sizes[0], -1)[v].contiguous() for v, part in enumerate(found.K.split(sizes[1], -2))]
    status = found.status.unsqueeze(-1).expand(-1, fleet.V).clone()
    iterations = before.iterations + found.iterations.unsqueeze(-1)
    return [Plans([x.contiguous() for x in states], [u.contiguous() for u in controls], gains, status, iterations)]


def nearer_between(fleet: Fleet, p: Tensor) -> Tensor:
    """By how much more pairs have to keep at the knots, (B,), m, not to touch between them along places (B, V, K, d).

    Two that keep r at both ends of a stage in which they move w past each other come as near as sqrt(r^2 - w^2 / 4).
    """
    more = torch.zeros_like(p[:, 0, 0, 0])
    for i, j in fleet.distances.triu().nonzero().tolist():
        keep, away = fleet.distances[i, j], p[:, i] - p[:, j]
        step = away.diff(dim=1).norm(dim=-1)
        near = torch.minimum(away[:, :-1].norm(dim=-1), away[:, 1:].norm(dim=-1)) < keep + step
        half = torch.where(near, 0.5 * step, 0.0).amax(-1)
        more = torch.maximum(more, ((CONTACT_FACTOR * keep).square() + half.square()).sqrt() - keep)
    return more
