"""C of the roots of equations within a function, by Newton's method (c/newton.h), and of their derivatives.

Of the residual r(z, y) with slopes A = r_z the implicit function z(y) has the slopes -A^-1 r_y, and a total t(z, y) the
second derivatives, along these, of t + v' r with the multipliers v = -A'^-1 t_z: Griewank and Walther, Evaluating
Derivatives, chapter 15.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from torchgco.native.codegen import emit
from torchgco.tracing.nets import Call


class Newton:
    """The unknowns of an equation; `derived`: and A, factored, for the stages that follow."""

    ahead: ClassVar[int | None] = None

    def __init__(self, call: Call, derived: bool) -> None:
        import casadi as ca

        self._size, self.outputs, self._derived = call.net.size, call.outputs, derived
        self._residual, self._guess = ca.vertsplit(call.inputs, self._size)
        slopes = ca.jacobian(self._residual, self.outputs, {"allow_reverse": False})
        self._slopes = ca.densify(ca.vec(slopes.T))  # row by row
        self.reads = ca.vertcat(self._guess, self._residual, self._slopes)

    @property
    def kept_bytes(self) -> int:
        """What it takes on the stack, of eight problems side by side."""
        return 8 * 8 * self._size * (4 * self._size + 5)

    def helpers(self, name: str, symbols: Sequence[Any]) -> list[str]:
        equation = emit.function(f"{name}_equation", [*symbols, self.outputs], self._residual, self._slopes)
        return ['#include "newton.h"', emit.function(f"{name}_guess", symbols, self._guess), equation]

    def lines(self, name: str, i: int, passed: str) -> list[str]:
        q, work = self._size, f"step{i}, further{i}, r{i}, A{i}, turns{i}, F{i}, F_turns{i}"
        lines = [
            f"V b{i}[{q}], trial{i}[{q}], step{i}[{q}], further{i}[{q}], r{i}[{q}], A{i}[{q * q}], F{i}[{q * q}];",
            f"I turns{i}[{q * q}], F_turns{i}[{q * q}];",
            f"{name}_guess({passed}, trial{i});",
            f"newton_state newton{i} = newton_begin({q}, trial{i}, b{i}, step{i});",
            f"do {name}_equation({passed}, trial{i}, r{i}, A{i});",
            f"while (newton_next(&newton{i}, {q}, b{i}, trial{i}, {work}));",
        ]
        if self._derived:
            lines.append(f"{name}_equation({passed}, b{i}, r{i}, A{i});")
            lines.append(f"const I *turned{i} = newton_factor({q}, A{i}, turns{i}) ? turns{i} : NULL;")
        return lines


class _Solved:
    """-A^-1 or -A'^-1 times some columns, after the stage `ahead` that has found the root."""

    function: ClassVar[str]
    kept_bytes: ClassVar[int] = 0

    def __init__(self, ahead: int, size: int, inputs: Any, outputs: Any) -> None:
        self.ahead, self._size, self.inputs, self.outputs = ahead, size, inputs, outputs

    @property
    def reads(self) -> Any:
        return self.inputs

    def helpers(self, name: str, symbols: Sequence[Any]) -> list[str]:
        return [emit.function(name, symbols, self.inputs)]

    def lines(self, name: str, i: int, passed: str) -> list[str]:
        count, q = self.inputs.numel(), self._size
        solve = f"{self.function}({q}, {count // q}, A{self.ahead}, turned{self.ahead}, a{i}, b{i});"
        return [f"V a{i}[{max(1, count)}], b{i}[{max(1, count)}];", f"{name}({passed}, a{i});", solve]


class Slopes(_Solved):
    """The slopes of the unknowns, from those of the residual."""

    function = "newton_slopes"


class Back(_Solved):
    """The multipliers v, from the slopes of a total by the unknowns."""

    function = "newton_back"
