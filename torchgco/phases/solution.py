"""What is found for phases: a solution of each, and what only all of them together have."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchgco.base.gradients import recording
from torchgco.base.status import Status
from torchgco.base.tree import passed_on
from torchgco.explaining.explain import Account
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Phases
from torchgco.problem.in_time import factors_in, times_of
from torchgco.problem.problem import Problem
from torchgco.solution import Solution


@dataclass(frozen=True)
class PhasesSolution:
    """A `Solution` for each phase, in its own states and controls, and how all of them ended. It has their number.

    Cost, violation and times of `solution[i]` are those of phase i, which begins at 0 s; `begins` says when it does.
    Status and iterations are those of all phases together.
    """

    whole: Whole
    found: Solution  # of the problem that solvers were given
    solver: Any
    live: Whole | None = None  # with gradients recorded, where the solution leads to tensors that ask for them

    cost, violation, status, iterations, statuses, differentiable, why_not = passed_on(
        "found", "cost", "violation", "status", "iterations", "statuses", "differentiable", "why_not"
    )  # (B,) of all phases and jumps: the sum, the largest, metres for lengths, see Status

    @property
    def phases(self) -> Phases:
        return self.whole.phases

    @cached_property
    def parts(self) -> tuple[Solution, ...]:
        """The solutions of the phases."""
        return tuple(self._part(i) for i in range(len(self)))

    @cached_property
    def problems(self) -> tuple[Problem, ...]:
        """The phases' problems, each with its start that was found: for `plot`, `certify` and tables of one."""
        first, *others = self.whole.members
        X = self.found.X.detach()
        starts = (X[:, span.first, : span.n] for span in self.whole.spans[1:])
        pairs = zip(others, starts, strict=True)
        return first, *(one._with({"x0": x[:, : one.n].contiguous()}, one.known) for one, x in pairs)

    @cached_property
    def jumps(self) -> tuple[Tensor, ...]:
        """The controls (B, m) of each jump."""
        spans = zip(self.whole.spans_between, self.phases.between, strict=True)
        return tuple(self.found.U[:, span.first, : jump.controls].contiguous() for span, jump in spans)

    def _part(self, i: int) -> Solution:
        whole, found = self.whole, self.found
        member, form, span = whole.members[i], whole.forms[i], whole.spans[i]
        X, U = span.own(found.X, found.U)
        first, n, m = sum(len(one.constraints) for one in whole.forms[:i]), member.n, member.m
        lam = tuple(found.multipliers.lam[first : first + len(member.constraints)])
        times = None if member.time is None else times_of(member, factors_in(member, X))
        worst = violation(form.constraints, X.detach(), U.detach())
        return replace(
            found, X=X[..., :n].contiguous(), U=U[..., :m].contiguous(), cost=self._cost(i, X, U),
            K=found.K[:, span.stages, :m, :n].contiguous(), d=found.d[:, span.stages, :m].contiguous(),
            multipliers=Multipliers(lam, found.multipliers.mu), violation=worst,
            times=times, trace=None, search=None,
            account=Account(self.problems[i], self.solver, kernels=found.account and found.account.kernels),
        )  # fmt: skip

    def _cost(self, i: int, X: Tensor, U: Tensor) -> Tensor:
        """The cost (B,) of phase i."""
        if self.live is None:
            return self.whole.forms[i].cost.total(X, U)
        with recording():
            cost = self.live.forms[i].cost.total(X, U)
        return torch.where(self.differentiable, cost, cost.detach())

    def leading_to(self, found: Solution) -> PhasesSolution:
        """The same with `found`, which has gradients."""
        phases = self.phases.recorded()
        with recording():
            return replace(self, found=found, live=Whole(phases))

    def detach(self) -> PhasesSolution:
        """The same numbers without gradients."""
        return replace(self, found=self.found.detach(), live=None)

    def __len__(self) -> int:
        return len(self.phases)

    def __getitem__(self, i: int) -> Solution:
        return self.parts[i]

    def __iter__(self) -> Iterator[Solution]:
        return iter(self.parts)

    @property
    def begins(self) -> Tensor:
        """When each phase begins, and the last one ends, (B, P+1), s.

        Raises:
            InputError: a model without a time step.
        """
        lengths = torch.stack([one.duration for one in self.parts], dim=-1)
        return torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)

    @property
    def duration(self) -> Tensor:
        """How long all phases last, (B,), s."""
        return self.begins[:, -1]

    def __repr__(self) -> str:
        ended = ", ".join(f"{count} {Status(s).name}" for s, count in Counter(self.status.tolist()).items())
        return f"PhasesSolution(B={self.phases.B}, {len(self)} phases: {ended})"
