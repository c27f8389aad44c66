"""IPOPT and FATROP through CasADi, for any Problem: established solvers to compare with.

The model isn't written twice: its step, cost and constraints are traced (`torchgco.tracing`) and become one nonlinear
program with exact derivatives (`nlp`). Every problem of the batch is a set of its parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from torchgco.base.clock import setting_up
from torchgco.base.errors import InputError
from torchgco.base.options import Count, Positive, Seconds
from torchgco.base.status import Status
from torchgco.baselines.hold import rolled_out
from torchgco.baselines.limited import limited
from torchgco.dynamics.rollout import open_loop
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Progress, Solver
from torchgco.solvers.timing import Chooser

if TYPE_CHECKING:
    from torchgco.baselines.nlp import Program

_End = tuple[Status, int]  # how the solver ended, and its iterations


@dataclass(frozen=True)
class CasADiSolver(Solver, named="solver"):
    """An interior-point solver on the multiple-shooting program, one problem of the batch after the other.

    Args:
        plugin: "ipopt" (with MUMPS) or "fatrop" (a Riccati recursion by stages).
        max_iterations: of each problem.
        tolerance: the plugin's own, on its optimality conditions.
        violation_tolerance: violation (metres for lengths) up to which a result counts as feasible.
        max_seconds: of each problem, beside that of the whole solve. A limited problem is solved in a process that ends
            then, as a plugin may hang: its guess is returned. The program is built before.
        options: further options of the plugin, by its names.

    Raises:
        InputError: a field out of its range.
    """

    kernels: ClassVar[str | None] = "casadi"

    plugin: Literal["ipopt", "fatrop"] = "ipopt"
    max_iterations: Count = 1000
    tolerance: Positive = 1e-8
    violation_tolerance: Positive = ADMITTED
    max_seconds: Seconds | None = None
    options: Mapping[str, Any] | None = None

    def prepare(self, problem: Problem) -> Solver:
        """The program and the solver built for one batch, so that a solve takes the plugin's time alone.

        Where the time is free this solver itself, which makes several programs.

        Raises:
            InputError: a part of the problem that can't be traced, an operation without a counterpart in CasADi, an
                option that the plugin refuses, or (FATROP) rows that join several knots; CasADi isn't installed.
        """
        problem = current_problem(problem)
        return self if problem.time is not None else self._prepared(problem)

    @setting_up()
    def _prepared(self, problem: Problem) -> PreparedCasADi:
        # Not where the solver is made: presets and commands name it also where CasADi isn't installed.
        if find_spec("casadi") is None:
            raise InputError("solver", "CasADi (`pip install casadi`)", "no such module")
        import casadi

        from torchgco.baselines.nlp import transcribe

        program = transcribe(problem)
        nlp = {"x": program.variables, "p": program.parameters, "f": program.objective, "g": program.rows}
        try:
            function = casadi.nlpsol("solver", self.plugin, nlp, self._options(problem, program))
        except RuntimeError as error:
            raise _refused(self.plugin, error) from None
        return PreparedCasADi(self, problem, program, function)

    def run(self, call: Call) -> Solution:
        """From U0 and its rollout; X is the rollout of the controls found. Raises the errors of `prepare`, too."""
        return self._prepared(call.problem).run(call)

    def frees_start(self, problem: Problem) -> bool:
        """Where the same components are free in all problems."""
        return True

    def take_states(self, problem: Problem) -> bool:
        """Always."""
        return True

    def choosing_time(self, problem: Problem) -> Chooser:
        """This solver."""
        return Chooser(self, self, self.violation_tolerance)

    def _options(self, problem: Problem, program: Program) -> dict[str, Any]:
        """Options of the plugin and of CasADi around it; neither prints."""
        quiet = {"print_time": False, "show_eval_warnings": False}
        chosen = dict(self.options or {})
        if self.plugin == "ipopt":
            defaults = {"print_level": 0, "sb": "yes", "max_iter": self.max_iterations, "tol": self.tolerance}
            return {**quiet, "ipopt": {**defaults, **chosen}}
        defaults = {"print_level": 0, "max_iter": self.max_iterations, "tolerance": self.tolerance}
        return {
            **quiet,
            "fatrop": {**defaults, **chosen},
            "structure_detection": "manual",  # the stages are known: nothing to guess
            "N": problem.N,
            "nx": [problem.n] * (problem.N + 1),
            "nu": [problem.m + program.unknowns.size2_out(0)] * problem.N + [0],
            "ng": program.path_rows,
            "equality": program.equality,
        }


@dataclass(frozen=True)
class PreparedCasADi(Solver):
    """A CasADiSolver with all that one batch needs, built."""

    solver: CasADiSolver
    problem: Problem
    program: Program
    function: Any  # casadi.Function

    joins_knots: ClassVar[bool] = True
    kernels: ClassVar[str | None] = "casadi"

    def frees_start(self, problem: Problem) -> bool:
        """As the solver."""
        return True

    def take_states(self, problem: Problem) -> bool:
        """As the solver."""
        return True

    def run(self, call: Call) -> Solution:
        """As `CasADiSolver.run`, one problem after the other, without those whose start is invalid.

        Raises:
            InputError: another problem than the prepared one.
        """
        problem, U0 = call.problem, call.U0
        if not problem.is_same(self.problem):
            raise InputError("problem", "the one that was prepared", "another")
        X0 = open_loop(problem.dynamics, problem.x0, U0) if call.X0 is None else call.X0
        X0 = torch.where(torch.isfinite(X0), X0, problem.x0.unsqueeze(1))
        valid = problem.start_is_clear & torch.isfinite(problem.x0).all(-1)
        U, start, ends = U0.clone(), problem.x0.clone(), [(Status.CONVERGED, 0)] * problem.B
        limit, left = math.inf if self.solver.max_seconds is None else self.solver.max_seconds, list(range(problem.B))
        while left:
            cut = []
            for done, b in enumerate(left):
                # One that hangs takes its share of the time alone; what others leave of theirs is for those cut short.
                share, before = call.seconds_left / (len(left) - done), ends[b]
                if bool(valid[b]):
                    start[b], U[b], ends[b] = self._one(b, X0[b], U0[b], min(share, limit))
                if ends[b][0] == Status.TIME_LIMIT and 0.0 < share < limit:
                    cut.append(b)
                if call.callback is not None and before[0] != Status.TIME_LIMIT:
                    rows = torch.arange(b, b + int(valid[b]), device=U.device)
                    call.callback(Progress(b + 1, rows, b + 1, problem.B))
            left = cut if len(cut) < len(left) else []  # a share that all needed won't be larger
        solution = rolled_out(problem.held_at(start), U, self.solver.violation_tolerance, iterations=0)
        return _with_ends(solution, ends)

    def of(self, problem: Problem) -> PreparedCasADi:
        """The same solver for other problems of the same form: only the parts' own numbers may differ.

        Raises:
            InputError: a problem of another form.
        """
        problem = current_problem(problem)
        return replace(self, problem=problem, program=self.program.of(problem))

    def _one(self, b: int, X0: Tensor, U0: Tensor, seconds: float) -> tuple[Tensor, Tensor, _End]:
        """The start (n,) and the controls (N, m) of problem b, found in so many seconds, and how it ended."""
        n, size = X0.shape[-1], self.program.variables.numel()
        p = self.program.values(self.problem, b)
        lower, upper = self.program.limits.bounds(p, size)
        guess = self._guess(X0, U0, p)
        highest = np.zeros(len(self.program.equality))
        lowest = np.where(self.program.equality, 0.0, -np.inf)

        def solve() -> tuple[np.ndarray, bool, int]:
            result = self.function(x0=guess, p=p, lbx=lower, ubx=upper, lbg=lowest, ubg=highest)
            stats = self.function.stats()
            return np.array(result["x"]).reshape(-1)[:-n], bool(stats["success"]), int(stats["iter_count"])

        try:
            if seconds <= 0.0:
                raise TimeoutError
            result, success, iterations = solve() if seconds == math.inf else limited(solve, seconds)
        except TimeoutError:
            return X0[0], U0, (Status.TIME_LIMIT, 0)
        except (RuntimeError, ChildProcessError) as error:  # crossed bounds, for example; others are still solved
            if "option" in str(error).lower():  # FATROP reads its options only here
                raise _refused(self.solver.plugin, error) from None
            return X0[0], U0, (Status.LINE_SEARCH_FAILED, 0)
        v = torch.from_numpy(result).to(U0).view(U0.shape[0], -1)
        at_limit = iterations >= self.solver.max_iterations
        failed = Status.MAX_ITERATIONS if at_limit else Status.LINE_SEARCH_FAILED
        return v[0, :n], v[:, n : n + U0.shape[-1]], (Status.CONVERGED if success else failed, iterations)

    def _guess(self, X0: Tensor, U0: Tensor, p: np.ndarray) -> np.ndarray:
        """All variables, of parameters p: the unknowns of implicit steps where Newton's method begins."""
        count = self.program.unknowns.size2_out(0)

        def placed(unknowns: Tensor) -> np.ndarray:
            stages = torch.cat((X0[:-1], U0, unknowns), dim=-1).flatten()
            return torch.cat((stages, X0[-1])).double().cpu().numpy()

        v = placed(U0.new_zeros(len(U0), count))
        return placed(torch.as_tensor(np.asarray(self.program.unknowns(v, p))).to(U0)) if count else v


def _refused(plugin: str, error: Exception) -> InputError:
    message = " ".join(str(error).split())[-300:]  # CasADi names the cause last
    return InputError("solver", f"a problem and options that {plugin} takes", message)


def _with_ends(solution: Solution, ends: list[_End]) -> Solution:
    """CONVERGED where the plugin reports success and the trajectory is feasible; TIME_LIMIT where it was ended."""
    status = solution.status
    ended = status.new_tensor([int(end) for end, _ in ends])
    iterations = status.new_tensor([count for _, count in ends])
    tells = (status == Status.FEASIBLE) & (ended == Status.CONVERGED)
    tells |= (ended == Status.TIME_LIMIT) & (status != Status.NON_FINITE)
    status = torch.where(tells, ended, status)
    return replace(solution, status=status, iterations=iterations)
