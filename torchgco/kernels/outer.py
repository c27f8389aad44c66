"""The outer loop by native kernels: the state of running problems in the structure that the library reads."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.ilqr import step as iteration
from torchgco.lagrangian.lagrangian import Lagrangian, PassEnd, State
from torchgco.lagrangian.quality import goal_tolerance, ranks_arrival
from torchgco.native.cuda.engine import Kernel
from torchgco.native.engine import Engine, run
from torchgco.native.structures import End, Options, Outer
from torchgco.problem.problem import Problem

# How an inner solve ended, and step length and mu_r of its last iteration.
END_FLAGS, END_NUMBERS = ("status", "converged", "refused", "lost"), ("alpha", "used")


class NativeOuter:
    """Passes over the problems of a state, in place in its tensors, which it makes contiguous.

    Args:
        options: of the inner solves.
        problem: the b running problems, `s` their state.
        phr: the form of inequalities' terms, as of a `Lagrangian`.
        base: (b,) outer iterations before this solve.
        by_arrival: an iterate that has arrived at a stated goal is preferred to any that hasn't.
        limits: options and constants of the outer loop by name; see `structures.Outer`.
    """

    def __init__(
        self,
        engine: Engine,
        options: Options,
        problem: Problem,
        s: State,
        phr: bool,
        base: Tensor,
        by_arrival: bool,
        **limits: float,
    ) -> None:
        self.engine, self.state, self.b = engine, s, problem.B
        _make_contiguous(s)
        b = problem.B
        self.out = blank_end(b)
        self.outcome = torch.zeros(b, dtype=torch.int64)
        m, best = s.multipliers, s.best
        packed = engine.terms(
            Lagrangian(problem, m, s.penalty, phr), best.multipliers, X=s.X, U=s.U, cost=s.cost, merit=s.merit,
            regularisation=s.regularisation, inner=s.inner, iterations=s.iterations, rung=s.rung, **self.out,
            options=options, limit=options.max_iterations, replicas=1,
        )  # fmt: skip
        near = goal_tolerance(problem) if by_arrival and ranks_arrival(problem) else None
        goal = {} if near is None or problem.goal is None else {"goal": problem.goal.position, "near": near}
        self.packed = packed
        self.outer = Outer(
            of=packed, outer=s.outer, outcome=self.outcome, last_cost=s.last_cost,
            best_X=best.X, best_U=best.U, best_mu=best.multipliers.mu, best_cost=best.cost,
            best_violation=best.violation, base=base.contiguous(),
            **{name: values.contiguous() for name, values in goal.items()},
            passes=1, lifted_steps=iteration.LIFTED_STEPS, lifted_gain=iteration.GAIN, **limits,
        )  # fmt: skip

    def run(self, passes: int) -> None:
        """Up to `passes` inner solves of every problem, each with its outer iteration; until `outcome` says why."""
        self._run(passes=passes, solves=1, updates=1)

    def run_half(self, at_once: int) -> None:
        """Passes until half of the problems have an outcome, or all if lanes suffice; at most `at_once` in a call, and
        all in one of a device.
        """
        function = self.engine.library.tgco_outer
        if isinstance(function, Kernel) and function.pays(self.b):
            at_once = self.b * self.outer.max_outer
        while True:
            running = int((self.outcome.numpy() == Status.RUNNING).sum())
            if running == 0 or (self.b > self.engine.lanes and 2 * running <= self.b):
                return
            self.run(max(1, at_once // running))

    def iterate(self) -> PassEnd:
        """One iteration of every problem's inner solve, without the outer iteration of those that end with it."""
        self.packed.limit = 1
        self._run(passes=1, solves=1, updates=0)
        return pass_end(self.out)

    def update(self) -> None:
        """The outer iterations of the problems whose inner solve has ended."""
        self._run(passes=1, solves=0, updates=1)

    @property
    def ended(self) -> Tensor:
        """(b,) bool: whether the inner solve of the last pass has ended."""
        return self.out["status"] == End.ENDED

    def _run(self, **fields: int) -> None:
        self.outer.fill(fields)
        run(self.engine.library.tgco_outer, self.b, self.engine.lanes, self.outer)


def blank_end(b: int) -> dict[str, Tensor]:
    """What a pass over b problems writes END_FLAGS and END_NUMBERS to."""
    flags = zip(END_FLAGS, torch.zeros(len(END_FLAGS), b, dtype=torch.int32), strict=True)
    return dict(flags) | dict(zip(END_NUMBERS, torch.zeros(len(END_NUMBERS), b, dtype=torch.float64), strict=True))


def pass_end(out: Mapping[str, Tensor]) -> PassEnd:
    """What END_FLAGS and END_NUMBERS say of a pass."""
    status, ended = out["status"], out["status"] == End.ENDED
    failed = ~ended & (status != Status.RUNNING)
    why = torch.where(failed, status.long(), int(Status.RUNNING))
    return PassEnd(ended, out["converged"] != 0, out["refused"] != 0, why, out["alpha"], out["used"], failed)


def _make_contiguous(s: State) -> None:
    for name, value in vars(s).items():
        if isinstance(value, Tensor):
            setattr(s, name, value.contiguous())
