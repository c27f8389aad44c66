"""Where a solve of phases begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.autodiff import jacobian
from torchgco.base.errors import InputError, shown
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Jump, Phases
from torchgco.problem.horizons import states_for_solvers
from torchgco.problem.in_time import fitting_factors
from torchgco.problem.problem import Problem
from torchgco.solvers.contracts import check_states
from torchgco.solvers.straight import straight_line

Rest = Callable[[Problem], Tensor]  # controls (B, N, m) at rest


def per_phase(given: Any, field: str, phases: Phases) -> Sequence[Any]:
    """What is given for each phase, or None for some or all.

    Raises:
        InputError: another number, or another kind of thing.
    """
    if given is None:
        return [None] * len(phases)
    if not isinstance(given, Sequence) or len(given) != len(phases):
        got = f"{len(given)} of them" if isinstance(given, Sequence) else shown(given)
        raise InputError(field, f"a list of {len(phases)}, a tensor or None for each phase", got)
    for i, (one, problem) in enumerate(zip(given, phases.members, strict=True)):
        if one is not None and field == "U0":
            problem.check_controls(one, f"U0[{i}]")
        elif one is not None:
            check_states(one, problem, f"X0[{i}]")
    return given


def guess(whole: Whole, U0: Any, X0: Any, rest: Rest) -> tuple[Tensor, Tensor]:
    """States (B, N+1, n) and controls (B, N, m) of the whole to begin with.

    Args:
        U0, X0: of each phase; None: controls at rest, and states on `_line`.
    """
    controls, states = (per_phase(given, name, whole.phases) for given, name in ((U0, "U0"), (X0, "X0")))
    X, U, n, m = [], [], whole.problem.n, whole.problem.m
    for i, member in enumerate(whole.members):
        u = rest(member) if controls[i] is None else controls[i]
        x = _line(whole, i) if states[i] is None else states[i]
        factors = None if member.time is None else _factors(member, x, u, states[i] is not None)
        x, u = states_for_solvers(member, x, u, factors)
        X.append(x)
        U.append(u)
    rows = []
    for i, u in enumerate(U):
        rows.append(pad(u, (0, m - u.shape[-1])))
        if i < len(whole.landings):
            jump, member, after = whole.phases.between[i], whole.members[i], whole.members[i + 1]
            v = _controls(jump, X[i][:, -1, : member.n], X[i + 1][:, 0, : after.n])
            tau = X[i + 1][:, 0, after.n : after.n + whole.landings[i].frees_time]
            v = torch.cat((v, tau), dim=-1)
            rows.append(pad(v, (0, m - v.shape[-1])).unsqueeze(1))
    return torch.cat([pad(x, (0, n - x.shape[-1])) for x in X], dim=1), torch.cat(rows, dim=1)


def _line(whole: Whole, i: int) -> Tensor:
    """States evenly from a phase's start to what is asked of its end, near where the next phase begins."""
    member, after = whole.members[i], whole.members[min(i + 1, len(whole.members) - 1)]
    return straight_line(member, after.x0 if after is not member and after.n == member.n else None)


def _factors(member: Problem, X: Tensor, U: Tensor, has_states: bool) -> Tensor:
    """The factors (B, S) of a phase's time: those of states that the model goes through, else the guess, else 1."""
    time = member.time
    assert time is not None
    factors = torch.ones_like(time.least) if time.guess is None else time.guess
    if has_states and time.guess is None:
        fitting = fitting_factors(member, X, U)
        factors = torch.where(fitting.isnan(), factors, fitting)
    return factors.clamp(time.least, time.most)


def _controls(jump: Jump, x: Tensor, after: Tensor) -> Tensor:
    """Controls (B, m) of a jump from x (B, n) that lead closest to a state (B, n')."""
    v = x.new_zeros(len(x), jump.controls)
    if jump.controls == 0:
        return v
    (slopes,), misfit = jacobian(lambda v: jump.after(x, v), v), (after - jump.after(x, v)).unsqueeze(-1)
    sound = (torch.isfinite(slopes) & torch.isfinite(misfit)).flatten(1).all(-1).view(-1, 1, 1)
    pair = (torch.where(sound, z, 0.0) for z in (slopes, misfit))
    return torch.linalg.lstsq(*pair).solution.squeeze(-1)
