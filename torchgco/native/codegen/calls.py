"""Expressions with calls in them, of networks and of roots of equations: their derivatives, and their C.

Between the calls lie expressions of scalars. C computes the inputs of a call, then the call, and so on; what a call
gives (outputs, tangents, products with its Jacobian, second derivatives) are symbols in all that comes after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torchgco.base.errors import InputError
from torchgco.native.codegen import emit
from torchgco.native.codegen.layers import NetSource
from torchgco.native.codegen.roots import Back, Newton, Slopes
from torchgco.tracing.nets import Call
from torchgco.tracing.roots import Root

MOST_KEPT = 4_000_000  # bytes of the stack that the calls of a function may take


@dataclass(frozen=True)
class NetStage:
    """A function of a network in C: CasADi's columns of what it reads, expressions, and writes, symbols."""

    source: NetSource
    inputs: Any
    outputs: Any
    ahead: int | None  # of a product with the transposed Jacobian: the stage that went before it

    @property
    def reads(self) -> Any:
        return self.inputs

    @property
    def kept_bytes(self) -> int:
        return self.source.kept_bytes if self.ahead is None else 0

    def helpers(self, name: str, symbols: Sequence[Any]) -> list[str]:
        return [self.source.code, emit.function(name, symbols, self.inputs)]

    def lines(self, name: str, i: int, passed: str) -> list[str]:
        declared = [f"V a{i}[{self.inputs.numel()}], b{i}[{self.outputs.numel()}];", f"{name}({passed}, a{i});"]
        key, w = self.source.key, f"in{emit.SHARED_AT}"
        if self.ahead is not None:
            to = f"b{i}, b{i} + {self.source.net.k}"
            return [*declared, f"tgco_net_{key}_back({w}, kept{self.ahead}, a{i}, {to});"]
        if not self.source.d:
            return [*declared, f"tgco_net_{key}({w}, a{i}, b{i});"]
        tangents = "0" if self.source.plain else f"a{i} + {self.source.net.k}"
        called = f"tgco_net_{key}_ahead({w}, a{i}, {tangents}, b{i}, b{i} + {self.source.net.size}, kept{i});"
        return [*declared, f"tgco_net_{key}_kept kept{i}[1];", called]


Stage = NetStage | Newton | Slopes | Back


