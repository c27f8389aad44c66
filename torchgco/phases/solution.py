"""What is found for phases, and how: a solution of each, what all together have, and what the judge makes of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.gradients import recording
from torchgco.base.shapes import Dimensions, computing_on
from torchgco.base.status import Status
from torchgco.base.tree import cast, passed_on
from torchgco.constraints.base import ADMITTED
from torchgco.explaining.explain import Account
from torchgco.judging.certificate import Certificate, certify
from torchgco.judging.judge import Verdict, doubled, in_double, judge
from torchgco.judging.steps import Costates, costates_of, differences, first_order_cost
from torchgco.kernels import costates, current
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.phases.guess import Rest, guess
from torchgco.phases.lowered import Span, Whole
from torchgco.phases.phases import Phases
from torchgco.problem.in_time import at_times, factors_in, times_of
from torchgco.problem.problem import Problem
from torchgco.sensitivity import asks_for_gradients, attached, check_smoothing
from torchgco.solution import Solution
from torchgco.solvers.contracts import CHOOSING_TIME, Solver
from torchgco.solvers.ending import judged_between
from torchgco.warned import warn_of


class OfPhases:
    """What solutions and answers of phases share: one for each phase, in its own states and controls."""

    whole: Whole
    found: Any  # of the problem that solvers were given, with X, U and K

    def _part(self, i: int) -> Any:
        raise NotImplementedError

    @property
    def phases(self) -> Phases:
        return self.whole.phases

    @cached_property
    def parts(self) -> tuple[Any, ...]:
        """Those of the phases."""
        return tuple(self._part(i) for i in range(len(self)))

    @cached_property
    def jumps(self) -> tuple[Tensor, ...]:
        """The controls (B, m) of each jump."""
        spans = zip(self.whole.spans_between, self.phases.between, strict=True)
        return tuple(self.found.U[:, span.first, : jump.controls].contiguous() for span, jump in spans)

    def _trajectory(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        """States and controls of phase i in the form of solvers, and its own gains."""
        span, member = self.whole.spans[i], self.whole.members[i]
        gains = self.found.K[:, span.stages, : member.m, : member.n].contiguous()
        return *span.own(self.found.X, self.found.U), gains

    @property
    def begins(self) -> Tensor:
        """When each phase begins, and the last one ends, (B, P+1), s.

        Raises:
            InputError: a model without a time step.
        """
        each = [one.duration for one in self.parts]
        if any(length is None for length in each):
            raise InputError("phases", "models with a time step", "one without")
        lengths = torch.stack(each, dim=-1)
        return torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)

    @property
    def duration(self) -> Tensor:
        """How long all phases last, (B,), s."""
        return self.begins[:, -1]

    def __len__(self) -> int:
        return len(self.phases)

    def __getitem__(self, i: int) -> Any:
        return self.parts[i]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.parts)


@dataclass(frozen=True)
class PhasesSolution(OfPhases):
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

    @cached_property
    def problems(self) -> tuple[Problem, ...]:
        """The phases' problems, each with its start that was found: for `plot`, `certify` and tables of one."""
        first, *others = self.whole.members
        X = self.found.X.detach()
        starts = (X[:, span.first, : span.n] for span in self.whole.spans[1:])
        pairs = zip(others, starts, strict=True)
        return first, *(one._with({"x0": x[:, : one.n].contiguous()}, one.known) for one, x in pairs)

    def _part(self, i: int) -> Solution:
        whole, found = self.whole, self.found
        member, form, span = whole.members[i], whole.forms[i], whole.spans[i]
        X, U, K = self._trajectory(i)
        first, n, m = sum(len(one.constraints) for one in whole.forms[:i]), member.n, member.m
        lam = tuple(found.multipliers.lam[first : first + len(member.constraints)])
        times = None if member.time is None else times_of(member, factors_in(member, X))
        worst = violation(form.constraints, X.detach(), U.detach())
        return replace(
            found, X=X[..., :n].contiguous(), U=U[..., :m].contiguous(), cost=self._cost(i, X, U),
            K=K, d=found.d[:, span.stages, :m].contiguous(),
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

    def __repr__(self) -> str:
        ended = ", ".join(f"{count} {Status(s).name}" for s, count in Counter(self.status.tolist()).items())
        return f"PhasesSolution(B={self.phases.B}, {len(self)} phases: {ended})"


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
    lowered = Whole(phases)
    whole = certify(lowered.problem, found.X, found.U, asked, found.multipliers.lam)
    each = list[Certificate]()
    for member, part in zip(phases.members, solution.detach(), strict=True):
        here = member._with({"x0": part.X[:, 0].to(member.x0.dtype)}, member.known)
        each.append(certify(here, part.X, part.U, asked, part.multipliers.lam, part.times))
    least, most = torch.fmin, torch.fmax  # NaN of phases without a position, or a field
    return replace(
        whole, clearance=reduce(least, (one.clearance for one in each)),
        step_error=reduce(most, (one.step_error for one in each)),
        step_cost=_step_cost(lowered, solution.detach(), whole),
    )  # fmt: skip


def _step_cost(whole: Whole, solution: Any, certificate: Certificate) -> Tensor:
    """By how much the steps of all phases change the cost of all, as of `StepErrors`, to first order; NaN where nothing
    is certified, or no phase has a known field."""
    costs, none = torch.full_like(certificate.dynamics_residual, torch.nan), True
    rows, found = (~certificate.dynamics_residual.isnan()).nonzero().flatten(), solution.found
    problem = in_double(whole.problem.take(rows))
    X, U = (z[rows].double() for z in (found.X, found.U))
    e = X.new_zeros(len(rows), problem.N, problem.n)
    for member, part, span in zip(whole.members, solution, whole.spans, strict=True):
        times = None if part.times is None else part.times[rows].double()
        own = part.X[rows].double(), part.U[rows].double()
        of_phase = differences(in_double(member.take(rows)), *own, times)
        if of_phase is not None:
            e[:, span.stages, : member.n], none = of_phase, False
    if len(rows) and not none:
        lams = [lam[rows].double() for lam in found.multipliers.lam]
        with suppress(RuntimeError):  # code that autograd can't differentiate
            costs[rows] = first_order_cost(problem, X, U, e, costates_of(problem, X, U, lams))
    return costs


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
        warn_of(member, part, False, (_costates(member, span, slopes), None))
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
