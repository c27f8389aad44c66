"""C of a traced cost: value, gradient and Hessian of a stage and of the last knot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import apart
from torchgco.costs.base import Cost, ScaledCost, ShiftedCost
from torchgco.native.codegen import calls, emit
from torchgco.native.codegen.dynamics import names_of
from torchgco.native.codegen.knot import Knot, KnotSource, Span, knot_parts
from torchgco.native.structures import Array, Quadratic, TracedCost, array
from torchgco.problem.problem import Problem
from torchgco.tracing import Traced, own_tensors


@dataclass(frozen=True)
class CostSource:
    """The generated code that traced.c describes; a problem's cost is this cost times a factor."""

    stage: KnotSource
    last: KnotSource

    @property
    def parts(self) -> tuple[KnotSource, KnotSource]:
        return self.stage, self.last

    @property
    def code(self) -> str:
        return f"{self.stage.code}\n{self.last.code}"


def unscaled(problem: Problem) -> tuple[Cost, Tensor, Tensor]:
    """The cost of a problem without the factors of a ScaledCost, their product (B,), and the shift per stage (B,)."""
    # A cost that overrides `scaled` may have another form once scaled, so it is always scaled here, if only by 1.
    factor, shift = problem.x0.new_ones(problem.B), problem.x0.new_zeros(problem.B)
    cost = problem.cost.scaled(factor)
    while isinstance(cost, (ScaledCost, ShiftedCost)):
        if isinstance(cost, ScaledCost):
            cost, factor = cost.cost, factor * cost.factor
        else:
            cost, shift = cost.cost, shift + factor * cost.shift
    return cost, factor, shift


def trace_cost(problem: Problem) -> CostSource:
    """The C of a problem's cost, taken from the cache folder if it was made before.

    Derivatives are exact, or those of the cost's own `expand`.

    Raises:
        InputError: a part that can't be traced, holds an operation without a counterpart, or joins several knots.
    """
    cost, *_ = unscaled(problem)
    block = None if type(cost).expand is Cost.expand else problem.n + 1 + problem.m
    stage, last = spans_of_cost(problem)
    spans = {"stage": stage, "last": last}
    sources = (knot_parts(name, span, partial(_parts, name, block), __file__)[0] for name, span in spans.items())
    return CostSource(*sources)


def cost_arrays(problem: Problem, source: CostSource, shared: tuple[Tensor, Tensor]) -> list[Array]:
    """The arrays of traced.c: factor and shift (B, 1, 2), and the numbers (B|1, K|1, count) of stages and last knot.

    `shared` are the numbers that all problems share, of stages and last knot.
    """
    cost, factor, shift = unscaled(problem)
    tensors = own_tensors(cost)
    stage = source.stage.numbers(problem.B, tensors, shared[0], lambda: spans_of_cost(problem)[0])
    last = source.last.numbers(problem.B, tensors, shared[1], lambda: spans_of_cost(problem)[1])
    scale = torch.stack((factor, shift), dim=-1).unsqueeze(1)
    numbers = {TracedCost.FACTOR: scale, TracedCost.STAGE: stage, TracedCost.LAST: last}
    arrays = [array(numbers[which], knots=True) for which in TracedCost]
    return arrays + [Array()] * (len(Quadratic) - len(arrays))


def spans_of_cost(problem: Problem) -> tuple[Span, Span]:
    """Stages and last knot, traced: the value, followed by the block (s, s) of the cost's own `expand`, if any."""
    (cost, *_), N, n, m = unscaled(problem), problem.N, problem.n, problem.m
    cost = apart(cost)
    tensors = own_tensors(cost)

    def stage(i: Tensor, X: Tensor, U: Tensor) -> Tensor:
        single = cost.take(i)
        value = single.stage(X, U, torch.arange(N))
        if tuple(value.shape) != (1, N):
            raise InputError(_named("stage", cost), f"costs (1, {N}) of states (1, {N}, {n})", tuple(value.shape))
        return _with_blocks(single, value, torch.cat((X, X.new_zeros(1, 1, n)), dim=1), U, slice(0, N))

    def last(i: Tensor, X: Tensor, U: Tensor) -> Tensor:
        single = cost.take(i)
        value = single.terminal(X[:, 0])
        if tuple(value.shape) != (1,):
            raise InputError(_named("terminal", cost), f"costs (1,) of states (1, {n})", tuple(value.shape))
        X = torch.cat((X.new_zeros(1, N, n), X), dim=1)
        return _with_blocks(single, value.unsqueeze(-1), X, X.new_zeros(1, N, m), slice(N, N + 1))

    def span(name: str, function: Callable[..., Tensor], states: int, controls: int) -> Span:
        examples = problem.x0.new_zeros(1, states, n), problem.x0.new_zeros(1, controls, m)
        with cost.precision(problem.x0.dtype):
            traced = Traced(_named(name, cost), function, *examples, own=tensors)
        return Span(traced, n, m, states, controls, range(states))

    return span("stage", stage, N, N), span("terminal", last, 1, 0)


