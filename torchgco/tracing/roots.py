"""Roots of equations in a recorded function (`base.roots.root`): each row's stays whole, as a network does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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

    def take(
        self, operation: Operation, known: dict[Slot, Any], guesses: dict[Slot, np.ndarray], calls: list[Call]
    ) -> None:
        """Add an unknown's symbols to `known`, or an equation's calls to `calls`, one a row.

        Args:
            guesses: of unknowns whose equations come later.

        Raises:
            NoCounterpart: an equation that reads the unknowns of another one.
        """
        import casadi as ca

        (made,), (first, *rest) = operation.outputs, operation.inputs
        if self._operations[id(operation)] == UNKNOWN:
            guess = boxed(known[first])
            symbol = np.frompyfunc(lambda i: ca.SX.sym(f"z{i}"), 1, 1)
            guesses[made], known[made] = guess, symbol(np.arange(guess.size)).reshape(guess.shape)
            return
        guess, unknown, residual = guesses.pop(first), known[first], boxed(known[rest[0]])
        if guesses:
            raise NoCounterpart("an equation that reads the unknowns of another one")
        size = guess.shape[-1]
        for z, r, start in zip(*(a.reshape(-1, size) for a in (unknown, residual, guess)), strict=True):
            calls.append(Call(Root(size), ca.densify(ca.SX(ca.vertcat(*r, *start))), ca.vertcat(*z)))
        known[made] = unknown
