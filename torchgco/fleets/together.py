"""Fleets as one problem each, solved by the interior point from guesses of all trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES, bent, widths
from torchgco.fleets.joint import joint_problem
from torchgco.fleets.plans import Plans, Solve
from torchgco.solvers.interior import InteriorPoint

MOST_STATES = 64  # the time of an iteration grows with their third power: of 16 discs, or four quadrotors
# Guesses are near: a large barrier would push them apart again.
SOLVER = InteriorPoint(tolerance=1e-6, initial_barrier=1e-2, max_iterations=200)


def around(fleet: Fleet, alone: Plans, conflicts: Tensor, solve: Solve) -> list[Plans]:
    """All vehicles in conflict (B, V) on one side of their ways, as on a roundabout: plans for each side."""
    wide = widths(fleet, conflicts)
    guesses = []
    for side in SIDES:
        vehicles = enumerate(zip(alone.X, fleet.members, strict=True))
        guesses.append([bent(x, one.position, side, wide[:, v]) for v, (x, one) in vehicles])
    return together(fleet, guesses, [alone.U] * len(SIDES), alone, solve)


def together(
    fleet: Fleet, X: list[list[Tensor]], U: list[list[Tensor]], before: Plans, solve: Solve
) -> list[Plans]:
    """Plans from each of several guesses of all trajectories; none where the vehicles can't be one problem."""
    problem = joint_problem(fleet)
    if problem is None:
        return []
    many = problem.take(torch.arange(fleet.B).repeat(len(X)))
    X0, U0 = (torch.cat([torch.cat(guess, dim=-1) for guess in guesses]) for guesses in (X, U))
    found = solve(many, solver=SOLVER, X0=X0, U0=U0, verbose=False)
    sizes = [one.n for one in fleet.members], [one.m for one in fleet.members]
    plans = []
    for rows in torch.arange(many.B).view(len(X), fleet.B):
        states, controls = found.X[rows].split(sizes[0], -1), found.U[rows].split(sizes[1], -1)
        gains = [
            part.split(sizes[0], -1)[v] for v, part in enumerate(found.K[rows].split(sizes[1], -2))
        ]
        status = found.status[rows].unsqueeze(-1).expand(-1, fleet.V).clone()
        iterations = before.iterations + found.iterations[rows].unsqueeze(-1)
        plans.append(Plans([s.contiguous() for s in states], [c.contiguous() for c in controls], gains, status, iterations))
    return plans