class Ahead:
    """Calls with their tangents along the columns of `z`, a column of symbols.

    A call whose inputs don't depend on z has none.
    """

    def __init__(self, calls: Sequence[Call], z: Any) -> None:
        import casadi as ca

        self.z, self.calls = z, calls
        self.stages: list[Stage] = []
        self.columns: list[list[int]] = []  # of z, on which each call's inputs depend
        self.slopes: list[Any] = []  # of each call's outputs by z
        self._places: list[int] = []  # of each call's first stage
        for i, call in enumerate(calls):
            of_inputs = self.jacobian(_residual(call))
            columns, plain = _columns(of_inputs)
            tangents = ca.SX.sym(f"t{i}", call.outputs.numel(), len(columns))
            slopes = ca.SX(call.outputs.numel(), z.numel())
            if columns:
                slopes[:, columns] = tangents
            self._places.append(len(self.stages))
            along = ca.densify(ca.vec(of_inputs[:, columns]))
            if isinstance(call.net, Root):
                self.stages.append(Newton(call, derived=True))
                self.stages.append(Slopes(self._places[-1], call.net.size, along, ca.vec(tangents)))
            else:
                inputs = call.inputs if plain else ca.vertcat(call.inputs, along)
                source = NetSource(call.net, len(columns), plain)
                self.stages.append(NetStage(source, inputs, ca.vertcat(call.outputs, ca.vec(tangents)), None))
            self.columns.append(columns)
            self.slopes.append(slopes)

    def jacobian(self, expression: Any) -> Any:
        """Derivatives of a column by z, through all calls so far.

        By forward mode alone: reverse mode would let a NaN of the branch not taken through as 0 * NaN.
        """
        import casadi as ca

        forward = {"allow_reverse": False}
        total = ca.jacobian(expression, self.z, forward)
        for call, slopes in zip(self.calls, self.slopes, strict=False):
            through = ca.sparsify(ca.jacobian(expression, call.outputs, forward))
            if through.nnz():
                total += _product(through, slopes)
        return ca.sparsify(total)

    def hessian(self, total: Any, second: Callable[[Any, Any], Any]) -> tuple[list[Stage], Any]:
        """Second derivatives of a scalar by z, and the stages that they need.

        Args:
            second: second derivatives of a scalar by a column, calls left aside.
        """
        import casadi as ca

        stages, bent = list(self.stages), ca.SX(self.z.numel(), self.z.numel())
        for i in reversed(range(len(self.calls))):
            call, columns = self.calls[i], self.columns[i]
            by = ca.densify(ca.jacobian(total, call.outputs, {"allow_reverse": False})).T
            if not columns or by.is_zero():
                continue
            if isinstance(call.net, Root):
                multipliers = ca.SX.sym(f"v{i}", call.net.size)
                stages.append(Back(self._places[i], call.net.size, by, multipliers))
                total += _product(multipliers.T, _residual(call), chooses(by))
                continue
            back = ca.SX.sym(f"v{i}", call.inputs.numel())
            upper = ca.SX.sym(f"h{i}", len(columns) * (len(columns) + 1) // 2)
            ahead = self.stages[self._places[i]]
            assert isinstance(ahead, NetStage)
            stages.append(NetStage(ahead.source, by, ca.vertcat(back, upper), self._places[i]))
            pairs = [(p, q) for first, p in enumerate(columns) for q in columns[first:]]
            for (p, q), entry in zip(pairs, ca.vertsplit(upper), strict=True):
                bent[p, q] += entry
                if p != q:
                    bent[q, p] += entry
            total += _product(back.T, call.inputs, chooses(by))
        symbols = [self.z, *(call.outputs for call in self.calls)]
        along = ca.vertcat(ca.SX.eye(self.z.numel()), *self.slopes)
        inner = ca.sparsify(second(total, ca.vertcat(*symbols)))
        chosen = chooses(inner)
        return stages, ca.sparsify(bent + _product(_product(inner, along, chosen).T, along, chosen))


def chooses(expression: Any) -> bool:
    """Whether an expression drops the branch of a choice that isn't taken."""
    import casadi as ca

    function = ca.Function("chosen", ca.symvar(expression), [expression])
    return any(function.instruction_id(i) == ca.OP_IF_ELSE_ZERO for i in range(function.n_instructions()))


def _product(factors: Any, columns: Any, chosen: bool | None = None) -> Any:
    """The product of two matrices, to which a factor that is 0 adds 0 where factors are `chosen`, as by default they
    are if they have choices in them: what such a factor drops may be infinite or NaN.
    """
    import casadi as ca

    if not (chooses(factors) if chosen is None else chosen):
        return ca.mtimes(factors, columns)
    product = ca.SX(factors.size1(), columns.size2())
    for i, j, factor in zip(*factors.sparsity().get_triplet(), factors.nonzeros(), strict=True):
        product[i, :] += ca.if_else(factor, factor * columns[j, :], 0)
    return ca.sparsify(product)


def _columns(of_inputs: Any) -> tuple[list[int], bool]:
    """The columns in which a Jacobian isn't zero; and whether it is the unit matrix there, in this order."""
    rows, columns = of_inputs.sparsity().get_triplet()
    ones = all(entry.is_one() for entry in of_inputs.nonzeros())
    if ones and sorted(rows) == list(range(of_inputs.size1())) and len(set(columns)) == len(columns):
        return [column for _, column in sorted(zip(rows, columns, strict=True))], True
    return sorted(set(columns)), False


def _residual(call: Call) -> Any:
    """What a call's outputs depend on: a network's inputs, or an equation's residual."""
    return call.inputs[: call.net.size] if isinstance(call.net, Root) else call.inputs


def key_of(net: Any) -> str:
    """What a call computes of its inputs."""
    return f"root of {net.size}" if isinstance(net, Root) else NetSource(net, 0).key


def values(calls: Sequence[Call]) -> list[Stage]:
    """Calls without derivatives."""
    return [
        Newton(call, derived=False)
        if isinstance(call.net, Root)
        else NetStage(NetSource(call.net, 0), call.inputs, call.outputs, None)
        for call in calls
    ]


def emit_staged(name: str, inputs: Sequence[Any], outputs: Sequence[Any], stages: Sequence[Stage]) -> str:
    """`emit` of columns of expressions, which may depend on what the stages write.

    Raises:
        InputError: the networks' derivatives take too much memory.
    """
    import casadi as ca

    kept = _needed(stages, ca.vertcat(*outputs))
    if not kept:
        return emit.emit(name, ca.Function(name, [*inputs], [*outputs]), emit.SHARED_AT)
    if (kept_bytes := sum(stages[i].kept_bytes for i in kept)) > MOST_KEPT:
        raise InputError("networks", f"derivatives of at most {MOST_KEPT} bytes in native kernels", kept_bytes)
    arguments = ", ".join(f"{emit.input_type(i)} in{i}" for i in range(len(inputs)))
    passed = ", ".join(f"in{i}" for i in range(len(inputs)))
    helpers, lines, symbols = [], [], [*inputs]
    for i in kept:
        stage = stages[i]
        helpers += stage.helpers(f"{name}_{i}", symbols)
        lines += [f"    {line}" for line in stage.lines(f"{name}_{i}", i, passed)]
        symbols, passed = [*symbols, stage.outputs], f"{passed}, b{i}"
    helpers.append(emit.emit(f"{name}_end", ca.Function(name, symbols, [*outputs]), emit.SHARED_AT))
    lines.append(f"    {name}_end({passed}, {', '.join(f'out{i}' for i in range(len(outputs)))});")
    written = ", ".join(f"OUT ALONE out{i}" for i in range(len(outputs)))
    head = f"TGCO_APART void {name}({arguments}, {written}) {{"
    return "\n".join([*dict.fromkeys(helpers), head, *lines, "}\n"])


def _needed(stages: Sequence[Stage], outputs: Any) -> list[int]:
    """The stages that an expression depends on."""
    import casadi as ca

    wanted, kept = {symbol.element_hash() for symbol in ca.symvar(outputs)}, set()
    for i in reversed(range(len(stages))):
        stage = stages[i]
        if i in kept or not wanted.isdisjoint(symbol.element_hash() for symbol in ca.symvar(stage.outputs)):
            kept.add(i)
            wanted |= {symbol.element_hash() for symbol in ca.symvar(stage.reads)}
            if stage.ahead is not None:
                kept.add(stage.ahead)
    return sorted(kept)
