"""The warnings about a solution: what its problem's horizon, scale, steps and obstacles leave to be said."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchgco.base.errors import NAMED, ContactWarning, HorizonWarning, ScaleWarning, StepWarning
from torchgco.base.status import Status
from torchgco.judging.steps import Kernels, step_errors
from torchgco.judging.worst import NO_PLACE, SHARE, dwarfed, kind_of, noise
from torchgco.kernels import costates, regulated
from torchgco.lagrangian.quality import has_arrived, ranks_arrival
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.search.reach import short_horizons
from torchgco.solution import Solution
from torchgco.solvers.ending import touches

CLAIMS = (Status.CONVERGED, Status.FEASIBLE)  # that the constraints hold


def warn_of(problem: Problem, solution: Solution, cold: bool, kernels: Kernels = (costates, regulated)) -> None:
    """The warnings about a solution, at the caller's caller; of a horizon where no earlier solution led to it.

    Args:
        kernels: as of `step_errors`.
    """
    claims = torch.stack([solution.status == status for status in CLAIMS]).any(0)
    if solution.account is not None:
        problem = solution.account.problem or problem  # whose code may refuse states
    if cold:
        _warn_of_horizon(problem, solution, claims)
    _warn_of_scale(problem, solution, claims)
    _warn_of_steps(problem, solution, claims, kernels)
    _warn_of_contact(problem, solution)


def _warn_of_horizon(problem: Problem, solution: Solution, claims: Tensor) -> None:
    """A HorizonWarning where no feasible trajectory arrives, as none can."""
    if not ranks_arrival(problem) or bool((claims & has_arrived(problem, solution.X)).all()):
        return
    if (told := short_horizons(problem)) is not None:
        warnings.warn(told, HorizonWarning, stacklevel=4)


def _warn_of_contact(problem: Problem, solution: Solution) -> None:
    """A ContactWarning where trajectories keep all rows and are INFEASIBLE between the knots."""
    touching = touches(problem, solution).nonzero().flatten().tolist()
    if touching:
        named = ", ".join(map(str, touching[:NAMED])) + (", ..." if len(touching) > NAMED else "")
        warnings.warn(
            f"{len(touching)} of {problem.B} trajectories are INFEASIBLE, as they touch an obstacle between the knots, "
            f"while all constraints hold at them: problem {named} (to_frame(problem) has their clearance; "
            "shorter time steps help)",
            ContactWarning,
            stacklevel=4,
        )


def _warn_of_scale(problem: Problem, solution: Solution, claims: Tensor) -> None:
    """A ScaleWarning where a violation that counts as feasible leaves little of a constraint."""
    rows = (claims & (solution.violation > noise(solution.X, solution.U))).nonzero().flatten()
    if rows.numel() == 0:
        return
    some, X, U = at_times(
        problem.take(rows), solution.X[rows], solution.U[rows], None if solution.times is None else solution.times[rows]
    )
    place = dwarfed(some, X, U)
    large = (place != NO_PLACE).nonzero().flatten().tolist()
    if large:
        b, i = int(rows[large[0]]), int(place[large[0]])
        warnings.warn(
            f"{len(large)} of {problem.B} trajectories count as feasible although a violation is over {SHARE:.0%} of "
            f"the constraint's own values: problem {b}, constraints[{i}] ({kind_of(problem.constraints[i])}), by up to "
            f"{float(solution.violation[b]):.2g}; choose units in which the constraint is larger, or a smaller "
            "violation_tolerance of the solver",
            ScaleWarning,
            stacklevel=4,
        )


def _warn_of_steps(problem: Problem, solution: Solution, claims: Tensor, kernels: Kernels) -> None:
    """A StepWarning where a trajectory that counts as feasible takes steps that are too long for the model."""
    rows = claims.nonzero().flatten()
    if rows.numel() == 0:
        return
    part, X, U = problem.take(rows), solution.X[rows], solution.U[rows]
    times = None if solution.times is None else solution.times[rows]
    found = step_errors(part, X, U, times, [lam[rows] for lam in solution.multipliers.lam], True, kernels)
    long = found.large.nonzero().flatten().tolist()
    if not long:
        return
    b, count = long[0], f"{len(long)} of {problem.B} trajectories"
    told = f"{count} take steps that are too long for their model: problem {int(rows[b])}, where {found.told(b, part)}"
    better = "a smaller dt"
    if bool(found.of_cost[long].all()):
        told = (
            f"Euler's steps change the costs of {count} by over 1 %: of problem {int(rows[b])} by "
            f"{found.cost_told(b, 2.0)}"
        )
        better = f'integrator="{"rk4" if part.dynamics.integrator == "euler" else "radau5"}", or a smaller dt,'
    warnings.warn(f"{told}; {better} shows what is true", StepWarning, stacklevel=4)
