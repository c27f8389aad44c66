"""Whether a problem can be sampled, checked before anything is solved.

MPPI evaluates a problem in forms that the solver itself never needs: many samples at a time, in single precision. A
user's own functions may fail there. Then the sampler falls back to the problem's own precision, or is left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import torch

from torchgco.base.errors import GuidanceWarning, first_line
from torchgco.base.shapes import repeated
from torchgco.guidance.mppi import MPPI
from torchgco.kernels import kernels_of
from torchgco.problem.problem import Problem

TRIAL_SAMPLES = 2  # of a trial


def suited_sampler(sampler: MPPI | None, problem: Problem) -> tuple[MPPI | None, str | None]:
    """The usable sampler, or None; and a sentence on what is lost, or None.

    Raises:
        InputError: a covariance that doesn't fit the controls.
    """
    if sampler is None:
        return None, None
    sampler.check(problem)
    if kernels_of(problem).compiled:
        return sampler, None  # natively it samples the same traced functions that the solver runs
    dtype = problem.x0.dtype
    wanted = dtype if sampler.dtype is None else getattr(torch, sampler.dtype)
    why = failure(_sample, problem, wanted)
    if why is None:
        return sampler, None
    if wanted != dtype and failure(_sample, problem, dtype) is None:
        return replace(sampler, dtype=None), f"samples are drawn in {_name(dtype)}, as {_name(wanted)} fails ({why})"
    return None, f"no trajectory can be sampled ({why})"


def suited_guide(sampler: MPPI | None, problem: Problem) -> tuple[MPPI | None, str | None]:
    """`suited_sampler` for a sampler that guides a solver, which needs a position."""
    if sampler is not None and problem.dynamics.position is None:
        return None, "the dynamics have no position"
    return suited_sampler(sampler, problem)


def warn_of_losses(losses: list[str], solved_without: bool) -> None:
    """One GuidanceWarning that names the parts of guidance that can't serve; none where all can."""
    if losses:
        effect = "solved without guidance" if solved_without else "guided in part"
        warnings.warn(f"{effect}: {'; '.join(dict.fromkeys(losses))}", GuidanceWarning, stacklevel=6)


def failure(trial: Callable[[Problem], None], problem: Problem, dtype: torch.dtype) -> str | None:
    """Why a trial with the first problem of a batch, in another precision, fails."""
    try:
        trial(problem.take(torch.zeros(1, dtype=torch.int64, device=problem.x0.device)).cast(dtype))
    except Exception as error:  # users' functions may raise anything, and no such error may end the solve
        return first_line(error)
    return None


def _sample(problem: Problem) -> None:
    """One stage of some samples of one problem."""
    x = repeated(problem.x0, TRIAL_SAMPLES)
    u = x.new_zeros(1, TRIAL_SAMPLES, problem.m)
    cost = problem.cost.stage(x, u, 0) + problem.cost.terminal(x)
    after = problem.dynamics.at(0).step(x, u)
    check_form("dynamics", after, x)
    hits = [(constraint.at(after, 1) >= 0).sum(-1) for constraint in problem.geometric]
    for name, rows in (("cost", cost), *(("a constraint", rows) for rows in hits)):
        if rows.shape != x.shape[:2]:
            raise ValueError(f"{name}: shape {tuple(rows.shape)} for samples {tuple(x.shape[:2])}")


def check_form(name: str, got: torch.Tensor, like: torch.Tensor) -> None:
    if got.shape != like.shape or got.dtype != like.dtype:
        got_form, want_form = (f"{_name(z.dtype)} {tuple(z.shape)}" for z in (got, like))
        raise ValueError(f"{name}: {got_form} instead of {want_form}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
