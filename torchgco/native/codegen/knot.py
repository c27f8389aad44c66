"""The function of one knot, found in a traced function of whole trajectories: PyTorch code sees the shapes that it is
written for, and C works knot by knot.

Values that PyTorch computes from k (a reference for each knot, say) become the knot's own numbers. Where operations
differ from knot to knot, too, as in phases with a model each, every form of a knot has its own code, and the first of a
knot's numbers says which it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.native import store
from torchgco.native.codegen import emit
from torchgco.native.codegen.calls import key_of
from torchgco.native.codegen.dynamics import makers
from torchgco.tracing import Traced
from torchgco.tracing.arrays import elements
from torchgco.tracing.nets import Call


class JoinedKnots(InputError):
    """Code whose rows of a knot read other knots: no kernels serve it, as their derivatives are those of one knot."""


@dataclass(frozen=True)
class Span:
    """A traced function of X (1, states, n), U (1, controls, m) whose rows (1, K[, p]) belong to K `knots`."""

    traced: Traced
    n: int
    m: int
    states: int
    controls: int
    knots: Sequence[int]

    @cached_property
    def forms(self) -> tuple[list[Knot], list[list[int]]]:
        """The knots of the function, one for each form, and the places (K|1, count) of each knot's numbers.

        Found once: the code of values and slopes and that of second derivatives are made of them.
        """
        return _knots(self)


@dataclass(frozen=True)
class Knot:
    """CasADi expressions: rows (p) of x (n), u (m), a knot's numbers (count), and the numbers that all share.

    `calls` of networks have inputs of the same, and outputs that the rows depend on.
    """

    x: Any
    u: Any
    numbers: Any
    shared: Any
    rows: Any
    calls: Sequence[Call] = ()

    @property
    def inputs(self) -> list[Any]:
        """Of the functions that are made of it, in order."""
        return [self.x, self.u, self.numbers, self.shared]


@dataclass(frozen=True)
class KnotSource:
    """C of one knot's rows (size), and where its numbers come from.

    `places` (K|1, count) are the numbers' positions in a problem's own numbers followed by the constants of `span`, the
    numbers 0, 1, ... of the forms, where there are several, and the numbers that all problems share.
    """

    code: str
    key: str  # says what `code` computes, the same in every process and for every number of knots
    size: int
    forms: int  # of knots
    places: Tensor = field(compare=False)
    span: Span = field(repr=False, compare=False)

    @cached_property
    def _is_own(self) -> bool:
        """Whether some of the numbers differ from problem to problem."""
        return bool((self.places < self.span.traced.count).any())

    @cached_property
    def picks(self) -> Tensor | None:
        """Where each of a knot's numbers stands among those of a problem's own tensors, (K|1, count) int64.

        None where one of them is computed, or isn't a problem's own.
        """
        picks = self.span.traced.picks if self._is_own else None
        return None if picks is None or bool((self.places >= len(picks)).any()) else picks[self.places]

    def numbers(self, B: int, tensors: Sequence[Tensor], shared: Tensor, again: Callable[[], Span]) -> Tensor:
        """The numbers (B|1, K|1, count) of B problems of this form, whose own tensors are `tensors`.

        Args:
            shared: `Traced.shared_numbers`.
            again: traces these problems, where a new trace is needed.

        Raises:
            InputError: the problems have another function.
        """
        fixed = self._fixed(self.span.traced, shared)
        if not self._is_own:
            return fixed[self.places - self.span.traced.count].unsqueeze(0)
        traced = self.span.traced.rebound(tensors, B)
        if traced is None:
            traced = again().traced
            if traced.fingerprint() != self.span.traced.fingerprint():
                raise InputError(traced.field, "the same operations for all subsets of a batch", "others")
        count, fixed = traced.count, self._fixed(traced, shared)
        each = traced.parameters_of(torch.arange(B))[:, self.places.clamp(max=count - 1)]
        return torch.where(self.places < count, each, torch.cat((fixed.new_zeros(count), fixed))[self.places])

    def _fixed(self, traced: Traced, shared: Tensor) -> Tensor:
        """The numbers after a problem's own ones."""
        forms = torch.arange(self.forms if self.forms > 1 else 0, dtype=shared.dtype)
        return torch.cat((torch.from_numpy(traced.constants), forms, shared))


