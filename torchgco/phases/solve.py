"""From phases to their trajectories."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.shapes import computing_on
from torchgco.phases.guess import Rest, guess
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.solvers.contracts import Solver
from torchgco.solvers.ending import judged_between

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
        X, U = guess(whole, U0, X0, rest)
        X = X if solver.take_states(whole.problem) else None
        found = solver.solve(whole.problem, U, seed, ids, None, None, max_seconds, X)
        status = found.status
        for form, span in zip(whole.forms, whole.spans, strict=True):
            status = judged_between(form, *span.own(found.X, found.U), status)
        return PhasesSolution(whole, replace(found, status=status), solver)
