"""Problems that stay packed for the interior point in C from call to call: only their numbers are written again."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.lagrangian.lagrangian import later
from torchgco.native import structures as c
from torchgco.native.codegen.cost import cost_arrays
from torchgco.native.codegen.source import LANES
from torchgco.native.engine import run
from torchgco.native.interior import InteriorEngine
from torchgco.native.packing import constraint_of, quadratic_arrays, shared_fields
from torchgco.native.shared import Shared
from torchgco.problem.problem import Problem


class Kept:
    """The interior point's library with problems whose numbers lie where it reads them.

    Args:
        kernels: of the problems' form.
        problem: what is kept. Numbers that C reads as they are, such as the references of a quadratic cost and the
            centres of spheres, are those of the problem's own tensors: written there in place, they count at once.
        options: the fields of `structures.Interior` that don't change.
    """

    def __init__(self, kernels: InteriorEngine, problem: Problem, **options: Any) -> None:
        B, N, n, m, like = problem.B, problem.N, problem.n, problem.m, problem.x0
        self.engine, self.problem = kernels.engine, problem
        self._read: Shared | None = None  # what functions have captured, when C was last given it
        self.library, self.lanes = kernels.library, kernels.lanes
        self.X, self.U = like.new_zeros(B, N + 1, n), like.new_zeros(B, N, m)
        self.lam = tuple(like.new_zeros(B, *shape) for shape in problem.row_shapes)
        self.gains = like.new_zeros(B, N, m, n + 1)
        self.status, self.iterations = torch.zeros(B, dtype=torch.int32), torch.zeros(B, dtype=torch.int64)
        self.barrier = like.new_zeros(B)
        self._numbers = [self._own_numbers(i) for i in range(len(problem.constraints))]
        rows = [self._row(i, numbers) for i, numbers in enumerate(self._numbers)]
        self.packed = c.Problem(N=N, constraints=len(rows), constraint=rows, **shared_fields(self.engine.shared))
        self._model = self._model_array()
        self._cost = self._cost_arrays()
        self.packed.fill({"parameters": self._model, "cost_data": self._cost})
        self.packed.fill({"X": self.X, "U": self.U, "gains": self.gains})
        self.packed.fill({"status": self.status, "iterations": self.iterations})
        self.rolled = self.X.clone(), self.U.clone()  # trajectories of the controls with their feedback
        self.worst = like.new_zeros(B)
        # The same memory by NumPy, which takes a small share of PyTorch's time for a few numbers.
        self._moving = [part.numpy() for part in (self.X, self.U, *self.lam)]
        at_rows = [torch.arange(N + 1, device=like.device)[part.knots].tolist() for part in problem.constraints]
        self._knots: list[Sequence[int]] = [range(N + 1), range(N), *at_rows]
        self._later = dict[int, list[np.ndarray | None]]()
        self._rolled, self._x0 = [part.numpy() for part in self.rolled], problem.x0.numpy()
        self._flat = [part.reshape(B, -1) for part in self._rolled]
        self._gains = self.gains.numpy()
        self._feedback = self._gains[..., :-1]
        self.statuses, self.violations = self.status.numpy(), self.worst.numpy()
        self._barrier, self._iterations = self.barrier.numpy(), self.iterations.numpy()
        self._follow = self.packed.copy()
        self._follow.fill({"X": self.rolled[0], "U": self.rolled[1], "merit": self.worst})
        ends = {name: like.new_zeros(B) for name in ("error", "theta", "falls")}
        self.how = c.Interior.complete(of=self.packed, barrier=self.barrier, free_start=None, **ends, **options)

    def solve(self, rows: np.ndarray, mu: float, **options: float) -> None:
        """Solve the problems that `rows` (B,) marks, from X, U and `lam`, in place, with `mu` as the first barrier.

        `options` are fields of `structures.Interior`. `rolled` then holds the rollouts that follow the solution by its
        feedback, and `worst` (B,) their violation.
        """
        B, library = self.problem.B, self.engine.library
        until = time.monotonic() + options.get("seconds", math.inf)
        self.how.fill(options)
        self._barrier[:] = mu
        self.statuses[:] = 0
        self._iterations[:] = 0
        spans = _spans(rows)
        for first, last in spans:
            self._gains[first:last] = 0.0  # of problems that a deadline leaves no time for
        for first, last in spans:
            run(self.library.tgco_interior, last - first, self.lanes, self.how, first)
            self.how.fill({"seconds": max(0.0, until - time.monotonic())})
        if not math.isfinite(self._gains.sum()):
            np.nan_to_num(self._gains, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        self._rolled[0][:], self._rolled[1][:] = self._moving[:2]
        run(library.tgco_closed_loop, B, LANES, self._follow)
        if self.engine.measures:
            run(library.tgco_violation, B, LANES, self._follow)

    def begin_with(self, other: Kept) -> None:
        """Take over the iterates of another one of the same shapes."""
        for own, its in zip(self._moving, other._moving, strict=True):
            own[:] = its

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
        """Let all trajectories begin at the problem's starts."""
        self._moving[0][:, 0] = self._x0

    def shift(self, by: float) -> None:
        """Let all trajectories and multipliers begin `by` stages later, as `Solution.shifted` does.

        Part of a stage takes the straight line between what whole stages give: a guess, for the solve that follows.
        """
        whole = int(by)
        if whole:
            self._shift(whole)
        if (part := by - whole) > 0:
            now = [numbers.copy() for numbers in self._moving]
            self._shift(1)
            for numbers, before in zip(self._moving, now, strict=True):
                numbers *= part
                numbers += (1 - part) * before

    def _shift(self, by: int) -> None:
        if by not in self._later:
            self._later[by] = [_moved(knots, by) for knots in self._knots]
        for part, at in zip(self._moving, self._later[by], strict=True):
            if at is None:
                part[:, :-by], part[:, -by:] = part[:, by:], part[:, -1:]
            else:
                part[:] = part[:, at]

    @property
    def is_outdated(self) -> bool:
        """Whether tensors that functions capture may have other numbers than C."""
        captured = self.engine.captured
        return captured.is_mixed or not captured.is_still(self._read)

    def refresh_captured(self) -> bool:
        """Read what functions capture again; whether the library computes with it as it is now."""
        self._read = self.engine.captured.read()
        if self._read is None:
            return False
        self.engine.shared.take_over(self._read)
        # Some of these numbers may be a knot's own, and problems' own ones computed from what was captured.
        for i in self.engine.functions:
            self.refresh_constraint(i)
        self.refresh_cost()
        self.refresh_model()
        return True

    def refresh_constraint(self, i: int) -> None:
        """Read the numbers of constraint i again, after its tensors have changed."""
        new = self._own_numbers(i)
        arrays = [name for name, value in new.items() if isinstance(value, c.Array)]
        _copy([self._numbers[i][name] for name in arrays], [new[name] for name in arrays])

    def refresh_cost(self) -> None:
        """The same of the cost."""
        _copy(self._cost, self._cost_arrays())

    def refresh_model(self) -> None:
        """The same of the dynamics."""
        _copy([self._model], [self._model_array()])

    def _row(self, i: int, numbers: dict[str, Any]) -> c.Constraint:
        problem = self.problem
        row = constraint_of(problem.constraints[i], problem.row_shapes[i], numbers, problem)
        row.lam = self.lam[i]
        return row

    def _own_numbers(self, i: int) -> dict[str, Any]:
        return self.engine.row_numbers(self.problem, i)

    def _cost_arrays(self) -> list[c.Array]:
        cost, problem = self.engine.cost, self.problem
        return quadratic_arrays(problem.cost) if cost is None else cost_arrays(problem, cost, self.engine.shared.cost)

    def _model_array(self) -> c.Array:
        model, problem = self.engine.model, self.problem
        if model.count == 0:
            return c.Array()
        return c.array(model.numbers(problem.B, problem.dynamics, self.engine.shared.model), knots=True)


def _spans(rows: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last place, plus one, of each run of rows that are marked, (B,) bool."""
    if rows.all():
        return [(0, len(rows))]
    edges = np.diff(np.pad(rows.astype(np.int8), 1)).nonzero()[0].tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _moved(knots: Sequence[int], by: int) -> np.ndarray | None:
    """The places that numbers at these knots come from, `by` stages later; None: each from `by` places on."""
    at = np.array(later(knots, by), dtype=np.intp)
    last = len(at) - 1
    return None if by <= last and np.array_equal(at, np.minimum(np.arange(by, by + len(at)), last)) else at


def _copy(old: list[c.Array], new: list[c.Array]) -> None:
    """Write the numbers of arrays into the memory of others, which keep their places and shapes."""
    for before, after in zip(old, new, strict=True):
        for there, here in zip(before.kept, after.kept, strict=True):
            if there.data_ptr() != here.data_ptr():
                there.copy_(here)
