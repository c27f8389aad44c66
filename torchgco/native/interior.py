"""The interior point in C: its library for a form of problems, its options, and problems that stay packed."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.kkt import CLOSING_ROUNDS, LEAST_PIVOT, SLIGHT, STIFF, KktSolve, RightSides
from torchgco.lagrangian.lagrangian import later
from torchgco.native import structures
from torchgco.native.codegen.source import INTERIOR, lanes_for
from torchgco.native.compiler import begin
from torchgco.native.cuda import source as cuda
from torchgco.native.engine import Engine, run
from torchgco.native.kept_problem import KeptProblem
from torchgco.native.structures import Interior, Kkt
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale


class InteriorKernels:
    """The interior point for the problems of a form.

    Attributes:
        library: that it is compiled to, with so many `lanes`.
    """

    library: ctypes.CDLL
    lanes: int

    def solve(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], barrier: Tensor,
        scale: CostScale, options: BarrierOptions,
    ) -> dict[str, Tensor]:  # fmt: skip
        """States, controls, multipliers and barrier parameters in place; X begins with the problem's start, or
        a guess of what is free in it.

        Args:
            X, U: (B, N+1, n), (B, N, m), contiguous.
            multipliers: of every constraint, (B, K, p), contiguous.
            barrier: mu (B,).
            scale: of the costs.

        Returns:
            status, iterations (B,); error of the end test, theta, the sum of residuals, and whether the cost falls to
            second order, 0 or 1, (B,); gains (B, N, m, n+1).
        """
        packed, out = self._packed(problem, X, U, multipliers)
        how, ends = interior(problem, packed, barrier, scale, options)
        self._run(self.library.tgco_interior, problem, how)
        return out | ends

    def kkt(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor,
        right: RightSides, give: Tensor | None = None, K: Tensor | None = None,
    ) -> KktSolve:  # fmt: skip
        """Solutions of linear systems with the matrix of the KKT conditions.

        Args:
            X, U: (B, N+1, n), (B, N, m), contiguous.
            multipliers: of every constraint, (B, K, p); those of rows that aren't active count as 0.
            active: which rows hold, (B, R) bool; all of equalities do.
            right: the right hand sides.
            give: D (B, R) of the rows that hold; None: 0.
            K: gains (B, N, m, n), with which unstable dynamics don't magnify the rounding of costates; None: 0.
        """
        sides = {"a": right.a, "b": right.b, "c": right.c}
        sides = {name: part.clone(memory_format=torch.contiguous_format) for name, part in sides.items()}
        left = X.new_zeros(right.a.shape[0], problem.B)
        asked: dict[str, Any] = {"left": left, "count": len(left), "responses": None, "first": 0, "d": 0}
        costates, definite = self._factored(problem, X, U, multipliers, active, give, K, asked | sides)
        return KktSolve(sides["a"], sides["b"], sides["c"], left, costates, definite)

    def responses(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor, give: Tensor,
        K: Tensor, states: slice,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Responses of some states at knots 1..N to forces there, (B, N d, N d), and whether minima are strict, (B,).

        As of `kkt`, but rows that hold give way by a share of about 1 / `STIFF`; float64 on the CPU.
        """
        d = states.stop - states.start
        found, none = X.new_zeros(problem.B, problem.N * d, problem.N * d), X.new_zeros(0)
        asked: dict[str, Any] = {"responses": found, "first": states.start, "d": d, "count": 0}
        asked |= dict.fromkeys(("a", "b", "c", "left"), none)
        _, definite = self._factored(problem, X, U, multipliers, active, give.contiguous(), K, asked)
        return found, definite

    def _factored(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor,
        give: Tensor | None, K: Tensor | None, asked: dict[str, Any],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Costates, and where the factors exist, of what is asked of the systems."""
        multipliers = tuple(lam.contiguous() for lam in multipliers)
        packed, out = self._packed(problem, X.contiguous(), U.contiguous(), multipliers)
        costates = X.new_zeros(problem.B, problem.N + 1, problem.n)
        how = Kkt.complete(
            of=packed, active=active.double().contiguous(), give=give, K=None if K is None else K.contiguous(),
            y=costates, problems=problem.B, free_start=free_components(problem), rounds=CLOSING_ROUNDS, stiff=STIFF,
            slight=SLIGHT, pivot=LEAST_PIVOT, ask=None, **asked,
        )  # fmt: skip
        self._run(self.library.tgco_kkt, problem, how)
        return costates, out["status"] == Status.CONVERGED

    def _packed(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...]
    ) -> tuple[structures.Problem, dict[str, Tensor]]:
        """The problem with these iterates, and the tensors that status, iterations and gains are written to."""
        out = {"status": torch.zeros(problem.B, dtype=torch.int32)}
        out["iterations"] = torch.zeros(problem.B, dtype=torch.int64)
        out["gains"] = X.new_zeros(problem.B, problem.N, problem.m, problem.n + 1)
        rows = [row.fill({"lam": lam}, copied=True) for row, lam in zip(self._rows(problem), multipliers, strict=True)]
        return self._with(problem, X=X, U=U, constraint=rows, **out), out

    def _rows(self, problem: Problem) -> list[structures.Constraint]:
        """Constraints without multipliers."""
        raise NotImplementedError

    def _with(self, problem: Problem, **values: Any) -> structures.Problem:
        """A problem with further fields."""
        raise NotImplementedError

    def _run(self, function: Any, problem: Problem, how: Interior | Kkt) -> None:
        """Call a function of the library on all problems."""
        raise NotImplementedError


class InteriorEngine(InteriorKernels):
    """That whose functions are compiled, for as many problems as `engine` serves; compiled when it is made.

    Raises:
        InputError: a part without a counterpart in C.
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine, self.lanes = engine, lanes_for(engine.B)
        units = partial(engine.form.units, INTERIOR, lanes=self.lanes)
        self.library = engine.further(("interior", self.lanes), units, cuda.INTERIOR)

    def _rows(self, problem: Problem) -> list[structures.Constraint]:
        return self.engine.rows(problem)

    def _with(self, problem: Problem, **values: Any) -> structures.Problem:
        return self.engine.packed(problem, **values)

    def _run(self, function: Any, problem: Problem, how: Interior | Kkt) -> None:
        run(function, problem.B, self.lanes, how)


def interior(
    problem: Problem, packed: structures.Problem, barrier: Tensor, scale: CostScale, options: BarrierOptions
) -> tuple[Interior, dict[str, Tensor]]:
    """What C reads of a solve, and the tensors (B,) that it writes error, theta and falls to."""
    ends = {name: barrier.new_zeros(problem.B) for name in ("error", "theta", "falls")}
    own = {"of": packed, "barrier": barrier, "free_start": free_components(problem)}
    scales = {"constant": scale.constant, "least_cost": scale.size}
    return _of_options(options).fill(own | scales | ends, copied=True), ends


@lru_cache(maxsize=64)
def _of_options(options: BarrierOptions) -> Interior:
    """What C reads of options, which are many and seldom others."""
    lost = dict.fromkeys(("of", "barrier", "free_start", "constant", "least_cost", "error", "theta", "falls", "ask"))
    return Interior.complete(**lost, **vars(options))


def free_components(problem: Problem) -> Tensor | None:
    """1 where a component of the start is free, else 0, (B, n); None where none is."""
    return None if problem.free_start is None else problem.free_start.to("cpu", torch.float64).contiguous()


def begin_interior(engine: Engine) -> None:
    """Start to compile both libraries of a form of which the first one is about to be loaded."""
    with suppress(InputError):
        begin(engine.form.units(lanes=engine.lanes), engine.form.units(INTERIOR, lanes=lanes_for(engine.B)))


class Kept(KeptProblem):
    """Kept problems for the interior point.

    Args:
        kernels: of the problems' form.
        problem: see `KeptProblem`.
        scale: of the costs.
        options: with which problems are solved.
    """

    def __init__(self, kernels: InteriorEngine, problem: Problem, scale: CostScale, options: BarrierOptions) -> None:
        super().__init__(kernels.engine, problem)
        B, N, n, m, like = problem.B, problem.N, problem.n, problem.m, problem.x0
        self.library, self.lanes = kernels.library, kernels.lanes
        self.gains = like.new_zeros(B, N, m, n + 1)
        self.status, self.iterations = torch.zeros(B, dtype=torch.int32), torch.zeros(B, dtype=torch.int64)
        self.barrier = like.new_zeros(B)
        self.packed.fill({"gains": self.gains, "status": self.status, "iterations": self.iterations})
        self.rolled = self.X.clone(), self.U.clone()  # trajectories of the controls with their feedback
        self.worst = like.new_zeros(B)
        # The same memory by NumPy, which takes a small share of PyTorch's time for a few numbers.
        self._moving = [part.numpy() for part in (self.X, self.U, *self.lam)]
        at_rows = [torch.arange(N + 1, device=like.device)[part.knots].tolist() for part in problem.constraints]
        self._knots: list[Sequence[int]] = [range(N + 1), range(N), *at_rows]
        self._later = dict[int, list[np.ndarray | None]]()
        self._rolled, self._x0 = [part.numpy() for part in self.rolled], problem.x0.numpy()
        self._flat = [part.reshape(B, -1) for part in self._rolled]
        free = problem.free_start
        self._held = True if free is None else (~free).numpy()  # which components of the starts are given
        self._gains = self.gains.numpy()
        self._feedback = self._gains[..., :-1]
        self.statuses, self.violations = self.status.numpy(), self.worst.numpy()
        self._barrier, self._iterations = self.barrier.numpy(), self.iterations.numpy()
        rolled = {"X": self.rolled[0], "U": self.rolled[1], "merit": self.worst}
        self._follow = self.packed.fill(rolled, copied=True)
        self.how, _ = interior(problem, self.packed, self.barrier, scale, options)

    def solve(self, rows: np.ndarray, mu: float, seconds: float) -> None:
        """Solve the problems that `rows` (B,) marks, from X, U and `lam`, in place, with `mu` as the first barrier.

        They take `seconds` at most. `rolled` then holds the rollouts that follow the solution by its
        feedback, and `worst` (B,) their violation.
        """
        B, library = self.problem.B, self.engine.library
        until = time.monotonic() + seconds
        self.how.seconds = seconds
        self._barrier[:] = mu
        self.statuses[:] = 0
        self._iterations[:] = 0
        spans = _spans(rows)
        for first, last in spans:
            self._gains[first:last] = 0.0  # of problems that a deadline leaves no time for
        for first, last in spans:
            run(self.library.tgco_interior, last - first, self.lanes, self.how, first)
            self.how.seconds = max(0.0, until - time.monotonic())
        if not math.isfinite(self._gains.sum()):
            np.nan_to_num(self._gains, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        self._rolled[0][:], self._rolled[1][:] = self._moving[:2]
        run(library.tgco_closed_loop, B, self.lanes, self._follow)
        if self.engine.measures:
            run(library.tgco_violation, B, self.lanes, self._follow)

    def begin_with(self, other: Kept) -> None:
        """Take over the iterates of another one of the same shapes."""
        for target, its in zip(self._moving, other._moving, strict=True):
            target[:] = its

    def take_over(self, rows: Tensor, solution: Any) -> None:
        """Put the states, controls and multipliers of solutions in the places `rows` (b,)."""
        self.X[rows], self.U[rows] = solution.X, solution.U
        for lam, new in zip(self.lam, solution.multipliers.lam, strict=True):
            lam[rows] = new

    def begin_at(self, rows: Tensor, X: Tensor, U: Tensor) -> None:
        """Put trajectories in the places `rows` (b,), without multipliers."""
        self.X[rows], self.U[rows] = X, U
        for lam in self.lam:
            lam[rows] = 0.0

    @property
    def times(self) -> Tensor | None:
        """Of the knots, (B, N+1), s, where they are free; else None."""
        return None

    @property
    def multipliers(self) -> tuple[Tensor, ...]:
        """Copies of `lam`."""
        return tuple(lam.clone() for lam in self.lam)

    @property
    def finite(self) -> np.ndarray:
        """Whether all states and controls of `rolled` are, (B,)."""
        X, U = self._flat
        return np.asarray(np.isfinite(X).all(axis=1) & np.isfinite(U).all(axis=1))

    def copies(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """X (B, N+1, n) and U (B, N, m) as rolled out, gains K (B, N, m, n), status (B,) and iterations (B,)."""
        X, U = self._rolled
        parts = X.copy(), U.copy(), self._feedback.copy(), self.statuses.astype(np.int64), self._iterations.copy()
        x, u, K, status, iterations = map(torch.from_numpy, parts)
        return x, u, K, status, iterations

    def start(self) -> None:
        """Let all trajectories begin at the problem's starts; what is free of these stays as it is."""
        np.copyto(self._moving[0][:, 0], self._x0, where=self._held)

    def shift(self, by: float) -> None:
        """Let all trajectories and multipliers begin `by` stages later, as `Solution.shifted` does.

        Part of a stage takes the straight line between what whole stages give: a guess, for the solve that follows.
        """
        whole = int(by)
        if whole:
            self._shift(whole)
        if (share := by - whole) > 0:
            now = [numbers.copy() for numbers in self._moving]
            self._shift(1)
            for numbers, before in zip(self._moving, now, strict=True):
                numbers *= share
                numbers += (1 - share) * before

    def _shift(self, by: int) -> None:
        if by not in self._later:
            self._later[by] = [_moved(knots, by) for knots in self._knots]
        for numbers, places in zip(self._moving, self._later[by], strict=True):
            if places is None:
                numbers[:, :-by], numbers[:, -by:] = numbers[:, by:], numbers[:, -1:]
            else:
                numbers[:] = numbers[:, places]


def _spans(rows: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last place, plus one, of each run of rows that are marked, (B,) bool."""
    if rows.all():
        return [(0, len(rows))]
    edges = np.diff(np.pad(rows.astype(np.int8), 1)).nonzero()[0].tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _moved(knots: Sequence[int], by: int) -> np.ndarray | None:
    """The places that numbers at these knots come from, `by` stages later; None: each from `by` places on."""
    places = np.array(later(knots, by), dtype=np.intp)
    last = len(places) - 1
    return None if by <= last and np.array_equal(places, np.minimum(np.arange(by, by + len(places)), last)) else places
