"""Which parts of guidance a problem can't have, found out before anything is solved.

Guidance evaluates a problem in forms that the solver itself never needs: many samples at a time, in single precision,
between spheres in the plane or in space. A user's own functions may not bear these. The parts that fail are left out,
or fall back to the problem's own precision, and the solve goes ahead without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from torchgco.constraints.obstacles import BoundSpheres
from torchgco.expansion import linearise
from torchgco.guidance.detour import Detour
from torchgco.guidance.mppi import MPPI
from torchgco.guidance.scene import scene_of
from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import engine_of
from torchgco.problem import Problem

SAMPLES = 2  # flown as a trial


def suited_sampler(sampler: MPPI | None, problem: Problem) -> tuple[MPPI | None, str | None]:
    """The sampler that a problem can have, or None, and a sentence on what is lost; None where nothing is.

    Raises:
        InputError: a covariance that doesn't fit the controls.
    """
    if sampler is None:
        return None, None
    sampler.check(problem)
    if engine_of(problem) is not None:
        return sampler, None  # natively it samples the same traced functions that the solver runs
    own, wanted, why = _tried(_sample, problem, sampler.dtype)
    if why is None:
        return sampler, None
    if wanted != own and _failure(_sample, problem, own) is None:
        return replace(sampler, dtype=None), f"samples are drawn in {_name(own)}, as {_name(wanted)} fails ({why})"
    return None, f"no plan can be sampled ({why})"


def suited_detour(detour: Detour | None, problem: Problem) -> tuple[Detour | None, str | None]:
    """The same for the geometric proposal. Obstacles that it doesn't serve by design, as moving ones, are no loss.

    Raises:
        InputError: pushes that don't fit the controls.
    """
    if detour is None:
        return None, None
    detour.check(problem)
    position = problem.dynamics.position
    d = 0 if position is None else position.stop - position.start
    if d not in (2, 3) and any(isinstance(c, BoundSpheres) for c in problem.geometric):
        return None, f"no way is sought around spheres in {d}-D, as the roadmap knows 2-D and 3-D alone"
    one = problem.take(torch.zeros(1, dtype=torch.int64, device=problem.x0.device))
    if scene_of(one, one.cost.rest_controls(one.x0.new_zeros(1, one.N, one.m))) is None:
        return detour, None
    why = None if engine_of(problem) is not None else _failure(_expand, problem, problem.x0.dtype)
    return (detour, None) if why is None else (None, f"no way can be followed ({why})")


def _tried(
    trial: Callable[[Problem], None], problem: Problem, dtype: str | None
) -> tuple[torch.dtype, torch.dtype, str | None]:
    """The problem's own precision, the one that is asked for, and why the trial fails there."""
    own = problem.x0.dtype
    wanted = own if dtype is None else getattr(torch, dtype)
    return own, wanted, _failure(trial, problem, wanted)


def _failure(trial: Callable[[Problem], None], problem: Problem, dtype: torch.dtype) -> str | None:
    """Why a trial with the first problem of a batch, in another precision, fails."""
    try:
        trial(problem.take(torch.zeros(1, dtype=torch.int64, device=problem.x0.device)).cast(dtype))
    except Exception as error:  # users' functions fail in ways of their own, and none of them is to end the solve
        return (str(error).splitlines() or [type(error).__name__])[0]
    return None


def _sample(problem: Problem) -> None:
    """One stage of some samples of one problem."""
    x = problem.x0.unsqueeze(1).repeat(1, SAMPLES, 1)
    u = x.new_zeros(1, SAMPLES, problem.m)
    cost = problem.cost.stage(x, u, 0) + problem.cost.terminal(x)
    after = problem.dynamics.step(x, u)
    _check("dynamics", after, x)
    hits = [(constraint.at(after, 1) >= 0).sum(-1) for constraint in problem.geometric]
    for name, rows in (("cost", cost), *(("a constraint", rows) for rows in hits)):
        if rows.shape != x.shape[:2]:
            raise ValueError(f"{name}: shape {tuple(rows.shape)} for samples {tuple(x.shape[:2])}")


def _expand(problem: Problem) -> None:
    """What an iLQR iteration evaluates, for one problem that stays at its start."""
    X = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1)
    U = X.new_zeros(1, problem.N, problem.m)
    _check("dynamics", problem.dynamics.step(X[:, :-1], U), X[:, :-1])
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 1.0), None, True)
    _check("cost", lagrangian.value(X, U)[1], X[:, 0, 0])
    linearise(problem, X, U)
    lagrangian.expand(X, U)


def _check(name: str, got: torch.Tensor, like: torch.Tensor) -> None:
    if got.shape != like.shape or got.dtype != like.dtype:
        got_form, want_form = (f"{_name(z.dtype)} {tuple(z.shape)}" for z in (got, like))
        raise ValueError(f"{name}: {got_form} instead of {want_form}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
