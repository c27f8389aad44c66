"""A Problem as one nonlinear program of CasADi by multiple shooting, built once for the whole batch.

Variables are ordered by stage, [x_0, u_0, x_1, u_1, ..., x_N], and so are the rows: x_{k+1} - step(x_k, u_k) first,
then the constraint rows of knot k. Interior-point solvers for optimal control find their blocks by this order. The
unknowns of an implicit step are variables after u_k, and its equations rows of knot k: direct collocation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement, apart
from torchgco.constraints.bounds import LOOSE
from torchgco.dynamics.base import IMPLICIT
from torchgco.problem.problem import Problem
from torchgco.tracing import Traced, own_tensors
from torchgco.tracing.arrays import elements
from torchgco.tracing.nets import Call


@dataclass(frozen=True)
class Program:
    """minimise f(v, p) subject to lower <= v <= upper and to rows g(v, p), all zero or, where not `equality`, <= 0."""

    variables: ca.SX  # v
    parameters: ca.SX  # p: x_0, then each part's own numbers
    objective: ca.SX
    rows: ca.SX
    equality: list[bool]
    path_rows: list[int]  # number of rows of each knot 0..N, without x_{k+1} - step(x_k, u_k)
    limits: _Limits
    free: list[bool]  # which components of x_0 are variables
    unknowns: ca.Function  # of v and p: guesses (N, q) of the unknowns of implicit steps
    sources: tuple[Traced, ...]

    def values(self, problem: Problem, b: int) -> np.ndarray:
        """p for problem b of the batch."""
        index = torch.tensor([b], device=problem.x0.device)
        parameters = [source.parameters(index) for source in self.sources]
        return np.concatenate([problem.x0[b].double().cpu().numpy(), *parameters])

    def of(self, problem: Problem) -> Program:
        """The same program for other problems, whose parts differ from those of the first in their own numbers alone.

        Raises:
            InputError: problems that differ in more, such as sizes, knots, or kinds of parts; errors of `transcribe`.
        """
        step, cost, constraints = _traces(problem)
        sources = (step, cost, *constraints)
        key = lambda source: (source.fingerprint(), source.shared.tolist())
        if self.free != _free(problem) or list(map(key, sources)) != list(map(key, self.sources)):
            raise InputError("problem", "one of the form that was prepared", "another form")
        return replace(self, sources=sources)


@dataclass(frozen=True)
class _Limits:
    """Rows that bound one variable, as `slope * v[variable] + offset(p) <= 0`."""

    variable: np.ndarray
    slope: np.ndarray
    offset: ca.Function

    def bounds(self, p: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
        """lower and upper (size,) for the parameters p."""
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        limit = -np.asarray(self.offset(p)).reshape(-1) / self.slope
        rising = self.slope > 0
        np.minimum.at(upper, self.variable[rising], limit[rising])
        np.maximum.at(lower, self.variable[~rising], limit[~rising])
        lower[lower <= -LOOSE], upper[upper >= LOOSE] = -np.inf, np.inf
        return lower, upper


def transcribe(problem: Problem) -> Program:
    """The program of a batch.

    Raises:
        InputError: a part that can't be traced, or that uses an operation without a counterpart in CasADi; horizons;
            maps.
    """
    if any(obstacle.map is not None for obstacle in problem.obstacles):
        expected = "no Field: ipopt and fatrop can't take maps; gco, multistart and interior_point do"
        raise InputError("problem.constraints", expected, "a Field")
    if problem.horizon is not None:
        raise InputError("horizon", "None for CasADi: a solve for each length", "horizons of each problem")
    N, n, m = problem.N, problem.n, problem.m
    step, cost, constraints = _traces(problem)
    sources = (step, cost, *constraints)
    start = ca.SX.sym("x0", n)
    symbols = [ca.SX.sym(f"p{i}", source.count) for i, source in enumerate(sources)]
    x, u = [ca.SX.sym(f"x{k}", n) for k in range(N + 1)], [ca.SX.sym(f"u{k}", m) for k in range(N)]
    X, U = np.stack([elements(z) for z in x])[None], np.stack([elements(z) for z in u])[None]
    ahead, calls = _ahead(problem, step, symbols[0], X, U)
    unknowns = [ca.vertcat(ca.SX(0, 1), *(root.outputs for root in roots)) for roots in calls]
    variables = ca.vertcat(*(ca.vertcat(*z) for z in zip(x, u, unknowns, strict=False)), x[-1])

    at_knot: list[list[tuple[ca.SX, bool]]] = [[] for _ in range(N + 1)]  # rows, and whether each is an equality
    free = _free(problem)
    at_knot[0] = [(row, True) for row, is_free in zip(elements(x[0] - start), free, strict=True) if not is_free]
    for constraint, traced, p in zip(problem.constraints, constraints, symbols[2:], strict=True):
        values = traced(elements(p), X, U)[0]
        for k, rows in zip(_knots(constraint.knots, N), values, strict=True):
            at_knot[k] += [(row, constraint.sense == "equality") for row in rows]
    for k, of_stage in enumerate(calls):
        at_knot[k] += [(row, True) for call in of_stage for row in elements(call.inputs[: call.net.size])]
    guesses = [ca.vertcat(ca.SX(0, 1), *(call.inputs[call.net.size :] for call in of_stage)) for of_stage in calls]
    parameters = ca.vertcat(start, *symbols)
    limits, at_knot = _limits(at_knot, variables, parameters)

    rows, equality = [], []
    for k in range(N + 1):
        gap = [(row, True) for row in elements(x[k + 1] - ahead[k])] if k < N else []
        rows += [row for row, _ in gap + at_knot[k]]
        equality += [is_equality for _, is_equality in gap + at_knot[k]]
    return Program(
        variables, parameters, _column(cost(elements(symbols[1]), X, U)), _column(rows), equality,
        [len(knot) for knot in at_knot], limits, free,
        ca.Function("unknowns", [variables, parameters], [ca.horzcat(*guesses).T]), sources,
    )  # fmt: skip


def _free(problem: Problem) -> list[bool]:
    """Which components of the start are variables; InputError unless they are the same in all problems."""
    if problem.free_start is None:
        return [False] * problem.n
    if bool((problem.free_start != problem.free_start[0]).any()):
        raise InputError("free_start", "for CasADi the same components in all problems", "different ones")
    return problem.free_start[0].tolist()


def _traces(problem: Problem) -> tuple[Traced, Traced, list[Traced]]:
    X, U = problem.x0.new_zeros(1, problem.N + 1, problem.n), problem.x0.new_zeros(1, problem.N, problem.m)
    at_all = _changes(problem) or problem.dynamics.integrator in IMPLICIT

    def trace(field: str, part: PerElement, method: str, *examples: Tensor) -> Traced:
        part = apart(part)
        return Traced(field, lambda i, *z: getattr(part.take(i), method)(*z), *examples, own=own_tensors(part))

    return (
        trace("dynamics.step", problem.along, "step", *((X[:, :-1], U) if at_all else (X[:, 0], U[:, 0]))),
        trace("cost", problem.cost, "total", X, U),
        [trace(f"constraints[{i}] ({type(c).__name__})", c, "value", X, U) for i, c in enumerate(problem.constraints)],
    )


def _changes(problem: Problem) -> bool:
    """Whether the dynamics depend on the stage."""
    return problem.along is not problem.dynamics


def _ahead(
    problem: Problem, step: Traced, p: ca.SX, X: np.ndarray, U: np.ndarray
) -> tuple[list[ca.SX], list[list[Call]]]:
    """step(x_k, u_k) of each stage, from X (1, N+1, n) and U (1, N, m), and the roots in each."""
    if step.has_roots:
        roots: list[Call] = []
        after = step(elements(p), X[:, :-1], U, calls=roots)[0]
        return list(map(_column, after)), [roots[k :: problem.N] for k in range(problem.N)]
    none: list[list[Call]] = [[] for _ in range(problem.N)]
    if _changes(problem):
        return [_column(after) for after in step(elements(p), X[:, :-1], U)[0]], none
    first = [_column(z[0, 0]) for z in (X, U)]
    single = ca.Function("step", [*first, p], [_column(step(elements(p), X[:, 0], U[:, 0])[0])])
    return [single(_column(x), _column(u), p) for x, u in zip(X[0], U[0], strict=False)], none


def _limits(
    at_knot: list[list[tuple[ca.SX, bool]]], variables: ca.SX, parameters: ca.SX
) -> tuple[_Limits, list[list[tuple[ca.SX, bool]]]]:
    """Inequalities that bound a single variable, and the remaining rows. Rows without any variable are dropped.

    A solver stays strictly inside variable bounds, and needs no slack for them.
    """
    rows = _column([row for knot in at_knot for row, _ in knot])
    jacobian = ca.jacobian(rows, variables)
    entries: list[Any] = jacobian.nonzeros()
    entry_row, entry_variable = map(np.asarray, jacobian.sparsity().get_triplet())
    per_row = np.bincount(entry_row, minlength=rows.numel())
    single = {int(entry_row[i]): i for i in range(len(entries)) if per_row[entry_row[i]] == 1}
    left: list[list[tuple[ca.SX, bool]]] = []
    bounds, index = [], 0
    for knot in at_knot:
        left.append([])
        for row, is_equality in knot:
            entry = single.get(index)
            if entry is not None and not is_equality and entries[entry].is_constant():
                bounds.append((row, int(entry_variable[entry]), float(entries[entry])))
            elif per_row[index]:
                left[-1].append((row, is_equality))
            index += 1
    at_zero = ca.substitute(_column([row for row, *_ in bounds]), variables, ca.SX.zeros(*variables.shape))
    offset = ca.Function("offset", [parameters], [at_zero])
    limits = _Limits(np.array([v for _, v, _ in bounds], dtype=int), np.array([s for *_, s in bounds]), offset)
    return limits, left


def _knots(knots: slice | Tensor, N: int) -> list[int]:
    return list(range(N + 1)[knots]) if isinstance(knots, slice) else [int(k) for k in knots]


def _column(elements: Iterable) -> ca.SX:
    return ca.vertcat(ca.SX(0, 1), *elements)
