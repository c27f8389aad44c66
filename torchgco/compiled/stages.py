"""What a loop can serve: stages of one length, or a free time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from torchgco.base.errors import InputError
from torchgco.constraints.gates import has_gates
from torchgco.problem.problem import Problem
from torchgco.problem.times import times
from torchgco.receding.plan import STAGE_ROUNDING


def stage_of(problem: Problem) -> float:
    """The length of all stages, s.

    Raises:
        InputError: dynamics without a time step, or with several, a free time, or gates.
    """
    _check_no_gates(problem)
    if problem.time is not None:
        raise InputError("problem", "one of fixed times in a loop", "a free time")
    lengths = times(problem).diff()
    if not torch.allclose(lengths, lengths.flatten()[0], rtol=1e-9):
        raise InputError("dynamics.dt", "stages of one length in a loop", "several")
    return float(lengths.flatten()[0])


def check_loop_in_free_time(problem: Problem, period: float) -> None:
    """Refuse, in one line each, what a loop in free time doesn't serve.

    Raises:
        InputError: gates; a shortest duration below the period; bounds on rates from the controls before.
    """
    time, dt = problem.time, problem.dynamics.dt
    assert time is not None
    _check_no_gates(problem)
    shortest = dt * time.least[:, time.of_stages(problem.N)].sum(-1)
    if bool((shortest < period * (1.0 - STAGE_ROUNDING)).any()):
        raise InputError("time.least", f"a shortest duration of at least a period, {period:g} s", float(shortest.min()))
    if any(map(follows, problem.constraints)):
        expected = "None in a loop in free time, whose stages aren't its periods"
        raise InputError("rate_bounds.previous", expected, "controls")


def follows(part: Any) -> bool:
    """Whether a constraint counts from the controls before."""
    return part.joins_knots and getattr(part, "previous", None) is not None


def previous_of(problem: Problem) -> list[str]:
    """The names of numbers that are the controls before."""
    return [f"constraints[{i}].previous" for i, part in enumerate(problem.constraints) if follows(part)]


def in_periods(problem: Problem, share: float) -> Problem:
    """The problem in a loop whose periods are a share of a stage.

    Controls may change by as much of what they may change from stage to stage: else they could in every period by all
    of it. The bounds have a row per knot. Those of a loop of other periods, which have it, are these from here on.
    """
    rows: list[Any] = list(problem.constraints)
    for i, part in enumerate(rows):
        if follows(part) and part.holds_at(0) and part.share != share:
            knots = torch.arange(problem.N, device=problem.x0.device)[part.knots]
            shares = torch.where(knots == 0, share / part.share, 1.0).to(problem.x0).unsqueeze(-1)
            lower, upper = (bound * shares for bound in part.by_knot)
            rows[i] = replace(part, lower=lower, upper=upper, share=share)
    return replace(problem, constraints=rows)


def _check_no_gates(problem: Problem) -> None:
    if has_gates(problem):
        raise InputError("problem", "one without Gates in a loop, whose plans begin again at their knot 0", "Gates")
