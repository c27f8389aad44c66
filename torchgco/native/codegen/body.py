"""C of the places of a body's balls, and of their slopes."""

from __future__ import annotations

from typing import Any

from torchgco.native.codegen import calls
from torchgco.native.codegen.constraint import span_of_rows
from torchgco.native.codegen.knot import Knot, KnotSource, knot_source
from torchgco.problem.problem import Problem


def trace_lift(problem: Problem, i: int) -> KnotSource:
    """C of the centers c (P DIM) of the balls of constraint i, with arguments as of `trace_rows`:

        tgco_KEY_rows(x, u, p, w, c)
        tgco_KEY_slopes(x, u, p, w, e)    c_z (P DIM, COUNT) by the columns of z = [x, u] that it reads
        tgco_KEY_count, tgco_KEY_columns  how many these are, and which, rising

    Raises:
        InputError: as `trace_rows`.
    """
    return knot_source("lift", span_of_rows(problem, i), _code, __file__)


def _code(knot: Knot, name: str) -> str:
    import casadi as ca

    inputs = knot.inputs
    ahead = calls.Ahead(knot.calls, ca.vertcat(knot.x, knot.u))
    slopes = ahead.jacobian(knot.rows)
    columns = sorted(set(slopes.sparsity().get_triplet()[1]))
    dense: Any = ca.densify(ca.vec(slopes[:, columns].T))  # row by row
    return "\n".join(
        [
            calls.emit_staged(f"tgco_{name}_rows", inputs, [knot.rows], calls.values(knot.calls)),
            calls.emit_staged(f"tgco_{name}_slopes", inputs, [dense], ahead.stages),
            f"static const int tgco_{name}_count = {len(columns)};",
            f"static const int tgco_{name}_columns[] = {{{', '.join(map(str, columns))}}};",
        ]
    )
