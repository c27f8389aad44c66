"""The interior point in C: its library for a form of problems, and the options that it reads."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.kkt import CLOSING_ROUNDS, LEAST_PIVOT, SLIGHT, STIFF, KktSolve, RightSides
from torchgco.native import structures
from torchgco.native.codegen.source import INTERIOR, lanes_for
from torchgco.native.compiler import begin
from torchgco.native.cuda import source as cuda
from torchgco.native.engine import Engine, run
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
        B, n = problem.B, problem.n
        multipliers = tuple(lam.contiguous() for lam in multipliers)
        packed, out = self._packed(problem, X.contiguous(), U.contiguous(), multipliers)
        sides = {"a": right.a, "b": right.b, "c": right.c}
        sides = {name: part.clone(memory_format=torch.contiguous_format) for name, part in sides.items()}
        costates, left = X.new_zeros(B, problem.N + 1, n), X.new_zeros(right.a.shape[0], B)
        how = Kkt.complete(
            of=packed, active=active.double().contiguous(), give=give, K=None if K is None else K.contiguous(),
            y=costates, left=left, **sides, problems=B, free_start=free_components(problem), count=right.a.shape[0],
            rounds=CLOSING_ROUNDS, stiff=STIFF, slight=SLIGHT, pivot=LEAST_PIVOT, ask=None,
        )  # fmt: skip
        self._run(self.library.tgco_kkt, problem, how)
        return KktSolve(sides["a"], sides["b"], sides["c"], left, costates, out["status"] == Status.CONVERGED)

    def _packed(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...]
    ) -> tuple[structures.Problem, dict[str, Tensor]]:
        """The problem with these iterates, and the tensors that status, iterations and gains are written to."""
        out = {"status": torch.zeros(problem.B, dtype=torch.int32)}
        out["iterations"] = torch.zeros(problem.B, dtype=torch.int64)
        out["gains"] = X.new_zeros(problem.B, problem.N, problem.m, problem.n + 1)
        rows = [row.copy({"lam": lam}) for row, lam in zip(self._rows(problem), multipliers, strict=True)]
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
    return _of_options(options).copy(own | scales | ends), ends


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