def _with_blocks(cost: Cost, value: Tensor, X: Tensor, U: Tensor, knots: slice) -> Tensor:
    """Values (1, K) followed by what the cost's own `expand` writes at these knots, (1, K, 1 [+ s * s])."""
    value = value.unsqueeze(-1)
    if type(cost).expand is Cost.expand:
        return value
    s = X.shape[-1] + 1 + U.shape[-1]
    H = X.new_zeros(1, X.shape[1], s, s)
    cost.expand(X, U, H)
    return torch.cat((value, H[:, knots].flatten(2)), dim=-1)


def _named(method: str, cost: Cost) -> str:
    return f"cost.{method} ({type(cost).__name__})"


def _parts(name: str, block: int | None, knots: Sequence[Knot], _: str) -> dict[str, Any]:
    """The code of a cost at a stage, or the last knot, for each form of knots."""
    value, entries = f"tgco_{name}_value", f"tgco_{name}_entries"
    derived = [_derivatives(knot) if block is None else _blocks(knot, block) for knot in knots]
    size = knots[0].x.numel() + knots[0].u.numel()
    of_gradient = lambda i: any(not gradient[i].is_zero() for gradient, *_ in derived)
    of_hessian = lambda i, j: any(not hessian[i, j].is_zero() for _, hessian, _ in derived)
    slopes = [i for i in range(size) if of_gradient(i)]
    curvatures = [(i, j) for i in range(size) for j in range(i, size) if of_hessian(i, j)]
    places, code = [*slopes, *(i * size + j for i, j in curvatures)], list[str]()
    for knot, (gradient, hessian, stages), of in zip(knots, derived, names_of(knots, value, entries), strict=True):
        column = [*(gradient[i] for i in slopes), *(hessian[i, j] for i, j in curvatures)]
        code += [_value_code(knot, of[0]), _entries_code(knot, of[1], column, stages)]
    if len(knots) > 1:
        code += [emit.by_form(function, len(knots), len(knots[0].inputs), 1) for function in (value, entries)]
    code += [
        f"static const int tgco_{name}_places[] = {{{', '.join(map(str, places or [0]))}}};",
        f"#define {name.upper()}_SLOPES {len(slopes)}",
        f"#define {name.upper()}_ENTRIES {len(places)}",
    ]
    return {"code": "\n".join(code)}


def _value_code(knot: Knot, name: str) -> str:
    import casadi as ca

    return calls.emit_staged(name, knot.inputs, [ca.densify(knot.rows[0])], calls.values(knot.calls))


def _entries_code(knot: Knot, name: str, entries: Sequence[Any], stages: Sequence[calls.Stage]) -> str:
    import casadi as ca

    column = ca.cse(ca.densify(ca.vertcat(ca.SX(0, 1), *entries)))
    return calls.emit_staged(name, knot.inputs, [column], stages)


def _derivatives(knot: Knot) -> tuple[Any, Any, list[calls.Stage]]:
    """Gradient (n+m) and Hessian (n+m, n+m), and the stages of networks that they need."""
    import casadi as ca

    def second(total: Any, z: Any) -> Any:
        # Forward mode only: in reverse mode, a NaN of the branch not taken would come through as 0 * NaN.
        return ca.jacobian(ca.jacobian(total, z, forward).T, z, forward)

    z, forward = ca.vertcat(knot.x, knot.u), {"allow_reverse": False}
    if not knot.calls:
        return ca.jacobian(knot.rows[0], z, forward).T, second(knot.rows[0], z), []
    ahead = calls.Ahead(knot.calls, z)
    stages, hessian = ahead.hessian(knot.rows[0], second)
    return ahead.jacobian(knot.rows[0]).T, hessian, stages


def _blocks(knot: Knot, s: int) -> tuple[Any, Any, list[calls.Stage]]:
    """Gradient and Hessian from a block (s, s) in the order [x, 1, u] that follows the value, row by row."""
    import casadi as ca

    n = knot.x.numel()
    block = ca.reshape(knot.rows[1:], s, s).T
    z = [i for i in range(s) if i != n]
    return block[z, n], block[z, z], calls.values(knot.calls)
