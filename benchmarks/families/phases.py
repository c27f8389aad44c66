"""python -m benchmarks.families.phases: published problems of several phases, beside IPOPT by hand.

IPOPT gets the same stages, in steps of rk4 by multiple shooting, and begins with the same states, controls and times.
Times are processor time of one thread; IPOPT's is its own, without CasADi's set-up.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

import torchgco
from benchmarks.families import phases_problems as problems
from benchmarks.families import phases_vehicles as vehicles
from benchmarks.families.phases_by_hand import Hand, Solved
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown
from torchgco import Phases, PhasesSolution
from torchgco.native.interior import InteriorKernels
from torchgco.phases.guess import guess
from torchgco.phases.lowered import Whole

HEAD = (
    "problem", "phases", "stages", "status", "cost", "off IPOPT's by", "iterations", "IPOPT's", "ms", "in C",
    "ms of 32", "IPOPT's ms", "ratio", "ratio of 32",
)  # fmt: skip
MANY = 32  # problems of a batch
RUNS = 5  # of which the least time counts


@dataclass(frozen=True)
class Case:
    """A problem, as `phases` of B problems and `by_hand` from a guess; `push`: of all controls at first."""

    phases: Callable[[int], Phases]
    by_hand: Callable[[problems.Guess], Hand]
    push: tuple[float, ...] | None = None


CASES = {
    "bouncing ball": Case(problems.ball, problems.ball_by_hand),
    "two impulses": Case(problems.impulses, problems.impulses_by_hand),
    "two-burn orbit raise": Case(problems.orbit_raise, problems.orbit_raise_by_hand),
    "Delta III": Case(vehicles.launch, vehicles.launch_by_hand, (0.0, 1.0, 0.0)),
    "gears": Case(vehicles.gears, vehicles.gears_by_hand),
    "take-off to cruise": Case(vehicles.take_off, vehicles.take_off_by_hand),
    "pick and place": Case(vehicles.pick_and_place, vehicles.pick_and_place_by_hand),
}


@dataclass(frozen=True)
class Begun:
    """Where both begin: states and controls of each phase, and factors of their times."""

    X0: list[Tensor]
    U0: list[Tensor]
    first: problems.Guess  # of the first problem

    @classmethod
    def of(cls, case: Case, phases: Phases) -> Begun:
        rest = lambda one: one.x0.new_zeros(one.B, one.N, one.m) + one.x0.new_tensor(case.push or (0.0,))
        whole = Whole(phases)
        X, U = guess(whole, None, None, rest)
        X0, U0, first = list[Tensor](), list[Tensor](), problems.Guess()
        for member, span in zip(whole.members, whole.spans, strict=True):
            x, u = span.own(X, U)
            X0.append(x[..., : member.n].contiguous())
            U0.append(u[..., : member.m].contiguous())
            factor = 1.0 if member.time is None else float(x[0, 0, member.n])
            first.append((X0[-1][0].numpy(), U0[-1][0].numpy(), factor))
        return cls(X0, U0, first)


def milliseconds(work: Callable[[], PhasesSolution]) -> tuple[tuple[float, float], PhasesSolution]:
    """The least processor time after a run that compiles, that of the interior point in C within it, and the result."""
    solution, took, inner = work(), list[tuple[float, float]](), list[float]()
    solve = InteriorKernels.solve

    def timed(*arguments: Any) -> Any:
        began = time.process_time()
        try:
            return solve(*arguments)
        finally:
            inner.append(time.process_time() - began)

    with patch.object(InteriorKernels, "solve", timed):
        for _ in range(RUNS):
            inner.clear()
            began = time.process_time()
            solution = work()
            took.append((1e3 * (time.process_time() - began), 1e3 * sum(inner)))
    return min(took), solution


def beside(case: Case) -> tuple[PhasesSolution, Solved, tuple[float, float]]:
    """A case solved by both, and the times of the former."""
    phases = case.phases(1)
    begun = Begun.of(case, phases)
    took, solution = milliseconds(lambda: torchgco.solve(phases, begun.U0, X0=begun.X0))
    return solution, case.by_hand(begun.first).solved(), took


def row(name: str, case: Case) -> list[Any]:
    """A case."""
    solution, theirs, (took, in_c) = beside(case)
    many = case.phases(MANY)
    begun = Begun.of(case, many)
    (every, _), batch = milliseconds(lambda: torchgco.solve(many, begun.U0, X0=begun.X0))
    cost, ended = float(solution.cost), int((batch.status == torchgco.Status.CONVERGED).sum())
    off = abs(cost - theirs.cost) / abs(theirs.cost)
    each, peer, status = every / MANY, theirs.milliseconds, f"{solution.statuses[0].name}, {ended} of {MANY}"
    return [
        name, len(solution), solution.whole.problem.N, status, f"{cost:.8g}", f"{off:.1e}", int(solution.iterations),
        theirs.iterations, f"{took:.1f}", f"{in_c:.1f}", f"{each:.2f}", f"{peer:.1f}", f"{took / peer:.2f}",
        f"{each / peer:.2f}",
    ]  # fmt: skip


def rows(names: list[str]) -> Iterator[list[Any]]:
    for name in names:
        yield row(name, CASES[name])


def table(cases: list[str]) -> str:
    """A row per case."""
    return markdown(HEAD, rows(cases))


main = Command(
    __doc__, "phases", table, "{cases}", "CasADi",
    cases=(list(CASES), "which, by default all", list(CASES)),
)  # fmt: skip

if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
