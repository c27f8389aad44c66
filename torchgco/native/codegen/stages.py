"""C of a model that differs from stage to stage: its step at each form of a stage, with the numbers of each stage."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchgco.base.tree import apart
from torchgco.base.values import whole_numbers_become
from torchgco.dynamics import Dynamics
from torchgco.native.codegen import dynamics as code
from torchgco.native.codegen.dynamics import DynamicsSource, step_parts, trace_dynamics
from torchgco.native.codegen.knot import KnotSource, Span, knot_parts
from torchgco.problem.problem import Problem
from torchgco.tracing import Traced, own_tensors


@dataclass(frozen=True)
class StagesSource(DynamicsSource):
    """A DynamicsSource whose numbers p are those of a stage."""

    stage: KnotSource = field(repr=False, compare=False)

    def numbers(self, B: int, of: Dynamics, shared: Tensor) -> Tensor:
        return self.stage.numbers(B, own_tensors(of), shared, lambda: _span(of, len(self.stage.span.knots)))


def trace_model(problem: Problem) -> DynamicsSource:
    """The C of a problem's dynamics, taken from the cache folder if it was made before.

    Raises:
        InputError: a step that can't be traced, or holds an operation without a counterpart.
    """
    model = problem.dynamics
    if problem.along is model:
        return trace_dynamics(model)
    span = _span(model, problem.N)
    make = lambda knots, _: step_parts([(knot.inputs, knot.rows, knot.calls) for knot in knots])
    source, parts = knot_parts("stages", span, make, __file__, str(code.__file__))
    lists = {name: tuple(parts[name]) for name in ("rows", "columns", "places", "values")}
    count = source.places.shape[1]
    return StagesSource(
        model.n, model.m, count, source.code, **lists, affine=parts["affine"], key=source.key, traced=span.traced,
        stage=source,
    )  # fmt: skip


def _span(model: Dynamics, N: int) -> Span:
    """The steps of all stages of one problem, traced together."""
    model, stages = apart(model), torch.arange(N)
    tensors = own_tensors(model)
    X, U = (torch.zeros(1, N, size, dtype=torch.float64) for size in (model.n, model.m))
    with whole_numbers_become(X.dtype):  # 0.3 * k as for a single stage, where k is an int
        traced = Traced("dynamics.step", lambda i, X, U: model.take(i).at(stages).step(X, U), X, U, own=tensors)
    # A signature has N, and so the stages.
    traced.outside = [tensor for tensor in traced.outside if tensor is not stages]
    return Span(traced, model.n, model.m, N, N, range(N))
