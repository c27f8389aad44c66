"""The interior point in C for functions that C can't call: its loops ask Python for values and derivatives.

Each loop has some lanes, and a thread. Where all of them wait for an answer, the thread that called `solve` computes
what they ask together: so a user's code runs there, and what it raises ends the solve.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from math import prod
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.shapes import computing_on
from torchgco.base.tree import moved
from torchgco.eager.functions import Functions
from torchgco.lagrangian.barrier import BarrierOptions, fitted
from torchgco.lagrangian.kkt import KktSolve, RightSides
from torchgco.native import structures
from torchgco.native.codegen.source import CalledForm, lanes_for
from torchgco.native.compiler import build
from torchgco.native.engine import NO_MEMORY
from torchgco.native.interior import InteriorKernels
from torchgco.native.packing import constraint_of, kind_of, numbers_of, quadratic_arrays
from torchgco.native.structures import Array, Asked, Interior, Kind, Kkt, Quadratic, Request, TracedCost, array
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale

IN_C = Kind.BOUNDS, Kind.SPHERES, Kind.BOXES, Kind.FIELD  # rows that C computes: no function places them
CPU, DOUBLE = torch.device("cpu"), torch.float64
OVER = -1.0  # seconds of a solve that is to end
_ASK = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
Numbers = NDArray[np.float64]


class CalledInterior(InteriorKernels):
    """That whose functions Python computes, for problems of any device and dtype.

    Functions are evaluated there, all else on the CPU in float64. Options that rounding in the problem's dtype can't
    meet are raised to what it can (`fitted`). Where PyTorch differentiates a function once only, its curvature counts
    as 0. The result of a problem does not depend on the rest of the batch, bit by bit, as far as this holds for its own
    code: a shared matrix times a batch, as in a net, rounds differently in batches of other sizes.

    Raises:
        InputError: rows of a constraint that join knots.
        NativeError: no compiler.
    """

    def __init__(self, problem: Problem) -> None:
        shapes, n, m = list(enumerate(problem.row_shapes)), problem.n, problem.m
        kinds = [kind_of(part) for part in problem.constraints]
        self._called = [i for i, (K, p) in shapes if kinds[i] not in IN_C and K * p > 0]
        self._functions = Functions.of(problem, self._called)
        solids = any(kind in IN_C[1:] for kind in kinds)
        cost: Any = problem.cost if problem.cost.kernel == "quadratic" else None
        self._calls_cost = cost is None
        most = max((problem.row_shapes[i][1] for i in self._called), default=1)
        at, dense = problem.dynamics.position if solids else None, None if cost is None else not cost.diagonal
        self.lanes = lanes_for(problem.B)
        self.library = build(CalledForm(n, m, most, at, dense).units(self.lanes))

    def solve(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], barrier: Tensor,
        scale: CostScale, options: BarrierOptions,
    ) -> dict[str, Tensor]:  # fmt: skip
        """As `InteriorKernels.solve`."""
        user = X, U, barrier, *multipliers
        with computing_on(CPU):
            X_c, U_c, barrier_c, *lam = (part.to(CPU, DOUBLE).contiguous() for part in user)
            scale, options = CostScale(*(part.to(CPU, DOUBLE) for part in scale)), fitted(options, X.dtype)
            out = super().solve(problem, X_c, U_c, tuple(lam), barrier_c, scale, options)
        for part, found in zip(user, (X_c, U_c, barrier_c, *lam), strict=True):
            part.copy_(found)
        return {name: _like(X, part) for name, part in out.items()}

    def kkt(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor,
        right: RightSides, give: Tensor | None = None, K: Tensor | None = None,
    ) -> KktSolve:  # fmt: skip
        """As `InteriorKernels.kkt`."""
        with computing_on(CPU):
            put = lambda part: part.to(CPU, DOUBLE)
            sides = RightSides(*map(put, (right.a, right.b, right.c)))
            more = (None if part is None else put(part) for part in (give, K))
            found = super().kkt(problem, put(X), put(U), tuple(map(put, multipliers)), active.to(CPU), sides, *more)
        return replace(found, **{name: _like(X, part) for name, part in vars(found).items()})

    def _rows(self, problem: Problem) -> list[structures.Constraint]:
        return [self._row(problem, i) for i in range(len(problem.constraints))]

    def _row(self, problem: Problem, i: int) -> structures.Constraint:
        (K, p), S, part = problem.row_shapes[i], problem.n + problem.m, moved(problem.constraints[i], CPU)
        if kind_of(part) in IN_C:
            return constraint_of(part, (K, p), problem.N, kind_of(part), numbers_of(part, None, problem))
        own = {"bound": _numbers(K, p + p * S + S * S), "shared": torch.tensor([float(p)], dtype=DOUBLE)}
        return constraint_of(part, (K, p), problem.N, Kind.FUNCTION, own)

    def _with(self, problem: Problem, **values: Any) -> structures.Problem:
        n, S, N = problem.n, problem.n + problem.m, problem.N
        cost = [Array()] * len(Quadratic)
        if self._calls_cost:
            cost[TracedCost.STAGE], cost[TracedCost.LAST] = (_numbers(K, 1 + S + S * S) for K in (N, 1))
        else:
            cost = quadratic_arrays(moved(problem.cost, CPU))
        rows, parameters = values["constraint"], _numbers(N, n + n * S + S * S)
        return structures.Problem(N=N, constraints=len(rows), parameters=parameters, cost_data=cost, **values)

    def _run(self, function: Any, problem: Problem, how: Interior | Kkt) -> None:
        heard, B = SimpleQueue[_Loop](), problem.B
        spans = [(first, min(first + self.lanes, B)) for first in range(0, B, self.lanes)]
        with computing_on(problem.x0.device):
            answers = _Answers(self._functions, problem, self.lanes, self._calls_cost)
            _run_loops([_Loop(function, how, *span, heard) for span in spans], heard, answers)


def _like(X: Tensor, part: Tensor) -> Tensor:
    """A result on the device of X, numbers in its precision."""
    return part.to(X.device, X.dtype if part.is_floating_point() else part.dtype)


def _numbers(K: int, count: int) -> Array:
    """Room in each lane for the numbers of a function at K knots."""
    return array(torch.zeros(1, K, count, dtype=DOUBLE), knots=True)


# The loops ------------------------------------------------------------------------------------------------------------


class _Loop:
    """A function of the library on some problems, in a thread of its own, which waits where it asks for an answer.

    Attributes:
        request: the last one.
        over: it has ended.
        done: it has had the memory that it needs.
        before: what the last derivatives were computed from, for `_Answers`.
    """

    def __init__(self, function: Any, how: Interior | Kkt, first: int, last: int, heard: SimpleQueue[_Loop]) -> None:
        self.request, self.over, self.done = Request(), False, False
        self.before: Numbers | None = None
        self._heard, self._answered, self._stopped = heard, SimpleQueue[None](), False
        self._ask, self._how = _ASK(self._asked), how.fill({}, copied=True)
        self._how.ask = ctypes.cast(self._ask, ctypes.c_void_p).value
        self._call = lambda: function(ctypes.byref(self._how), ctypes.c_int64(first), ctypes.c_int64(last))
        self.thread = Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        self.done = bool(self._call())
        self.over = True
        self._heard.put(self)

    def _asked(self, address: int) -> None:
        self.request = Request.from_address(address)
        if not self._stopped:
            self._heard.put(self)
            self._answered.get()

    def go_on(self) -> None:
        """The request is answered."""
        self._answered.put(None)

    def stop(self) -> None:
        """Nothing more will be answered: end after this iteration."""
        self._stopped = True
        if isinstance(self._how, Interior):
            self._how.seconds = OVER
        self.go_on()


def _run_loops(loops: Sequence[_Loop], heard: SimpleQueue[_Loop], answer: Callable[[list[_Loop]], None]) -> None:
    """Run loops to their end; `answer` is called on all that haven't ended, whenever each of them waits.

    What it raises, and Ctrl-C, ends them, and is raised.
    """
    running, waiting = len(loops), list[_Loop]()
    try:
        for loop in loops:
            loop.thread.start()
        while running:
            loop = heard.get()
            running -= loop.over
            waiting += [] if loop.over else [loop]
            if len(waiting) == running > 0:
                answer(waiting)
                for loop in waiting:
                    loop.go_on()
                waiting.clear()
    except BaseException:
        started = [loop for loop in loops if loop.thread.ident is not None]
        for loop in started:
            loop.stop()
        for loop in started:
            loop.thread.join()
        raise
    if not all(loop.done for loop in loops):
        raise MemoryError(NO_MEMORY)


# The answers ----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4096)
def _view(address: Any, *shape: int) -> Numbers:
    """Numbers in the memory of a loop."""
    return np.ctypeslib.as_array((ctypes.c_double * prod(shape)).from_address(address)).reshape(shape)


@dataclass(frozen=True)
class _Asking:
    """A loop, and some of its lanes, in which problems of these numbers are."""

    loop: _Loop
    lanes: list[int]

    @property
    def problems(self) -> list[int]:
        return [ctypes.c_int64.from_address(self.loop.request.element + 8 * lane).value for lane in self.lanes]


class _Answers:
    """What functions give for the problems of a solve, where loops ask for it."""

    def __init__(self, functions: Functions, problem: Problem, lanes: int, calls_cost: bool) -> None:
        n, S, shapes = problem.n, problem.n + problem.m, problem.row_shapes
        self._problem, self._called, self._calls_cost, self._lanes = problem, functions.rows, calls_cost, lanes
        self._first = list(accumulate((K * p for K, p in shapes), initial=0))  # rows of each constraint
        self._counts: dict[str | int, int] = {i: p + p * S + S * S for i, (_, p) in enumerate(shapes)}
        self._counts |= {"step": n + n * S + S * S, "stage": 1 + S + S * S, "last": 1 + S + S * S, "Xn": n}
        self._shapes = {
            "X": (problem.N + 1, n), "U": (problem.N, problem.m), "y": (problem.N + 1, n), "z": (self._first[-1],),
            "objective": (1,),
        }  # fmt: skip
        self._shapes |= {"Xn": self._shapes["X"], "Un": self._shapes["U"]}
        index = lambda numbers: torch.tensor(numbers, dtype=torch.int64, device=problem.x0.device)
        self._among = lru_cache(maxsize=8)(lambda numbers: functions.among(problem.take(index(numbers))))

    def __call__(self, loops: Sequence[_Loop]) -> None:
        for asked, way in zip(Asked, (self._values, self._derivatives, self._nearby), strict=True):
            some = [_Asking(loop, _bits(loop.request.lanes)) for loop in loops if loop.request.asked == asked]
            if asked is Asked.DERIVATIVES:
                some = [_Asking(one.loop, self._changed(one)) for one in some]
            some = [one for one in some if one.lanes]
            if some:
                of = self._among(tuple(number for one in some for number in one.problems))
                way(some, of, self._read(some, "X"), self._read(some, "U"))

    def _values(self, asked: list[_Asking], of: Functions, X: Tensor, U: Tensor) -> None:
        self._write(asked, "step", 0, of.step(X, U))
        for i in self._called:
            self._write(asked, i, 0, of.row(i, X, U))
        if self._calls_cost:
            self._write(asked, "stage", 0, of.cost(X, U).view(-1, 1, 1))  # all of it; that of other knots stays 0

    def _derivatives(self, asked: list[_Asking], of: Functions, X: Tensor, U: Tensor) -> None:
        weight = self._read(asked, "objective")
        y, z = weight.unsqueeze(-1) * self._read(asked, "y"), weight * self._read(asked, "z")
        self._write(asked, "step", X.shape[-1], *of.expand_step(X, U, y[:, 1:]))
        for i in self._called:
            p = self._problem.row_shapes[i][1]
            lam = z[:, self._first[i] : self._first[i + 1]].unflatten(-1, (-1, p))
            self._write(asked, i, p, *of.expand_row(i, X, U, lam))
        if self._calls_cost:
            g, H = of.expand_cost(X, U)
            self._write(asked, "stage", 1, g[:, :-1], H[:, :-1])
            self._write(asked, "last", 1, g[:, -1:], H[:, -1:])

    def _nearby(self, asked: list[_Asking], of: Functions, X: Tensor, U: Tensor) -> None:
        start, controls = self._read(asked, "Xn")[:, 0], self._read(asked, "Un")
        self._write(asked, "Xn", 0, of.nearby(X, U, start, controls))

    def _changed(self, one: _Asking) -> list[int]:
        """The lanes in which a problem, its iterate or its multipliers are others than at the last derivatives."""
        parts = [self._view(one, name) for name in ("X", "U", "y", "z", "objective")]
        numbers = np.full((1, self._lanes), np.nan)
        numbers[0, one.lanes] = one.problems
        found = np.concatenate([*(part.reshape(-1, self._lanes) for part in parts), numbers])
        before = np.full_like(found, np.nan) if one.loop.before is None else one.loop.before
        others = (found != before).any(0)
        lanes = [lane for lane in one.lanes if others[lane]]
        before[:, lanes] = found[:, lanes]
        one.loop.before = before
        return lanes

    def _view(self, one: _Asking, field: str) -> Numbers:
        """An array of a request, (..., lanes)."""
        return _view(getattr(one.loop.request, field), *self._shapes[field], self._lanes)

    def _read(self, asked: list[_Asking], field: str) -> Tensor:
        """An array of the requests, (b, ...), for the problem's functions."""
        whole = np.concatenate([self._view(one, field)[..., one.lanes] for one in asked], axis=-1)
        like = self._problem.x0
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(whole, -1, 0))).to(like.device, like.dtype)

    def _write(self, asked: list[_Asking], where: str | int, first: int, *values: Tensor) -> None:
        """Write numbers (b, K, ...) of K knots, from the one of number `first` on, to where requests say."""
        joined = torch.cat([part.flatten(2) for part in values], dim=-1).detach().to(CPU, DOUBLE)
        whole, at = np.moveaxis(joined.numpy(), 0, -1), 0
        K, count, _ = whole.shape
        for one in asked:
            request, end = one.loop.request, at + len(one.lanes)
            if isinstance(where, int):
                address = ctypes.c_void_p.from_address(request.rows + ctypes.sizeof(ctypes.c_void_p) * where).value
            else:
                address = getattr(request, where)
            room = _view(address, K, self._counts[where], self._lanes)
            room[:, first : first + count, one.lanes] = whole[..., at:end]
            at = end


def _bits(lanes: int) -> list[int]:
    """The places of the bits that are set."""
    return [place for place in range(lanes.bit_length()) if lanes >> place & 1]
