"""Roots of equations in a recorded function (`base.roots.root`): each row's stays whole, as a network does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchgco.base.roots import SOLVED, UNKNOWN
from torchgco.tracing.arrays import NoCounterpart, boxed
from torchgco.tracing.nets import Call
from torchgco.tracing.recorder import Operation, Slot, name_of


@dataclass(frozen=True)
class Root:
    """An equation of `size` unknowns, in the place of a network in a `Call`.

    The call's outputs are the unknowns, its inputs their residual, which reads them, and then their guess.
    """

    size: int


class Roots:
    """The roots among the operations that depend on a function's variables.

    They stay whole: their values and derivatives are Newton's method's and the implicit function theorem's.
    """

    def __init__(self, operations: Sequence[Operation]) -> None:
        self._operations = {id(operation): name_of(operation.function) for operation in operations}
        self._operations = {key: name for key, name in self._operations.items() if name in (UNKNOWN, SOLVED)}

    def __bool__(self) -> bool:
        return bool(self._operations)

    def __contains__(self, operation: Operation) -> bool:
        return id(operation) in self._operations

    def take(self, operation: Operation, known: dict[Slot, Any], equations: Equations, calls: list[Call]) -> None:
        """Add an unknown's symbols to `known`, or an equation's calls to `calls`, one a row.

        Raises:
            NoCounterpart: an equation within another one with other rows.
        """
        import casadi as ca

        (made,), (first, *rest) = operation.outputs, operation.inputs
        if self._operations[id(operation)] == UNKNOWN:
            guess = boxed(known[first])
            symbol = np.frompyfunc(lambda i: ca.SX.sym(f"z{i}"), 1, 1)
            equations.guesses[made], known[made] = guess, symbol(np.arange(guess.size)).reshape(guess.shape)
            return
        guess, known[made] = equations.guesses.pop(first), known[first]
        equations.closed.append((known[first], boxed(known[rest[0]]), guess))
        if equations.guesses:
            return  # it is within another one, whose unknowns are found together with its own
        if len({unknown.shape[:-1] for unknown, *_ in equations.closed}) > 1:
            raise NoCounterpart("an equation within another one that has other rows")
        unknown, residual, guess = (
            np.concatenate(arrays, axis=-1).reshape(-1, sum(a.shape[-1] for a in arrays))
            for arrays in zip(*equations.closed, strict=True)
        )
        equations.closed.clear()
        for z, r, start in zip(unknown, residual, guess, strict=True):
            calls.append(Call(Root(len(z)), ca.densify(ca.SX(ca.vertcat(*r, *start))), ca.vertcat(*z)))


@dataclass
class Equations:
    """Where a replay is: the guesses of unknowns whose equations are still to come, and equations, (unknowns, residual,
    guess) each, within the one that is.
    """

    guesses: dict[Slot, np.ndarray] = field(default_factory=dict)
    closed: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
