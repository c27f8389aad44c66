"""C of the second derivatives that the interior point needs: of a model's step and of traced constraints."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence
from typing import Any

from torchgco.native import store
from torchgco.native.codegen import calls, emit
from torchgco.native.codegen.constraint import places_of, squares
from torchgco.native.codegen.dynamics import DynamicsSource, Step, computed_entries, makers, names_of, stepped
from torchgco.native.codegen.knot import Knot, KnotSource, knot_parts, knot_source
from torchgco.native.codegen.stages import StagesSource

# Operations whose derivatives are finite wherever their arguments are.
SMOOTH_OPERATIONS = (
    "INPUT", "CONST", "PARAMETER", "ASSIGN", "ADD", "SUB", "MUL", "NEG", "TWICE", "SQ", "SIN", "COS", "ATAN", "TANH",
    "ERF", "FABS", "FMIN", "FMAX", "SIGN", "FLOOR", "CEIL", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR", "IF_ELSE_ZERO",
    "REMAINDER",
)  # fmt: skip
_EXPAND = """
TGCO_BETWEEN_UNITS void model_expand(IN x, IN u, IN p, const double *w, IN y, OUT f, OUT H) {
#ifdef TGCO_TOGETHER
    tgco_together(x, u, p, w, y, f, H);
#else
    model_jacobian(x, u, p, w, f);
    tgco_curve(x, u, p, w, y, H);
#endif
}
"""


def curvature_code(model: DynamicsSource, functions: Iterable[tuple[int, KnotSource]]) -> str:
    """The functions of model.h with second derivatives, of a model and the traced constraints by their place."""
    rows = [(i, knot_source("curves", source.span, _rows_code, __file__)) for i, source in functions]
    code = dict.fromkeys(source.code for _, source in rows)
    return "\n".join([_model_code(model), _EXPAND, _push(model), *code, _switches(rows)])


def _model_code(model: DynamicsSource) -> str:
    """`tgco_curve(x, u, p, w, y, H)`: H += sum_i y_i times the second derivatives of state i, upper triangle.

    With networks it is `tgco_together(x, u, p, w, y, f, H)`, which also does what `tgco_jacobian` does: both need the
    networks' tangents.
    """

    if isinstance(model, StagesSource):
        steps_of = lambda knots: [(knot.inputs, knot.rows, knot.calls) for knot in knots]
        code_of = lambda knots, _: {"code": _step_code(model, steps_of(knots))}
        return knot_parts("curvature", model.stage.span, code_of, __file__)[0].code
    key, traced = ("curvature", model.key, *makers(__file__)), model.traced
    make = lambda: {"code": _step_code(model, [stepped(traced, model.n, model.m)])}
    return emit.checked(traced.field, store.made(key, make, f"curvature {traced.kin}").content["code"])


def _step_code(model: DynamicsSource, steps: Sequence[Step]) -> str:
    """Of steps, one for each form of stages."""
    import casadi as ca

    together = any(found for *_, found in steps)
    name = "tgco_together" if together else "tgco_curve"
    lists, code = {key: getattr(model, key) for key in ("rows", "columns", "places")}, list[str]()
    for (inputs, ahead, found), (of,) in zip(steps, names_of(steps, name), strict=True):
        y, tangents, slopes = ca.SX.sym("y", ahead.numel()), None, None
        if together:
            tangents = calls.Ahead(found, ca.vertcat(*inputs[:2]))
            slopes = computed_entries(tangents.jacobian(ahead), lists)
        code.append(_curves(of, [*inputs, y], ca.dot(y, ahead), tangents, slopes))
    if len(steps) > 1:
        code.append(emit.by_form(name, len(steps), 5, 1 + together))
    return "\n".join([*code, *(["#define TGCO_TOGETHER"] if together else [])])


def _rows_code(knot: Knot, name: str) -> str:
    """`tgco_NAME_model` and `tgco_NAME_along` of a traced constraint, which `_switches` calls."""
    import casadi as ca

    inputs, ahead = knot.inputs, calls.Ahead(knot.calls, ca.vertcat(knot.x, knot.u))
    slopes = ahead.jacobian(knot.rows)
    places, lam = places_of(slopes), ca.SX.sym("lam", knot.rows.numel())
    column = ca.vertcat(ca.SX(0, 1), *slopes.nonzeros())
    lines = [
        _curves(f"tgco_{name}_bend", [*inputs, lam], ca.dot(lam, knot.rows), ahead, column if knot.calls else None),
        calls.emit_staged(f"tgco_{name}_slants", inputs, [column], ahead.stages),
        f"static inline void tgco_{name}_model(IN x, IN u, IN p, const double *w, IN by,",
        "    IN cc, IN lam, OUTS g, OUT H) {",
        f"    V e[{max(1, len(places))}];",
        f"    tgco_{name}_bend(x, u, p, w, lam, e, H);" if knot.calls else f"    tgco_{name}_slants(x, u, p, w, e);",
    ]
    for row, column, i in places:
        lines.append(f"    for (int a = 0; a < PARTS; a++) ADD(g[a][{column}], e[{i}], by[a * MAX_ROWS + {row}]);")
    lines += [
        *squares(places, "cc"),
        *([] if knot.calls else [f"    tgco_{name}_bend(x, u, p, w, lam, H);"]),
        "}",
        f"static inline void tgco_{name}_along(",
        "    IN x, IN u, IN p, const double *w, IN z, OUT out) {",
        f"    V e[{max(1, len(places))}];",
        f"    tgco_{name}_slants(x, u, p, w, e);",
        f"    for (int j = 0; j < {knot.rows.numel()}; j++) out[j] = SET(0.0);",
        *(f"    ADD(out[{row}], e[{i}], z[{column}]);" for row, column, i in places),
        "}",
    ]
    return "\n".join(lines)


def _curves(name: str, inputs: list[Any], total: Any, tangents: calls.Ahead | None = None, slopes: Any = None) -> str:
    """`NAME(inputs, H)`: H += the second derivatives of `total` by the first two inputs, upper triangle.

    Args:
        tangents: of the calls of networks in `total`.
        slopes: a column that is to be written, too: `NAME(inputs, slopes, H)`.
    """
    import casadi as ca

    z, stages, size = ca.vertcat(*inputs[:2]), [], inputs[0].numel() + inputs[1].numel()
    if tangents is not None and tangents.calls:
        made = {symbol.element_hash() for call in tangents.calls for symbol in ca.symvar(call.outputs)}
        stages, hessian = tangents.hessian(total, lambda total, z: _hessian(total, z, ca.symvar(total), made))
    else:
        hessian = ca.sparsify(_hessian(total, z, inputs))
    nonzeros: list[Any] = hessian.nonzeros()
    rows, columns = hessian.sparsity().get_triplet()
    upper = [(i, j, entry) for i, j, entry in zip(rows, columns, nonzeros, strict=True) if j >= i]
    column = ca.cse(ca.densify(ca.vertcat(ca.SX(0, 1), *(entry for *_, entry in upper))))
    arguments = ", ".join(f"{emit.input_type(i)} in{i}" for i in range(len(inputs)))
    passed = ", ".join(f"in{i}" for i in range(len(inputs)))
    outputs = [column]
    if slopes is not None:
        arguments, passed, outputs = f"{arguments}, OUT f", f"{passed}, f", [slopes, column]
    entries = calls.emit_staged(f"{name}_entries", inputs, outputs, stages)
    written, places = f"out{len(outputs) - 1}", [i * size + j for i, j, _ in upper]
    # They are added where they are found: an array of all of them would be half of a step's stack.
    # The functions that write the outputs: stages before them have outputs of their own.
    begin = re.search(rf"^[\w ]+ void {name}_entries(_end)?(_piece_\d+)?\(", entries, re.MULTILINE)
    end = begin.start() if begin else 0
    added = re.sub(rf"\b{written}\[(\d+)\] =", lambda at: f"{written}[{places[int(at[1])]}] +=", entries[end:])
    head, call = f"TGCO_APART void {name}({arguments}, OUT H) {{", f"    {name}_entries({passed}, H);"
    return "\n".join([entries[:end] + added, head, call, "}"])


def _hessian(total: Any, z: Any, inputs: list[Any], made: Container[int] = ()) -> Any:
    """Second derivatives; by forward mode alone where reverse mode could give a NaN.

    `made` are inputs of one entry each that networks make, which may be infinite or NaN themselves.

    Reverse mode is shorter, by a factor of three for `QuadrotorPlant`, but lets a NaN of the branch not taken through
    as 0 * NaN.
    """
    import casadi as ca

    poles = {i for i, symbol in enumerate(inputs) if made and symbol.element_hash() in made}
    if not _has_hidden_pole(ca.Function("total", inputs, [total]), poles):
        return ca.hessian(total, z)[0]
    forward = {"allow_reverse": False}
    return ca.jacobian(ca.jacobian(total, z, forward).T, z, forward)


def _has_hidden_pole(function: Any, poles: Container[int] = ()) -> bool:
    """Whether an operation whose derivatives may be infinite, or one of the inputs `poles`, is needed by a branch
    alone, so that nothing else fails.

    A pole that is needed without any branch, too, makes the value itself infinite or NaN, in either mode.
    """
    code_of, (operations, needs) = emit.codes(), emit.instructions(function)
    smooth = {code_of[name] for name in SMOOTH_OPERATIONS}
    always, ever = (_reached(operations, needs, through) for through in (False, True))
    hidden = [(operations[i], function.instruction_input(i)) for i in ever - always]
    return any(what not in smooth or (what == code_of["INPUT"] and read[0] in poles) for what, read in hidden)


def _reached(operations: list[int], needs: list[list[int]], through: bool) -> set[int]:
    """The instructions that outputs need; those of branches, too, with `through`."""
    code_of = emit.codes()
    open_ = [i for i, operation in enumerate(operations) if operation == code_of["OUTPUT"]]
    reached = set(open_)
    while open_:
        i = open_.pop()
        branch = operations[i] == code_of["IF_ELSE_ZERO"] and not through
        for j in needs[i][:1] if branch else needs[i]:
            if j not in reached:
                reached.add(j)
                open_.append(j)
    return reached


def _push(model: DynamicsSource) -> str:
    """`model_push(f, z, out)`: out = F z."""
    lines = ["TGCO_BETWEEN_UNITS void model_push(IN ALONE f, IN ALONE z, OUT ALONE out) {"]
    lines.append("    for (int i = 0; i < NX; i++) out[i] = SET(0.0);")
    for row, column, index, value in zip(model.rows, model.columns, model.places, model.values, strict=True):
        factor = f"f[{index}]" if index >= 0 else f"SET({emit.literal(value)})"
        lines.append(f"    ADD(out[{row}], {factor}, z[{column}]);")
    return "\n".join([*lines, "}"])


def _switches(rows: Iterable[tuple[int, KnotSource]]) -> str:
    """`model_bend_rows` and `model_along_rows`, which call the functions of a constraint by its place."""
    models, alongs = [], []
    for i, source in rows:
        models.append(f"    case {i}: tgco_{source.key}_model(x, u, p, w, by, cc, lam, g, H); break;")
        alongs.append(f"    case {i}: tgco_{source.key}_along(x, u, p, w, z, out); break;")
    arguments = "int i, IN x, IN u, IN p, const double *w"
    of_model = f"TGCO_BETWEEN_UNITS void model_bend_rows({arguments},\n    IN by, IN cc, IN lam, OUTS g, OUT H)"
    along = f"TGCO_BETWEEN_UNITS void model_along_rows(\n    {arguments}, IN z, OUT out)"
    return f"{emit.switch(of_model, models)}\n{emit.switch(along, alongs)}"
