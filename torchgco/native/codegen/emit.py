"""C over vectors whose lanes are problems, from the instructions of a CasADi function of scalar expressions.

A file that holds such code defines REAL (double or float) and LANES (a power of two), and includes functions.h.
No operation mixes lanes: a problem's bits don't depend on the content of other lanes. Products and sums are fused where
the code says so alone (lanes.h), never by the compiler.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from torchgco.base.errors import InputError

if TYPE_CHECKING:
    import casadi as ca

MOST_LINES = 150_000  # compiled in some three minutes
LONG, PIECE = 2000, 500  # statements of a function that is cut into pieces, and of each of these, about
# Functions of functions.h, on each lane.
_OF_ONE = (
    "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh",
    "acosh", "atanh", "erf", "sqrt", "floor", "ceil", "fabs", "sign",
)  # fmt: skip
_OF_TWO = ("pow", "fmod", "atan2", "hypot", "copysign")


NUMBERS_AT = 2  # of the functions of a model, a cost, a constraint: the input with a knot's own numbers p
SHARED_AT = 3  # of the functions of a model, a cost, a constraint: the input with the numbers that all problems share


def emit(name: str, function: ca.Function, shared: int | None = None) -> str:
    """`static inline void NAME(IN ALONE in0, ..., OUT ALONE out0, ...)`, as straight-line code; see pointers.h.

    An input is an array of its entries, an output one of its nonzeros in the order of its sparsity; outputs overlap
    nothing else. A choice ignores the branch not taken, NaN included. Minimum and maximum are PyTorch's: NaN where one
    of the two numbers is. The remainder stands for rounding to single precision (`tracing.operations.to_single`).

    Args:
        name: of the C function.
        function: of scalar expressions (SX).
        shared: the place of an input that is the same in all lanes, `const double *restrict`; None: there is none.

    Raises:
        ValueError: `function` isn't an SX function, or holds an operation without a counterpart in C.
    """
    if not function.is_a("SXFunction"):
        raise ValueError(f"{name}: expected a CasADi function of scalar expressions, got {function.class_name()}")
    arguments = [f"{input_type(i, shared)} in{i}" for i in range(function.n_in())]
    arguments += [f"OUT ALONE out{i}" for i in range(function.n_out())]
    statements, size = _statements(function, shared)
    head = f"static inline void {name}({', '.join(arguments)}) {{"
    if len(statements) <= LONG:
        return "\n".join([head, "\n".join(_body(statements, range(size))), "}\n"])
    pieces = _pieces(name, arguments, statements, size)
    passed = ", ".join(argument.split()[-1] for argument in arguments)
    calls = (f"    {name}_piece_{i}({passed}, kept);" for i in range(len(pieces)))
    return "\n".join([*pieces, head, f"    V kept[{size}];", *calls, "}\n"])


def _body(statements: Sequence[_Statement], variables: Iterable[int]) -> list[str]:
    work = ", ".join(f"w{i}" for i in variables)
    return [f"    {line}" for line in (*([f"V {work};"] if work else []), *(each.text for each in statements))]


def _pieces(name: str, arguments: Sequence[str], statements: Sequence[_Statement], size: int) -> list[str]:
    """Functions of some statements each, in order; variables that later ones read are kept in an array between them.

    To find registers for a function, gcc takes a time that grows faster than its length.
    """
    edges = np.linspace(0, len(statements), 1 + math.ceil(len(statements) / PIECE)).astype(int)
    spans = [statements[a:b] for a, b in pairwise(edges)]
    reads, live, pieces = [_read_first(span) for span in spans], set[int](), list[str]()
    for i in reversed(range(len(spans))):
        made = {each.writes for each in spans[i] if each.writes is not None}
        text = [f"TGCO_APART void {name}_piece_{i}({', '.join(arguments)}, OUT ALONE kept) {{"]
        loads = [_Statement(f"w{j} = kept[{j}];") for j in sorted(reads[i])]
        text += _body([*loads, *spans[i]], sorted(made | reads[i]))
        text += [f"    kept[{j}] = w{j};" for j in sorted(made & live)]
        pieces.append("\n".join([*text, "}"]))
        live = reads[i] | live - made
    return pieces[::-1]


def whole(code: str) -> str:
    """The code with functions in pieces made whole again, for small stacks: those have no room for what is kept."""
    lines, body, inside = list[str](), list[str](), False
    for line in code.split("\n"):
        if line.startswith("TGCO_APART") and "_piece_" in line:
            inside = True
        elif inside and line == "}":
            inside = False
        elif inside:
            body += [] if "kept[" in line or line.startswith("    V ") else [line]
        elif line.startswith("    V kept["):
            lines += [*_body((), range(int(line[11:-2]))), *body]
            body = []
        elif not line.endswith(", kept);"):
            lines.append(line)
    return "\n".join(lines)


def _read_first(statements: Sequence[_Statement]) -> set[int]:
    """The variables that are read before they are written."""
    read, written = set[int](), set[int | None]()
    for each in statements:
        read |= {variable for variable in each.reads if variable not in written}
        written.add(each.writes)
    return read


def function(name: str, inputs: Sequence[Any], *outputs: Any) -> str:
    """`emit` of CasADi's columns of inputs, symbols, and outputs, one array each."""
    import casadi

    return emit(name, casadi.Function("f", [*inputs], [casadi.cse(casadi.densify(o)) for o in outputs]), SHARED_AT)


