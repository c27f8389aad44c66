"""iLQR and MPPI in C for a batch of problems: PyTorch's tensors in the form that the library reads."""

from __future__ import annotations

import ctypes
import functools
import os
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from copy import copy
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchgco.base.clock import setting_up
from torchgco.base.draws import words
from torchgco.base.errors import InputError
from torchgco.base.shapes import repeated
from torchgco.constraints.base import Constraint, WrappedConstraint
from torchgco.constraints.norms import NormBounds
from torchgco.eager.sampling import Sampling
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.native import structures as c
from torchgco.native.codegen.constraint import rows_numbers, trace_rows
from torchgco.native.codegen.cost import cost_arrays, trace_cost
from torchgco.native.codegen.source import LANES, SAMPLER, Form, lanes_for
from torchgco.native.codegen.stages import trace_model
from torchgco.native.compiler import Unit, build
from torchgco.native.cuda import source as cuda
from torchgco.native.cuda.engine import Kernel, Library, current_device
from torchgco.native.cuda.source import SOLVER
from torchgco.native.packing import (
    Captured,
    Shared,
    constraint_of,
    guide_of,
    is_bounded,
    is_lifted,
    kind_of,
    numbers_of,
    quadratic_arrays,
    shared_fields,
)
from torchgco.native.structures import Kind, array
from torchgco.obstacles.spheres import SpheresInFreeTime
from torchgco.problem.problem import Problem

NO_MEMORY = "native kernels: no memory"
LANES_OF_ONE = 4  # that a problem alone makes use of: for steps of a line search, and candidates along several paths
# What of a problem is packed, and kept with it: all but multipliers and guide, the same without the cost, the model.
WHOLE, OF_ROWS, OF_MODEL, ROWS = "packed", "packed without cost", "packed model", "packed rows"
MAX_VARIABLES = 128  # states and controls together: the matrices of a stage lie on the stack


