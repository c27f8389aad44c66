"""What phases are worth, by the judge of each phase's own problem and the jumps' own functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions, computing_on
from torchgco.base.tree import cast
from torchgco.constraints.base import ADMITTED
from torchgco.judging.certificate import Certificate, certify
from torchgco.judging.judge import Verdict, doubled, in_double, judge
from torchgco.phases.lowered import Whole
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class PhasesVerdict:
    """A `Verdict` for each phase, which begins where the jump leads from the end of the one before; one value per
    problem, (B,), of all together."""

    parts: tuple[Verdict, ...]
    cost: Tensor  # of all phases and jumps
    violation: Tensor  # the largest, of phases and jumps
    clearance: Tensor  # the smallest, m; infinite without obstacles, NaN without a position
    feasible: Tensor  # bool: all phases are, and no row of a jump is violated by more than they admit
    reached: Tensor  # bool: and phases with a goal reach it

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, i: int) -> Verdict:
        return self.parts[i]


def judge_phases(phases: Phases, solution: Any) -> PhasesVerdict:
    """Judge the controls of phases and jumps by their rollout from the first start, in float64.

    Raises:
        InputError: a solution of other phases.
    """
    _check(phases, solution)
    with computing_on(phases.members[0].x0.device):
        phases, verdicts, start, end = phases.current(), list[Verdict](), None, None
        cost = violation = torch.zeros_like(solution.cost, dtype=torch.float64)
        for i, (member, part) in enumerate(zip(phases.members, solution.parts, strict=True)):
            member = in_double(member)
            U = doubled(part.U, "U", member)
            times = None if part.times is None else doubled(part.times, "times", member)
            if start is not None:
                member = member._with({"x0": start})
            free = part.X[:, 0].double() if member.free_start is not None else None
            verdicts.append(judge(member, U, start=free, times=times))
            end = _end(member, U, times, member.x0 if free is None else free)
            if i < len(phases.between):
                jump, v = cast(phases.between[i], torch.float64), doubled(solution.jumps[i], "jumps", member)
                cost, violation = cost + jump.costs(end, v), torch.maximum(violation, jump.violation(end, v))
                start = jump.after(end, v)
        if phases.closing is not None and end is not None:
            violation = torch.maximum(violation, _open(phases, solution[0].X[:, 0], end))
        return _joined(phases, verdicts, cost, violation)


def certify_phases(phases: Phases, solution: Any, asked: Tensor | None) -> Certificate:
    """The certificate of all phases and jumps as one problem.

    Raises:
        InputError: a solution of other phases, or `asked` as of `certify`.
    """
    _check(phases, solution)
    phases, found = phases.current(), solution.found.detach()
    whole = certify(Whole(phases).problem, found.X, found.U, asked, found.multipliers.lam)
    each = []
    for member, part in zip(phases.members, solution.detach(), strict=True):
        here = member._with({"x0": part.X[:, 0].to(member.x0.dtype)}, member.known)
        each.append(certify(here, part.X, part.U, asked, part.multipliers.lam, part.times))
    least, most = torch.fmin, torch.fmax  # NaN of phases without a position, or a field
    return replace(
        whole, clearance=reduce(least, (one.clearance for one in each)),
        step_error=reduce(most, (one.step_error for one in each)),
    )  # fmt: skip


def _check(phases: Phases, solution: Any) -> None:
    if not isinstance(solution, PhasesSolution) or len(solution) != len(phases):
        raise InputError("solution", f"a PhasesSolution of {len(phases)} phases", shown(solution))


def _open(phases: Phases, first: Tensor, last: Tensor) -> Tensor:
    """By how much a loop isn't closed from the first state (B, n) to the last (B, n'), (B,)."""
    assert phases.closing is not None
    n = min(first.shape[-1], last.shape[-1])
    row = cast(phases.closing.bind(Dimensions(len(first), 1, n, 1, None, None, first)), torch.float64)
    return row.worst(torch.stack((first[:, :n].double(), last[:, :n]), dim=1), last.new_zeros(len(last), 1, 1))


def _end(problem: Problem, U: Tensor, times: Tensor | None, start: Tensor) -> Tensor:
    """The last state (B, n) of controls U."""
    n = problem.n
    X0 = start.unsqueeze(1).expand(-1, problem.N + 1, -1)
    form, X, controls = at_times(problem, X0, U, times)
    x = X[:, 0]
    for k in range(form.N):
        x = form.dynamics.at(k).step(x, controls[:, k])
    return x[:, :n]


def _joined(phases: Phases, verdicts: Sequence[Verdict], cost: Tensor, violation: Tensor) -> PhasesVerdict:
    """Of all phases, with the costs and violations (B,) of the jumps."""
    feasible = violation <= ADMITTED
    reached, clearance = torch.ones_like(feasible), torch.full_like(cost, torch.nan)
    for member, verdict in zip(phases.members, verdicts, strict=True):
        cost, violation = cost + verdict.cost, torch.maximum(violation, verdict.violation)
        feasible = feasible & verdict.feasible
        reached = reached & (verdict.reached if member.goal is not None and not member.goal.assumed else True)
        clearance = torch.fmin(clearance, verdict.clearance)
    return PhasesVerdict(tuple(verdicts), cost, violation, clearance, feasible, feasible & reached)