def input_type(i: int, shared: int | None = SHARED_AT) -> str:
    """The type of input i, a pointer's up to the name."""
    return "const double *restrict" if i == shared else "IN ALONE"


def checked(field: str, code: str) -> str:
    """The code of a function of the user's, `field`.

    Raises:
        InputError: it would take minutes to compile.
    """
    lines = code.count("\n")
    if lines > MOST_LINES:
        raise InputError(field, f"a function that native kernels hold in {MOST_LINES} lines of C", f"{lines} lines")
    return code


@dataclass(frozen=True)
class _Statement:
    """A line of C, the numbers of the variables w that it reads, and of that which it writes; None: an output."""

    text: str
    reads: Sequence[int] = ()
    writes: int | None = None


def _statements(function: ca.Function, shared: int | None) -> tuple[list[_Statement], int]:
    """One for each instruction but for products that a sum takes, and how many variables w they have."""
    operations, reads = instructions(function)
    sums = _sums(operations, reads)
    taken = {product for product, *_ in sums.values()}
    needs = [list(sums[k][2]) if k in sums else read for k, read in enumerate(reads)]
    last = {read: k for k, read_by in enumerate(needs) if k not in taken for read in read_by}
    lines, variables, free, size = list[_Statement](), dict[int, int](), list[int](), 0
    for k, read in enumerate(needs):
        if k in taken:
            continue
        of = [variables[j] for j in read]
        operands = [f"w{variable}" for variable in of]
        free += [variables.pop(j) for j in dict.fromkeys(read) if last[j] == k]
        if operations[k] == codes()["OUTPUT"]:
            output, entry = function.instruction_output(k)
            lines.append(_Statement(f"out{output}[{entry}] = {operands[0]};", of))
            continue
        value = sums[k][1].format(*operands) if k in sums else _value(function, k, operands, shared)
        if not free:
            free.append(size)
            size += 1
        variables[k] = free.pop()
        lines.append(_Statement(f"w{variables[k]} = {value};", of, variables[k]))
    return lines, size


def instructions(function: ca.Function) -> tuple[list[int], list[list[int]]]:
    """The operations of all instructions, and the instructions that have made what each of them reads."""
    code_of, operations, reads = codes(), [], []
    written: dict[int, int] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        leaf = operation in (code_of["INPUT"], code_of["CONST"])
        operations.append(operation)
        reads.append([] if leaf else [written[variable] for variable in function.instruction_input(k)])
        if operation != code_of["OUTPUT"]:
            written[function.instruction_output(k)[0]] = k
    return operations, reads


