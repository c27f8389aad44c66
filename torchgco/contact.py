"""A word where a returned trajectory passes the solver's test at the knots and touches an obstacle between them."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchgco.base.errors import ContactWarning
from torchgco.base.status import Status
from torchgco.judging.judge import CLEARANCES, by_kind
from torchgco.problem.problem import Problem
from torchgco.solution import Solution

CLAIMS = (Status.CONVERGED, Status.FEASIBLE)  # that the constraints hold
NAMED = 5  # problems that the warning names


def warned_of_contact(problem: Problem, solution: Solution) -> Solution:
    """The solution, with a ContactWarning at the caller's caller where trajectories touch obstacles between knots.

    Only trajectories with a status of CLAIMS count; obstacles of a kind that the judge doesn't know are left out.
    """
    touching = touches(problem, solution).nonzero().flatten().tolist()
    if touching:
        named = ", ".join(map(str, touching[:NAMED])) + (", ..." if len(touching) > NAMED else "")
        warnings.warn(
            f"{len(touching)} of {problem.B} trajectories touch an obstacle between the knots, which their status does "
            f"not show: problem {named} (to_frame(problem) has their clearance; shorter time steps help)",
            ContactWarning,
            stacklevel=3,
        )
    return solution


def touches(problem: Problem, solution: Solution) -> Tensor:
    """Which trajectories (B,) claim to be feasible and come below a clearance of 0 m, by the judge's distances."""
    found = torch.stack([solution.status == status for status in CLAIMS]).any(0)
    rows = found.nonzero().flatten()
    if rows.numel() == 0:
        return found
    nearest = torch.full_like(solution.cost[rows], torch.inf)
    for part in problem.constraints:
        if isinstance(part, tuple(CLEARANCES)):
            nearest = torch.minimum(nearest, by_kind(CLEARANCES, part)(part.take(rows), solution.X[rows])[1])
    found[rows] = nearest < 0
    return found
