"""iLQR in C for a batch of problems: PyTorch's tensors in the form that the library reads."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.penalties import GuidePath, GuideRegion, Penalty
from torchgco.native.codegen.constraint import rows_numbers, trace_rows
from torchgco.native.codegen.cost import cost_numbers, trace_cost
from torchgco.native.codegen.dynamics import trace_dynamics
from torchgco.native.codegen.source import LANES, Form
from torchgco.native.compiler import build
from torchgco.native.packing import FLAGS, KINDS, NUMBERS, PATH, QUADRATIC, REGION, Packed, Rows, array, pack_rows
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.problem.problem import Problem

MOST = 128  # states and controls together: the matrices of a stage lie on the stack


@dataclass(frozen=True)
class Options:
    """The options of iLQR's loop (see ILQR and LineSearch)."""

    ladder: tuple[float, ...]
    back: int
    max_iterations: int
    accept_last: bool
    tolerance: float
    absolute_tolerance: float
    ratio_min: float
    ratio_max: float
    smallest: float
    first: float
    growth: float
    most: float
    damping: float
    rounding: float
    lost_beyond: float
    damp_below: float


@dataclass(frozen=True)
class Terms:
    """The terms that the Lagrangian adds to the cost (see Lagrangian)."""

    multipliers: Multipliers
    penalty: Penalty | None
    phr: bool