def knot_source(kind: str, span: Span, code_of: Callable[[Knot, str], str], *files: str) -> KnotSource:
    """The C that `code_of` makes of a knot and a name, taken from the cache folder if it was made before.

    Args:
        kind: the word of the key that names the kind of code.
        files: files on whose texts the code depends.

    Raises:
        InputError: an operation without a counterpart; rows that join knots, or whose operations differ between knots.
    """

    def parts_of(knots: Sequence[Knot], key: str) -> dict[str, Any]:
        if len(knots) > 1:
            raise InputError(span.traced.field, "the same operations at every knot", f"{len(knots)} forms of them")
        return {"code": code_of(knots[0], key)}

    return knot_parts(kind, span, parts_of, *files)[0]


def knot_parts(
    kind: str, span: Span, parts_of: Callable[[Sequence[Knot], str], dict[str, Any]], *files: str
) -> tuple[KnotSource, dict[str, Any]]:
    """`knot_source` of parts, of which "code" is one, of all forms of knots, and these parts."""
    shape = str((span.n, span.m, span.states, span.controls, list(span.knots)))

    def make() -> dict[str, Any]:
        knots, places = span.forms
        form: list[Any] = [span.n, span.m]
        for knot in knots:
            form += [*_form(_whole(knot))[0], *(key_of(call.net) for call in knot.calls)]
        name, size = store.key_of((kind, str(tuple(form)), *makers(__file__, *files)))[:16], knots[0].rows.numel()
        parts = {"name": name, "size": size, "forms": len(knots), "numbers_at": places}
        return {**parts_of(knots, name), **parts}

    key = kind, shape, span.traced.fingerprint(), *makers(__file__, *files)
    _, parts = store.made(key, make, f"{kind} {shape} {span.traced.kin}")
    emit.checked(span.traced.field, parts["code"])
    places = torch.tensor(parts["numbers_at"], dtype=torch.int64).reshape(len(parts["numbers_at"]), -1)
    return KnotSource(parts["code"], parts["name"], parts["size"], parts["forms"], places, span), parts


def _whole(knot: Knot) -> Any:
    """A knot as CasADi's function, with the inputs of its calls."""
    import casadi as ca

    made = [call.outputs for call in knot.calls]
    return ca.Function("knot", [*knot.inputs, *made], [knot.rows, *(call.inputs for call in knot.calls)])


@dataclass
class _Form:
    """Knots with the same operations: the first one's function, the numbers that it reads, and the calls in it."""

    function: Any
    reads: list[int]
    calls: list[Call]
    knots: list[int]  # among those of the span
    places: list[list[int]]  # of each: where the numbers that it uses come from
    used: list[int]  # of the numbers that the first one reads those that it uses

    def made(self, values: Sequence[Any], count: int, span: Span, w: Any) -> tuple[Knot, list[list[int]]]:
        """The form as one knot, and the places (K|1, count) of its knots' numbers.

        Args:
            values: of all numbers those that are the same in all problems.
            count: how many of them come first that are a problem's own.
        """
        import casadi as ca

        differ = [len(set(column)) > 1 for column in zip(*self.places, strict=True)]
        varying = [i for i, position in enumerate(self.places[0]) if position < count or differ[i]]
        x, u, p = ca.SX.sym("x", span.n), ca.SX.sym("u", span.m), ca.SX.sym("p", len(varying))
        values = list(values)
        for i, slot in enumerate(varying):
            values[self.places[0][slot]] = p[i]
        made = [ca.SX.sym(f"o{i}", call.net.size) for i, call in enumerate(self.calls)]
        read = ca.vertcat(ca.SX(0, 1), *(values[i] for i in self.reads))
        rows, *points = self.function.call([x, u, read, *made])
        chosen = [[used[i] for i in varying] for used in (self.places if any(differ) else self.places[:1])]
        found = [Call(call.net, point, out) for call, point, out in zip(self.calls, points, made, strict=True)]
        return Knot(x, u, p, w, rows, found), chosen


def _knots(span: Span) -> tuple[list[Knot], list[list[int]]]:
    """See `Span.forms`."""
    import casadi as ca

    traced, forms = span.traced, _forms(span)
    values: list[Any] = [0.0] * traced.count + traced.constants.tolist()
    w = ca.SX.sym("w", len(traced.pattern))
    values += [w[i] if np.isnan(value) else value for i, value in enumerate(traced.pattern.tolist())]
    made = [form.made(values, traced.count, span, w) for form in forms]
    if len(made) == 1:
        return [made[0][0]], made[0][1]
    first_shared, width = traced.count + len(traced.constants), max(len(rows[0]) for _, rows in made)
    places: list[list[int]] = [[] for _ in span.knots]
    for number, (form, (_, rows)) in enumerate(zip(forms, made, strict=True)):
        for i, row in zip(form.knots, rows if len(rows) > 1 else rows * len(form.knots), strict=True):
            moved = [slot if slot < first_shared else slot + len(forms) for slot in row]
            places[i] = [first_shared + number, *moved, *[first_shared] * (width - len(row))]
    return [knot for knot, _ in made], places


