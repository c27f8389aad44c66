"""From phases to their trajectories."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import computing_on
from torchgco.phases.guess import Rest, guess
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.solvers.contracts import CHOOSING_TIME, Solver
from torchgco.solvers.ending import judged_between
from torchgco.warned import warn_of

WHOLE = "whole"  # what phases keep of their solves


def solve_phases(
    phases: Phases,
    solver: Solver,
    U0: Any,
    X0: Any,
    seed: int,
    ids: Tensor | None,
    warm: PhasesSolution | None,
    max_seconds: float | None,
    rest: Rest,
) -> PhasesSolution:
    """The solution of phases; arguments are those of `torchgco.solve`.

    Args:
        rest: controls at rest.
    """
    with computing_on(phases.members[0].x0.device):
        whole = phases.derived[WHOLE] = Whole.current(phases, phases.derived.get(WHOLE))
        if any(one.time is not None for one in whole.members) and solver.choosing_time(whole.problem) is None:
            raise InputError("solver", CHOOSING_TIME, type(solver).__name__)
        X, U = guess(whole, U0, X0, rest) if warm is None else _warm(whole, warm)
        problem = whole.problem.guessing(X[:, 0])
        X = X if solver.take_states(problem) else None
        multipliers = None if warm is None else warm.found.multipliers
        found = solver.solve(problem, U, seed, ids, multipliers, None, max_seconds, X)
        status = found.status
        for form, span in zip(whole.forms, whole.spans, strict=True):
            status = judged_between(form, *span.own(found.X, found.U), status)
        solution = PhasesSolution(whole, replace(found, status=status), solver)
        for member, part in zip(whole.members, solution, strict=True):
            warn_of(member, part, False)
        return solution


def _warm(whole: Whole, warm: Any) -> tuple[Tensor, Tensor]:
    """States and controls of an earlier solution of such phases."""
    if not isinstance(warm, PhasesSolution):
        raise InputError("warm", "a PhasesSolution, or None", type(warm).__name__)
    form = lambda of: (of.spans, of.spans_between, of.problem.row_shapes, of.problem.B)
    if form(warm.whole) != form(whole):
        raise InputError("warm", "a solution of phases of the same stages, states, controls and rows", repr(warm))
    return warm.found.X, warm.found.U