class Engine:
    """The library of a form of problems.

    Args:
        ahead: see `serve`.
        compiles: without it there is the form alone.

    Raises:
        InputError: not float64 on a CPU, too many states and controls, or a part without a counterpart in C.
        NativeError: no compiler, or it refuses the source.
    """

    @setting_up()
    def __init__(self, problem: Problem, ahead: Callable[[Engine], None] | None = None, compiles: bool = True) -> None:
        if problem.x0.dtype != torch.float64 or problem.x0.device.type != "cpu":
            raise InputError("x0", "float64 on a CPU for native kernels", f"{problem.x0.dtype} on {problem.x0.device}")
        if problem.n + problem.m > MAX_VARIABLES:
            raise InputError("dynamics", f"at most {MAX_VARIABLES} states and controls together", problem.n + problem.m)
        self.model = trace_model(problem)
        quadratic: Any = problem.cost if problem.cost.kernel == "quadratic" else None
        self.cost = trace_cost(problem) if quadratic is None else None
        parts = problem.constraints
        traced = (i for i, part in enumerate(parts) if is_lifted(part) or kind_of(part) is Kind.FUNCTION)
        sources = ((i, trace_rows(problem, i)) for i in traced)
        self.functions = {i: source for i, source in sources if source.size > 0}
        dense = quadratic is not None and not quadratic.diagonal
        self.measures = all(kind_of(part) is not Kind.FUNCTION or _measured(part) for part in parts)
        position, functions = problem.dynamics.position, tuple(self.functions.items())
        self.captured = Captured(self.model, self.cost, self.functions)
        first = self.captured.read()
        if first is None:  # changed since the functions were traced, by another thread
            raise InputError("problem", "functions whose tensors don't change while it is solved", "others")
        self.shared = first
        lifted = frozenset(i for i in self.functions if is_lifted(parts[i]))
        self.form = Form(self.model, position, self.cost, dense, functions, lifted)
        self._libraries: dict[Hashable, Any] = {}
        if compiles:
            self.serve(problem.B, ahead)

    def serve(self, B: int, ahead: Callable[[Engine], None] | None = None) -> None:
        """Have the library that suits solves of B problems, all in all; `ahead` is called before it is compiled."""
        self.B, self.lanes = B, lanes_for(B, LANES_OF_ONE)
        if ahead is not None and (None, self.lanes) not in self._libraries:
            ahead(self)
        self.library = self.further(self.lanes, lambda: self.form.units(lanes=self.lanes), SOLVER)

    def further(self, name: Hashable, units: Callable[[], Sequence[Unit]], *of_device: Any) -> Any:
        """A further library of this form, which this engine and those with other shared numbers keep.

        Args:
            of_device: a `Program`, and the type of its numbers, for a library of a device.
        """
        device = current_device()
        key = device, name
        if key not in self._libraries:
            with setting_up():
                host = self._libraries.get((None, name)) or build(units())
                self._libraries[None, name] = host
                self._libraries[key] = host if device is None else Library(device, self.form, host, *of_device)
        return self._libraries[key]

    def forget_values(self) -> None:
        """Let go of the numbers of the problem that the functions were traced with: all are solved with their own."""
        for traced in self.captured.traces:
            traced.forget_values()

    def with_shared(self, shared: Shared) -> Engine:
        """The same functions with other shared numbers, such as `captured.read` gives."""
        other = copy(self)
        other.shared = shared
        return other

    def computes_as(self, other: Engine, problem: Problem) -> bool:
        """Whether another engine computes the same for `problem`."""
        if self.form.units() != other.form.units() or not self.shared.is_same(other.shared):
            return False
        return all(map(torch.equal, self._numbers(problem), other._numbers(problem)))

    def _numbers(self, problem: Problem) -> list[Tensor]:
        """What the functions read of problems."""
        numbers = [self.model.numbers(problem.B, problem.dynamics, self.shared.model)]
        if self.cost is not None:
            numbers += (tensor for array in cost_arrays(problem, self.cost, self.shared.cost) for tensor in array.kept)
        functions = self.functions.items()
        return numbers + [rows_numbers(problem, i, rows, self.shared.rows[i]) for i, rows in functions]

    def replicas_of(self, B: int) -> int:
        """How many lanes share the line search of each of B problems."""
        return self.lanes // 2 ** (B - 1).bit_length() if self.lanes >= B else 1

    def packed(self, problem: Problem, what: str = WHOLE, **values: Any) -> c.Problem:
        """A problem without multipliers or a guide, and further fields, in the form that the library reads.

        Args:
            what: measures read the constraints without the cost, and rollouts the model alone: many problems are
                rolled out and not solved.
        """
        if problem.part_of is not None:
            problem, values["numbers"] = problem.part_of
        return (problem.derived.get(what) or self._kept(problem, what)).fill(values, copied=True)

    def terms(self, lagrangian: Lagrangian, best: Multipliers | None = None, **values: Any) -> c.Problem:
        """The same with the terms that the Lagrangian adds to the cost; `best` are those of an outer loop's best."""
        if best is not None:
            return self._summed(lagrangian, best).fill(values)
        if "packed" not in lagrangian.derived:  # several calls of an inner solve read the same terms
            lagrangian.derived["packed"] = self._summed(lagrangian)
        return lagrangian.derived["packed"].fill(values, copied=True)

    def _summed(self, lagrangian: Lagrangian, best: Multipliers | None = None) -> c.Problem:
        """The problem with multipliers, penalties and guide."""
        multipliers, penalty = lagrangian.multipliers, lagrangian.penalty
        fields: dict[str, Any] = {"mu": multipliers.mu.contiguous(), "phr": lagrangian.phr}
        if best is not None or not multipliers.blank:
            none = [None] * len(multipliers.lam)
            own = none if multipliers.blank else [lam.contiguous() for lam in multipliers.lam]
            pairs = zip(self.rows(lagrangian.problem), own, none if best is None else best.lam, strict=True)
            fields["constraint"] = [row.fill({"lam": lam, "best": kept}, copied=True) for row, lam, kept in pairs]
        return self.packed(lagrangian.problem, **fields, **({} if penalty is None else guide_of(penalty)))

    def rows(self, problem: Problem) -> list[c.Constraint]:
        """Constraints without multipliers."""
        if problem.part_of is not None:
            problem, _ = problem.part_of
        if ROWS not in problem.derived:
            places = range(len(problem.constraints))
            problem.derived[ROWS] = [self._row(problem, i) if problem.B > 0 else c.Constraint() for i in places]
        return problem.derived[ROWS]

    def _kept(self, problem: Problem, what: str) -> c.Problem:
        """The parts that don't change from call to call; kept with the problem."""
        if what == OF_MODEL:
            pack = lambda: c.Problem(N=problem.N, parameters=self.model_numbers(problem), **shared_fields(self.shared))
            made = _of_last(problem, "dynamics", problem.dynamics, True, pack)
        elif what == OF_ROWS:
            rows = self.rows(problem)
            made = self.packed(problem, OF_MODEL, constraints=len(rows), constraint=rows)
        else:
            made, of_each = self.packed(problem, OF_ROWS), self.cost is not None
            make = lambda: (self.cost_numbers(problem), int(self.cost is None and is_bounded(problem.cost)))
            if problem.B > 0:
                made.cost_data, made.bounded = _of_last(problem, "cost", problem.cost, of_each, make)
        problem.derived[what] = made
        return made

    def model_numbers(self, problem: Problem) -> c.Array:
        """The model's numbers of each problem."""
        if self.model.count == 0 or problem.B == 0:
            return c.Array()
        return array(self.model.numbers(problem.B, problem.dynamics, self.shared.model), knots=True)

    def cost_numbers(self, problem: Problem) -> list[c.Array]:
        """The cost's arrays."""
        if self.cost is None:
            return quadratic_arrays(problem.cost)
        return cost_arrays(problem, self.cost, self.shared.cost)

    def _row(self, problem: Problem, i: int) -> c.Constraint:
        """Constraint i without multipliers."""
        constraint = problem.constraints[i]
        described = constraint, problem.row_shapes[i], problem.N, kind_of(constraint)
        return _of_last(
            problem, i, constraint, i in self.functions, lambda: constraint_of(*described, self.row_numbers(problem, i))
        )

    def row_numbers(self, problem: Problem, i: int) -> dict[str, Any]:
        """The fields of a `Constraint` in C that hold the numbers of constraint i."""
        source, constraint = self.functions.get(i), problem.constraints[i]
        if source is None:
            return numbers_of(constraint, None, problem)
        shared = self.shared.rows[i]
        fields = numbers_of(constraint, rows_numbers(problem, i, source, shared), problem)
        return {**fields, "shared": shared, "radii": array(constraint.row_radii, knots=True)}