def _forms(span: Span) -> list[_Form]:
    """The forms of the knots of a traced function, in the order in which they are met."""
    import casadi as ca

    traced, count = span.traced, span.traced.count
    constants, pattern = traced.constants, traced.pattern
    first_shared = count + len(constants)
    # Of the same names at each knot: most knots then have the same text, and reading its instructions takes long.
    kinds = ("x", span.n, span.states), ("u", span.m, span.controls), ("p", 1, first_shared + len(pattern))
    X, U, numbers = ([ca.SX.sym(name, size) for _ in range(K)] for name, size, K in kinds)
    # All are symbols until it is known which ones differ: a 0 or 1 among them would change its knot's form.
    numbers = ca.vertcat(ca.SX(0, 1), *numbers)
    each, calls = elements(numbers), _Calls()
    found = traced(
        each[:count],
        elements(ca.vertcat(ca.SX(0, 1), *X)).reshape(1, span.states, span.n),
        elements(ca.vertcat(ca.SX(0, 1), *U)).reshape(1, span.controls, span.m),
        constants=each[count:first_shared],
        shared=each[first_shared:],
        calls=calls.all,
    ).reshape(len(span.knots), -1)
    u = ca.SX.sym("u", span.m)
    index = {number.element_hash(): i for i, number in enumerate(each)}
    texts: dict[str, tuple[list[tuple], list[int]]] = {}
    forms: dict[tuple, _Form] = {}
    columns, width = ca.densify(ca.vertcat(ca.SX(0, 1), *found.ravel())), found.shape[1]
    rows = ca.vertsplit(columns, width) if width else [columns] * len(found)
    for i, (k, column) in enumerate(zip(span.knots, rows, strict=True)):
        inside = calls.inside(column)
        results = [column, *(call.inputs for call in inside)]
        # Its own numbers alone: functions of those of all knots would together be as long as the horizon squared.
        reads = [index[name] for name in _names(*results) if name in index]
        inputs = [X[k], U[k] if k < span.controls else u, numbers[reads], *(call.outputs for call in inside)]
        function = ca.Function("knot", inputs, results, {"allow_free": True})
        if function.has_free():
            raise JoinedKnots(traced.field, "rows that read their own knot alone", f"rows of knot {k} that read others")
        text = function.serialize()
        if text not in texts:
            texts[text] = _form(function)
        operations, used = texts[text]
        key = (*operations, *(calls.key(call) for call in inside))
        form = forms.setdefault(key, _Form(function, reads, inside, [], [], used))
        form.knots.append(i)
        form.places.append([reads[i] for i in used])
    return list(forms.values())


class _Calls:
    """The calls of networks at all knots, and which of them one knot's rows need."""

    def __init__(self) -> None:
        self.all: list[Call] = []
        self._owners: dict[int, int] = {}  # the call that makes a symbol
        self._keys: dict[int, str] = {}

    def inside(self, rows: Any) -> list[Call]:
        """The calls that rows depend on, be it through other calls, in order."""

        if not self._owners:
            self._owners = {name: i for i, call in enumerate(self.all) for name in _names(call.outputs)}
        places, open_ = set(), [rows] if self.all else []
        while open_:
            read = {self._owners[name] for name in _names(open_.pop()) if name in self._owners} - places
            places |= read
            open_ += [self.all[i].inputs for i in read]
        return [self.all[i] for i in sorted(places)]

    def key(self, call: Call) -> str:
        """What a call computes."""
        if id(call.net) not in self._keys:
            self._keys[id(call.net)] = key_of(call.net)
        return self._keys[id(call.net)]


def _names(*expressions: Any) -> list[int]:
    """The symbols of some expressions."""
    import casadi as ca

    read = ca.symvar(expressions[0] if len(expressions) == 1 else ca.vertcat(*expressions))
    return [symbol.element_hash() for symbol in read]


def _form(function: Any) -> tuple[list[tuple], list[int]]:
    """The instructions of a function (x, u, numbers), its numbers renamed in order of first use, and that order."""
    reads, holds = (emit.codes()[name] for name in ("INPUT", "CONST"))
    turn: dict[int, int] = {}
    form: list[tuple] = []
    for i in range(function.n_instructions()):
        operation, read = function.instruction_id(i), tuple(function.instruction_input(i))
        if operation == reads and read[0] == 2:
            read = (2, turn.setdefault(read[1], len(turn)))
        constant = function.instruction_constant(i) if operation == holds else 0.0
        form.append((operation, read, tuple(function.instruction_output(i)), np.float64(constant).tobytes()))
    return form, list(turn)
