"""What a solution keeps of its solve, to explain it: the problem, the solver, and the times of the knots."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement, Rows
from torchgco.problem.problem import Problem
from torchgco.problem.times import times


class Account(PerElement):
    """The problem that was solved, and the solver; no dataclass, so that nothing is copied with a solution's tensors.

    Of a solution that was loaded or sent to another process, only the times of the knots and the kernels are left.

    Args:
        problem: as the user gave it.
        solver: that solved it.
        name: of the preset that the user named; None: the solver's class.
        rows: the problems (b,) of the account; None: all.
        t: times, where the problem isn't there.
        kernels: that solved: "native", "pytorch", or another library's name; None where that isn't known.
        smoothing: of the solution, in units of the cost.
    """

    def __init__(
        self,
        problem: Problem | None = None,
        solver: Any = None,
        name: str | None = None,
        rows: Tensor | None = None,
        t: Tensor | None = None,
        kernels: str | None = None,
        smoothing: float = 0.0,
    ) -> None:
        self._whole, self.solver, self._name, self._rows, self._t = problem, solver, name, rows, t
        self.kernels, self.smoothing = kernels, smoothing

    @property
    def problem(self) -> Problem | None:
        """The problems of the account; taken from the batch only when they are asked for."""
        return self._whole if self._whole is None or self._rows is None else self._whole.take(self._rows)

    @property
    def name(self) -> str | None:
        """What solved the problem; None where that isn't known."""
        return type(self.solver).__name__ if self._name is None and self.solver is not None else self._name

    def asked(self, problem: Problem, name: str | None) -> Account:
        """The same of the problem as the user gave it, and of a preset of this name; None: of no preset."""
        return Account(problem, self.solver, name, self._rows, self._t, self.kernels, self.smoothing)

    def smoothed(self, by: float) -> Account:
        """The same of the solution with a smoothing."""
        return Account(self._whole, self.solver, self._name, self._rows, self._t, self.kernels, by)

    def as_solved(self) -> Problem | None:
        """`problem`, where its numbers are still those that were solved for.

        Raises:
            InputError: they were changed in place since.
        """
        if self._whole is not None and self._whole.current() is not self._whole:
            expected = "a problem whose numbers are as they were solved: pass a copy of it as problem="
            raise InputError("solution", expected, "one whose numbers were changed in place since")
        return self.problem

    def times(self) -> Tensor:
        """The times of the knots, (N+1,) or (b, N+1), s.

        Raises:
            InputError: dynamics without a time step, no times in the file that was loaded, or changes in place since.
        """
        if self._whole is not None:
            self.as_solved()
            t = times(self._whole)
        elif self._t is not None:
            t = self._t
        else:
            raise InputError("solution", "one that knows its times: solved here, or saved with them", "a loaded one")
        return t if self._rows is None or t.dim() == 1 else t[self._rows]

    def take(self, index: Rows) -> Account:
        """The account of some problems."""
        if isinstance(index, slice):
            like = self._t if self._whole is None else self._whole.x0
            if self._rows is not None:
                rows = self._rows[index]
            elif like is None or like.dim() == 1:  # times alone, which all problems share
                rows = None
            else:
                rows = torch.arange(len(like), device=like.device)[index]
        else:
            index = index.nonzero().flatten() if index.dtype == torch.bool else index
            rows = index if self._rows is None else self._rows[index]
        return Account(self._whole, self.solver, self._name, rows, self._t, self.kernels, self.smoothing)

    def __getstate__(self) -> dict[str, Any]:
        """Times and name alone: a problem may hold functions that no other process can read."""
        try:
            t = self.times()
        except InputError:
            t = None
        return {"_whole": None, "solver": None, "_name": self.name, "_rows": None, "_t": t,
                "kernels": self.kernels, "smoothing": self.smoothing}  # fmt: skip