def _of_last(problem: Problem, name: str | int, part: Any, of_each: bool, make: Callable[[], Any]) -> Any:
    """What was made of a part for the last problem of the form, where this one has the same part, else made now.

    What problems share stays the same object in a subset; where `of_each`, numbers are computed for each of them.
    """
    known, B, made = problem.known.packed.get(name, (None, 0, None))
    if known is not part or (of_each and B != problem.B):
        made = make()
        problem.known.packed[name] = part, problem.B, made
    return made


def run(function: Any, count: int, group: int, argument: ctypes.Structure, first: int = 0) -> None:
    """Call a function of a library on `count` problems, in whole groups, by as many threads as PyTorch uses.

    Raises:
        MemoryError: the library could not allocate memory.
    """
    if count == 0:
        return
    if isinstance(function, Kernel):
        if function.served(argument, first, count):
            return
        function = function.host
    groups, threads = -(-count // group), torch.get_num_threads()
    if groups == 1 or threads == 1:
        if not function(ctypes.byref(argument), ctypes.c_int64(first), ctypes.c_int64(first + count)):
            raise MemoryError(NO_MEMORY)
        return
    parts = min(threads, groups)
    edges = [first + group * (groups * i // parts) for i in range(parts)] + [first + count]
    spans = [(ctypes.byref(argument), ctypes.c_int64(a), ctypes.c_int64(b)) for a, b in pairwise(edges)]
    if not all(_at_once(function, spans, _helpers(threads - 1))):
        raise MemoryError(NO_MEMORY)


def _at_once(function: Any, spans: list[tuple[Any, ...]], helpers: ThreadPoolExecutor) -> list[int]:
    """What the function returns for each of these arguments; this thread takes the first."""
    calls: list[Future[int]] = []
    try:
        calls += (helpers.submit(function, *span) for span in spans[1:])
        return [function(*spans[0]), *(call.result() for call in calls)]
    except BaseException:  # Ctrl-C: nothing may still write to what the caller goes on with
        for call in calls:
            call.cancel()
        wait(calls)
        raise


@functools.cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """Threads that are kept, and end with the process: starting them takes as long as a small call."""
    return ThreadPoolExecutor(count, thread_name_prefix="torchgco")


os.register_at_fork(after_in_child=_helpers.cache_clear)  # a child has none of its parent's threads


def _measured(constraint: Constraint) -> bool:
    """Whether violations are what the base class says of rows, or C finds them from these."""
    if constraint.row_radii is not None:
        return type(constraint.bare).violation in (NormBounds.violation, SpheresInFreeTime.violation)
    while isinstance(constraint, WrappedConstraint) and constraint.keeps_rows:
        constraint = constraint.constraint
    return (type(constraint).violation, type(constraint).worst) == (Constraint.violation, Constraint.worst)


REALS = {torch.float64: ("double", LANES), torch.float32: ("float", 2 * LANES)}  # type and lanes in C


class Sampler:
    """The library that samples around the controls of a form of problems, in single or double precision.

    Raises:
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, engine: Engine, dtype: torch.dtype) -> None:
        self.engine = engine
        self.library = engine.further(
            dtype, lambda: engine.form.units(SAMPLER, *REALS[dtype]), cuda.SAMPLER, REALS[dtype][0]
        )

    def improve(self, problem: Problem, U: Tensor, how: Sampling) -> Tensor:
        """See `kernels.in_pytorch.Kernels.sample`."""
        mean = U.clone(memory_format=torch.contiguous_format)
        wide = problem.x0.new_full((1, 1, 1, problem.m), torch.inf)
        lower, upper = (array(bound.squeeze(2).transpose(0, 1), knots=True) for bound in how.bounds or (-wide, wide))
        rounds = c.Sampling(
            of=self.engine.packed(problem, X=repeated(problem.x0, problem.N + 1)), mean=mean,
            samples=how.samples, rounds=how.rounds, knots=how.noise_knots, decay=how.decay, elite=how.elite,
            temperature=how.temperature, collision_penalty=how.collision_penalty, dwell_cost=how.dwell_cost,
            keys=torch.stack([words(how.key, i) for i in range(how.rounds)], dim=-1),
            deviation=array(how.sigma.sqrt(), knots=True), lower=lower, upper=upper,
            geometric=torch.tensor([int(row.geometric) for row in problem.constraints], dtype=torch.int32),
        )  # fmt: skip
        if how.left is not None and how.share is not None:
            rounds.left, rounds.share = how.left.to(torch.int32), how.share.double()
        run(self.library.tgco_sample, problem.B, 1, rounds)
        return mean