class Engine:
    """The library of a form of problems.

    Raises:
        InputError: not float64 on a CPU, too many states and controls, or a part without a counterpart in C.
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, problem: Problem) -> None:
        if problem.x0.dtype != torch.float64 or problem.x0.device.type != "cpu":
            raise InputError("x0", "float64 on a CPU for native kernels", f"{problem.x0.dtype} on {problem.x0.device}")
        if problem.n + problem.m > MOST:
            raise InputError("dynamics", f"at most {MOST} states and controls together", problem.n + problem.m)
        self.model = trace_dynamics(problem.dynamics)
        quadratic = problem.cost if type(problem.cost) is BoundQuadratic else None
        self.cost = trace_cost(problem) if quadratic is None else None
        traced = (i for i, constraint in enumerate(problem.constraints) if type(constraint) not in KINDS)
        sources = ((i, trace_rows(problem, i)) for i in traced)
        self.functions = {i: source for i, source in sources if source.size > 0}
        dense = quadratic is not None and not quadratic.diagonal
        boxes = any(type(constraint) is BoundBoxes for constraint in problem.constraints)
        self.form = Form(self.model, problem.dynamics.position, self.cost, dense, tuple(self.functions.items()), boxes)
        self.library = build(self.form.source())

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        """X (B, N+1, n) from U (B, N, m)."""
        X = U.new_empty(problem.B, problem.N + 1, problem.n)
        X[:, 0] = problem.x0
        self._run("tgco_open_loop", problem, self.packed(problem, {"X": X, "U": U.contiguous()}))
        return X

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        """X and U of a rollout of U + K (x - X) from the first knots of X; G = [K d] (B, N, m, n+1), d isn't used."""
        tensors = {"X": X.clone(), "U": U.clone(), "gains": G.contiguous()}
        self._run("tgco_closed_loop", problem, self.packed(problem, tensors))
        return tensors["X"], tensors["U"]

    def value(self, problem: Problem, X: Tensor, U: Tensor, terms: Terms) -> tuple[Tensor, Tensor]:
        """J_var (B,) and L_M (B,) of trajectories."""
        tensors = {"X": X.contiguous(), "U": U.contiguous(), "cost": X.new_empty(problem.B)}
        tensors["merit"] = torch.empty_like(tensors["cost"])
        self._run("tgco_value", problem, self.packed(problem, tensors, terms))
        return tensors["cost"], tensors["merit"]

    def gains(
        self, problem: Problem, X: Tensor, U: Tensor, terms: Terms, mu_r: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gains G = [K d] (B, N, m, n+1) for J_var + lam'c, the two sums of its expected change, (B,) each, and where
        the backward pass failed, (B,) bool; mu_r (B,) is the regularisation.
        """
        N, m, z = problem.N, problem.m, problem.n + 1
        tensors = {"X": X.contiguous(), "U": U.contiguous(), "regularisation": mu_r.contiguous()}
        tensors |= {name: torch.zeros_like(mu_r) for name in ("cost", "merit")}
        tensors |= {"gains": X.new_empty(problem.B, N, m, z), "status": _flags(problem.B)}
        packed = self.packed(problem, tensors, terms)
        packed.optimality = True
        self._run("tgco_gains", problem, packed)
        return tensors["gains"], tensors["cost"], tensors["merit"], tensors["status"] != 0

    def expand(self, problem: Problem, X: Tensor, U: Tensor, terms: Terms | None) -> tuple[Tensor, Tensor]:
        """Gradients (B, N+1, n+m) and Hessians (B, N+1, n+m, n+m) of L_M; of J_var where `terms` is None.

        Only the upper triangles of the Hessians are filled.
        """
        B, N, size = problem.B, problem.N, problem.n + problem.m
        tensors = {"X": X.contiguous(), "U": U.contiguous(), "slopes": X.new_empty(B, N + 1, size)}
        tensors |= {"curvatures": X.new_empty(B, N + 1, size, size)}
        tensors |= {name: X.new_zeros(B) for name in ("cost", "merit", "mu")}
        packed = self.packed(problem, tensors, terms)
        if terms is None:
            packed.constraints = 0
        self._run("tgco_expand", problem, packed)
        return tensors["slopes"], tensors["curvatures"]

    def lift(self, problem: Problem, state: dict[str, Tensor], terms: Terms, rounds: int, gain: float) -> Tensor:
        """Up to `rounds` steps in states and controls together, in place in `state`; where one gave a better rollout.

        Args:
            state: X, U, cost, merit, all contiguous.
            gain: share of L_M by which a rollout must lower it.
        """
        out = {"converged": _flags(problem.B), "regularisation": torch.zeros_like(state["merit"])}
        packed = self.packed(problem, {**state, **out}, terms)
        packed.limit, packed.gain = rounds, gain
        self._run("tgco_lift", problem, packed)
        return out["converged"] != 0

    def iterate(
        self, problem: Problem, state: dict[str, Tensor], terms: Terms, options: Options, limit: int
    ) -> dict[str, Tensor]:
        """Up to `limit` iterations of every problem's inner solve, in place in `state`.

        Args:
            state: X, U, cost, merit, regularisation; inner, iterations, rung (int64): all contiguous.

        Returns:
            status, converged, refused, lost (int32); alpha and used: step length and mu_r of the last iteration.
        """
        out = {name: _flags(problem.B) for name in FLAGS}
        out |= {name: torch.zeros(problem.B, dtype=torch.float64) for name in ("alpha", "used")}
        packed = self.packed(problem, {**state, **out}, terms)
        ladder = torch.tensor(options.ladder, dtype=torch.float64)
        packed.rungs, packed.ladder = len(options.ladder), ladder.data_ptr()
        packed.back, packed.limit, packed.max_iterations = options.back, limit, options.max_iterations
        packed.accept_last = options.accept_last
        for name in NUMBERS:
            setattr(packed, name, getattr(options, name))
        packed.replicas = LANES // 2 ** (problem.B - 1).bit_length() if problem.B <= LANES else 1
        self._run("tgco_ilqr", problem, packed)
        return out

    def _run(self, name: str, problem: Problem, packed: Packed) -> None:
        run(getattr(self.library, name), problem.B, LANES, packed)

    def packed(self, problem: Problem, tensors: dict[str, Tensor], terms: Terms | None = None) -> Packed:
        """The problem in the form that the library reads; it keeps the tensors alive that its pointers point to."""
        fixed = problem.__dict__.get("packed")
        if fixed is None:
            fixed = self._fixed(problem)
            object.__setattr__(problem, "packed", fixed)
        packed, keep = Packed.from_buffer_copy(fixed[0]), [fixed, tensors, terms]
        packed.keep = keep
        for name, tensor in tensors.items():
            setattr(packed, name, tensor.data_ptr())
        if terms is None:
            packed.constraint = ctypes.cast(fixed[1], ctypes.POINTER(Rows))
            return packed
        rows = (Rows * max(1, len(problem.constraints)))()
        ctypes.memmove(rows, fixed[1], ctypes.sizeof(rows))
        for row, lam in zip(rows, terms.multipliers.lam, strict=False):
            keep.append(lam := lam.contiguous())
            row.lam = lam.data_ptr()
        keep += [rows, mu := terms.multipliers.mu.contiguous()]
        packed.constraint, packed.mu = ctypes.cast(rows, ctypes.POINTER(Rows)), mu.data_ptr()
        packed.phr = terms.phr
        guide = terms.penalty
        if guide is not None:
            packed.guide = PATH if isinstance(guide, GuidePath) else REGION
            packed.center = array(guide.center, keep, knots=True)
            packed.weight = array(guide.weight.unsqueeze(-1), keep, knots=False)
            if isinstance(guide, GuideRegion):
                packed.radius = array(guide.radius.unsqueeze(-1), keep, knots=True)
        return packed

    def _fixed(self, problem: Problem) -> tuple[Packed, Any, list[Any]]:
        """The parts that don't change from call to call: model, cost and constraints, without multipliers."""
        packed, keep, cost = Packed(), [], problem.cost
        if problem.B == 0:
            return packed, (Rows * max(1, len(problem.constraints)))(), keep
        packed.N, packed.elements, packed.constraints = problem.N, problem.B, len(problem.constraints)
        if self.model.count > 0:
            own = self.model.parameters(torch.arange(problem.B), problem.dynamics)
            packed.parameters = array(own, keep, knots=False)
        if self.cost is None:
            for i, name in enumerate(QUADRATIC):
                packed.cost_data[i] = array(getattr(cost, name), keep, knots=name not in ("Qf", "xf_ref", "qf"))
        else:
            for i, numbers in enumerate(cost_numbers(problem, self.cost)):
                packed.cost_data[i] = array(numbers, keep, knots=True)
        rows = (Rows * max(1, len(problem.constraints)))()
        for i, constraint in enumerate(problem.constraints):
            source = self.functions.get(i)
            numbers = None if source is None else rows_numbers(problem, i, source)
            pack_rows(rows[i], constraint, numbers, problem, keep)
        return packed, rows, keep


def run(function: Any, count: int, group: int, argument: ctypes.Structure) -> None:
    """Call a function of a library on all problems, in whole groups, by as many threads as PyTorch uses.

    Raises:
        MemoryError: the library could not allocate memory.
    """
    if count == 0:
        return
    groups = -(-count // group)
    parts = min(torch.get_num_threads(), groups)
    if parts <= 1:
        done = [function(ctypes.byref(argument), ctypes.c_int64(0), ctypes.c_int64(count))]
    else:
        edges = [group * (groups * i // parts) for i in range(parts)] + [count]
        with ThreadPoolExecutor(parts) as pool:
            calls = [
                pool.submit(function, ctypes.byref(argument), ctypes.c_int64(a), ctypes.c_int64(b))
                for a, b in pairwise(edges)
            ]
            done = [call.result() for call in calls]
    if not all(done):
        raise MemoryError("native kernels: no memory")


def _flags(B: int) -> Tensor:
    return torch.zeros(B, dtype=torch.int32)
