"""C of a traced constraint: its rows, and the terms that they add to a quadratic model."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import apart
from torchgco.constraints.base import FunctionConstraint
from torchgco.native.codegen import calls
from torchgco.native.codegen.knot import Knot, KnotSource, Span, knot_source
from torchgco.native.packing import is_lifted
from torchgco.problem.problem import Problem
from torchgco.tracing import Traced, own_tensors


def trace_rows(problem: Problem, i: int) -> KnotSource:
    """C of the rows c of constraint i, with x (n), u (m), a knot's own numbers p, and the
    numbers w that all problems share:

        tgco_KEY_rows(x, u, p, w, c)
        tgco_KEY_add(x, u, p, w, by_c, by_cc, g, H)     g += c_z' by_c,  H += c_z' diag(by_cc) c_z, its upper triangle

    Of a body, whose rows C knows, it is the centers c (P DIM) of the balls:

        tgco_KEY_rows(x, u, p, w, c)
        tgco_KEY_slopes(x, u, p, w, e)    c_z (P DIM, COUNT) by the columns of z = [x, u] that it reads
        tgco_KEY_count, tgco_KEY_columns  how many these are, and which, rising

    Raises:
        InputError: the rows can't be traced, hold an operation without a counterpart, or join several knots.
    """
    kind, code = ("lift", _lift_code) if is_lifted(problem.constraints[i]) else ("rows", _code)
    return knot_source(kind, span_of_rows(problem, i), code, __file__)


def rows_numbers(problem: Problem, i: int, source: KnotSource, shared: Tensor) -> Tensor:
    """The numbers (B|1, K|1, count) of constraint i; `shared` are those that all problems share."""
    return source.numbers(problem.B, own_tensors(traced_part(problem, i)), shared, lambda: span_of_rows(problem, i))


def traced_part(problem: Problem, i: int) -> Any:
    """What is traced of constraint i: itself, or what places the balls of a body, whose rows C knows."""
    constraint: Any = problem.constraints[i]
    return constraint.points if is_lifted(constraint) else constraint


def span_of_rows(problem: Problem, i: int) -> Span:
    """Constraint i, traced along whole trajectories, as PyTorch calls it."""
    constraint, n, m, N = apart(traced_part(problem, i)), problem.n, problem.m, problem.N
    called = isinstance(constraint, FunctionConstraint)
    name = constraint.name if called else f"constraints[{i}] ({type(constraint).__name__})"
    try:
        knots = torch.arange(N + 1)[constraint.knots].tolist()
    except (AttributeError, IndexError, TypeError):
        raise InputError(f"{name}.knots", f"some of 0..{N}", getattr(constraint, "knots", "none")) from None
    if not knots:
        raise InputError(f"{name}.knots", "at least one knot", "none")

    def value(index: Tensor, X: Tensor, U: Tensor) -> Tensor:
        rows = constraint.take(index).value(X, U)
        if rows.dim() != 3 or tuple(rows.shape[:2]) != (1, len(knots)):
            raise InputError(f"{name}.value", f"rows (1, {len(knots)}, p)", tuple(rows.shape))
        return rows

    X, U = problem.x0.new_zeros(1, N + 1, n), problem.x0.new_zeros(1, N, m)
    return Span(Traced(name, value, X, U, own=own_tensors(constraint)), n, m, N + 1, N, knots)


def _code(knot: Knot, name: str) -> str:
    import casadi as ca

    inputs = knot.inputs
    ahead = calls.Ahead(knot.calls, ca.vertcat(knot.x, knot.u))
    slopes = ahead.jacobian(knot.rows)
    places, nonzeros = places_of(slopes), slopes.nonzeros()
    code = [
        calls.emit_staged(f"tgco_{name}_rows", inputs, [knot.rows], calls.values(knot.calls)),
        calls.emit_staged(f"tgco_{name}_slopes", inputs, [ca.vertcat(ca.SX(0, 1), *nonzeros)], ahead.stages),
        f"static inline void tgco_{name}_add(",
        "    IN x, IN u, IN p, const double *w, IN by_c, IN by_cc, OUT g, OUT H) {",
        f"    V e[{max(1, len(places))}];",
        f"    tgco_{name}_slopes(x, u, p, w, e);",
    ]
    code += [f"    ADD(g[{column}], e[{i}], by_c[{row}]);" for row, column, i in places]
    return "\n".join([*code, *squares(places, "by_cc"), "}"])


def places_of(slopes: Any) -> list[tuple[int, int, int]]:
    """Row, column and number of each nonzero, row by row."""
    rows, columns = slopes.sparsity().get_triplet()
    return sorted(zip(rows, columns, range(len(rows)), strict=True))


def squares(places: list[tuple[int, int, int]], weights: str) -> list[str]:
    """C that adds c_z' diag(weights) c_z to the upper triangle of H, of slopes e at these places."""
    pairs = ((first, other) for first in places for other in places if other[0] == first[0] and other[1] >= first[1])
    return [
        f"    ADD(H[{column} * (NX + NU) + {later}], e[{i}] * {weights}[{row}], e[{j}]);"
        for (row, column, i), (_, later, j) in pairs
    ]


def _lift_code(knot: Knot, name: str) -> str:
    import casadi as ca

    ahead = calls.Ahead(knot.calls, ca.vertcat(knot.x, knot.u))
    slopes = ahead.jacobian(knot.rows)
    columns = sorted(set(slopes.sparsity().get_triplet()[1]))
    dense: Any = ca.densify(ca.vec(slopes[:, columns].T))  # row by row
    return "\n".join(
        [
            calls.emit_staged(f"tgco_{name}_rows", knot.inputs, [knot.rows], calls.values(knot.calls)),
            calls.emit_staged(f"tgco_{name}_slopes", knot.inputs, [dense], ahead.stages),
            f"static const int tgco_{name}_count = {len(columns)};",
            f"static const int tgco_{name}_columns[] = {{{', '.join(map(str, columns))}}};",
        ]
    )
