"""From phases to their trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import computing_on
from torchgco.judging.steps import Costates
from torchgco.kernels import costates, current
from torchgco.phases.guess import Rest, guess
from torchgco.phases.lowered import Span, Whole
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.problem.problem import Problem
from torchgco.sensitivity import asks_for_gradients, attached, check_smoothing
from torchgco.solution import Solution
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
    smoothing: float | None,
    rest: Rest,
) -> PhasesSolution:
    """The solution of phases; arguments are those of `torchgco.solve`.

    Args:
        rest: controls at rest.
    """
    device = phases.members[0].x0.device
    with computing_on(device):
        phases = phases.current()
        whole = phases.derived[WHOLE] = phases.derived.get(WHOLE) or Whole(phases)
        standing = current(whole.problem)
    differentiates, smoothed = asks_for_gradients(whole.problem, standing), check_smoothing(whole.problem, smoothing)
    with computing_on(device):
        if any(one.time is not None for one in whole.members) and solver.choosing_time(whole.problem) is None:
            raise InputError("solver", CHOOSING_TIME, type(solver).__name__)
        X, U = guess(whole, U0, X0, rest) if warm is None else _warm(whole, warm)
        problem = _guessing(standing, X[:, 0])
        X = X if solver.take_states(problem) else None
        multipliers = None if warm is None else warm.found.detach().multipliers
        found = solver.solve(problem, U, seed, ids, multipliers, None, max_seconds, X)
        standing.derived.update(_scale(problem))
        solution = _judged(whole, problem, found, solver)
    if differentiates or smoothed:
        found = attached(whole.problem, problem, solution.found, smoothed, differentiates)
        solution = solution.leading_to(found) if differentiates else replace(solution, found=found)
    return solution


def _judged(whole: Whole, problem: Problem, found: Solution, solver: Solver) -> PhasesSolution:
    """What was found of all phases, with its status between the knots, and warnings of each phase."""
    status = found.status
    for form, span in zip(whole.forms, whole.spans, strict=True):
        status = judged_between(form, *span.own(found.X, found.U), status)
    solution = PhasesSolution(whole, replace(found, status=status), solver)
    slopes = cache(lambda: costates(problem, found.X, found.U, found.multipliers.lam))
    for member, part, span in zip(whole.members, solution, whole.spans, strict=True):
        warn_of(member, part, False, _costates(member, span, slopes))
    return solution


def _guessing(problem: Problem, x: Tensor) -> Problem:
    """All of the phases with a guess x (B, n) of what is free in the first start.

    The scale of the cost, once it is known, doesn't depend on that: there each phase stays where it is given to begin.
    """
    x0 = problem.start_in(x)
    if torch.equal(x0, problem.x0):
        return problem
    return problem._with({"x0": x0}, problem.known, _scale(problem))


def _scale(problem: Problem) -> dict[str, Any]:
    """What the problem has derived of the scale of its cost."""
    return {name: made for name, made in problem.derived.items() if name == "cost_scale"}


def _costates(member: Problem, span: Span, slopes: Callable[[], Tensor | None]) -> Costates:
    """Those of a phase among the slopes (B, N+1, n) of all phases; of some problems of the phase."""

    def of(problem: Problem, X: Tensor, U: Tensor, multipliers: Sequence[Tensor]) -> Tensor | None:
        every = None if member.part_of is not None else slopes()
        rows = slice(None) if problem.part_of is None else problem.part_of[1]
        return None if every is None else every[rows, span.knots]

    return of


def _warm(whole: Whole, warm: Any) -> tuple[Tensor, Tensor]:
    """States and controls of an earlier solution of such phases."""
    if not isinstance(warm, PhasesSolution):
        raise InputError("warm", "a PhasesSolution, or None", type(warm).__name__)
    form = lambda of: (of.spans, of.spans_between, of.problem.row_shapes, of.problem.B)
    if form(warm.whole) != form(whole):
        raise InputError("warm", "a solution of phases of the same stages, states, controls and rows", repr(warm))
    found = warm.found.detach()
    return found.X, found.U
