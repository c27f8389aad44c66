"""From phases to their trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import computing_on
from torchgco.base.status import Status
from torchgco.explaining.account import Account
from torchgco.kernels import current
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.phases.guess import Rest, guess
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.problem.in_time import factors_in, times_of
from torchgco.solution import Solution
from torchgco.solvers.contracts import Solver
from torchgco.solvers.ending import judged_between


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
    members = [current(one.current()) for one in phases.members]
    with computing_on(members[0].x0.device):
        whole = Whole(phases, members)
        X, U = guess(whole, U0, X0, rest)
        X = X if solver.take_states(whole.problem) else None
        found = solver.solve(whole.problem, U, seed, ids, None, None, max_seconds, X)
        return _of_phases(whole, solver, found)


def _of_phases(whole: Whole, solver: Solver, found: Solution) -> PhasesSolution:
    """A solution of the whole in the phases' own states and controls."""
    parts, lam, status = [], list(found.multipliers.lam), found.status
    for member, form, span in zip(whole.members, whole.forms, whole.spans, strict=True):
        X, U = found.X[:, span.knots, : span.n].contiguous(), found.U[:, span.stages, : span.m].contiguous()
        own, lam = lam[: len(form.constraints)], lam[len(form.constraints) :]
        status = judged_between(form, X, U, status)
        times = None if member.time is None else times_of(member, factors_in(member, X))
        n, m = member.n, member.m
        K, d = found.K[:, span.stages, :m, :n].contiguous(), found.d[:, span.stages, :m].contiguous()
        multipliers = Multipliers(tuple(own[: len(member.constraints)]), found.multipliers.mu)
        parts.append(
            replace(
                found, X=X[..., :n].contiguous(), U=U[..., :m].contiguous(), K=K, d=d, multipliers=multipliers,
                cost=form.cost.total(X, U), violation=violation(form.constraints, X, U), times=times, trace=None,
                search=None, account=Account(member, solver, kernels=found.account and found.account.kernels),
            )
        )  # fmt: skip
    jumps = tuple(
        found.U[:, span.first, : jump.controls].contiguous()
        for span, jump in zip(whole.spans_between, whole.phases.between, strict=True)
    )
    parts = tuple(replace(part, status=status) for part in parts)
    return PhasesSolution(
        whole.phases, parts, jumps, found.cost, found.violation, status, found.iterations, found.multipliers
    )