def _sums(operations: list[int], reads: list[list[int]]) -> dict[int, tuple[int, str, list[int]]]:
    """Sums and differences that take a product nobody else reads, which is rounded once with them: the product's
    instruction, and text and operands of both together.
    """
    code_of, uses = codes(), Counter(j for read in reads for j in read)
    sums: dict[int, tuple[int, str, list[int]]] = {}
    for k, operation in enumerate(operations):
        if operation not in (code_of["ADD"], code_of["SUB"]):
            continue
        for side, other in ((1, 0), (0, 1)):
            product, rest = reads[k][side], reads[k][other]
            if operations[product] not in (code_of["MUL"], code_of["SQ"]) or uses[product] > 1:
                continue
            signs = ("", "") if operation == code_of["ADD"] else ("-", "") if side else ("", "-")
            factors = (reads[product] * 2)[:2]
            sums[k] = product, f"tgco_fused({signs[0]}{{0}}, {{1}}, {signs[1]}{{2}})", [*factors, rest]
            break
    return sums


def _value(function: ca.Function, k: int, read: list[str], shared: int | None) -> str:
    """What an instruction makes of the variables that it reads."""
    code_of, operation = codes(), function.instruction_id(k)
    if operation == code_of["INPUT"]:
        argument, entry = function.instruction_input(k)
        value = f"in{argument}[{entry}]"
        return f"SET({value})" if argument == shared else value
    if operation == code_of["CONST"]:
        return f"SET({literal(function.instruction_constant(k))})"
    if operation in _templates():
        return _templates()[operation].format(*read)
    (meant,) = (word for word, code in code_of.items() if code == operation)
    raise ValueError(f"{function.name()}: no counterpart in C for CasADi's operation {meant}")


def switch(head: str, cases: Iterable[str], *end: str) -> str:
    """A function of C that chooses by its argument i."""
    return "\n".join((f"{head} {{", "    switch (i) {", *cases, "    }", *end, "}"))


def by_form(name: str, forms: int, inputs: int, outputs: int) -> str:
    """`NAME`, which calls `NAME_0`, `NAME_1`, ...: of the form that the first of the numbers p says, without it.

    Problems side by side are at the same knot, and so of the same form.
    """
    arguments = [f"{input_type(i)} in{i}" for i in range(inputs)] + [f"OUT out{i}" for i in range(outputs)]
    passed = [f"in{i}{' + 1' if i == NUMBERS_AT else ''}" for i in range(inputs)] + [f"out{i}" for i in range(outputs)]
    cases = [f"    case {i}: {name}_{i}({', '.join(passed)}); break;" for i in range(forms)]
    head = f"TGCO_APART void {name}({', '.join(arguments)})"
    return "\n".join([f"{head} {{", f"    switch ((int)LANE(in{NUMBERS_AT}[0], 0)) {{", *cases, "    }", "}"])


def literal(value: float) -> str:
    """A number as a literal of C, exact to the last bit."""
    if math.isfinite(value):
        return float(value).hex()
    return "NAN" if math.isnan(value) else f"{'-' if value < 0 else ''}INFINITY"


_OPERATORS = {
    "ASSIGN": "{0}", "LIFT": "{0}", "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}",
    "NEG": "-{0}", "SQ": "{0} * {0}", "TWICE": "{0} + {0}", "INV": "SET(1.0) / {0}",
    "LT": "tgco_truth({0} < {1})", "LE": "tgco_truth({0} <= {1})", "EQ": "tgco_truth({0} == {1})",
    "NE": "tgco_truth({0} != {1})", "NOT": "tgco_truth(NOT(tgco_is({0})))",
    "AND": "tgco_truth(tgco_is({0}) & tgco_is({1}))", "OR": "tgco_truth(tgco_is({0}) | tgco_is({1}))",
    "IF_ELSE_ZERO": "tgco_if(tgco_is({0}), {1})", "CONSTPOW": "tgco_pow({0}, {1})",
    "FMIN": "tgco_minimum({0}, {1})", "FMAX": "tgco_maximum({0}, {1})", "REMAINDER": "tgco_single({0})",
    **{name.upper(): f"tgco_{name}({{0}})" for name in _OF_ONE},
    **{name.upper(): f"tgco_{name}({{0}}, {{1}})" for name in _OF_TWO},
}  # fmt: skip


@cache
def codes() -> dict[str, int]:
    """CasADi's numbers for operations."""
    import casadi

    return {name.removeprefix("OP_"): getattr(casadi, name) for name in dir(casadi) if name.startswith("OP_")}


@cache
def _templates() -> dict[Any, str]:
    return {code: _OPERATORS[name] for name, code in codes().items() if name in _OPERATORS}
