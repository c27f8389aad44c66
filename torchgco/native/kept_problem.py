"""Problems whose numbers lie where C reads them, from call to call and from one inner solve to the next."""

from __future__ import annotations

import math

import numpy as np
import torch

from torchgco.base.status import Status
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.native import structures as c
from torchgco.native.engine import Engine, run
from torchgco.native.packing import Shared, constraint_of, is_bounded, kind_of, shared_fields
from torchgco.native.structures import Kind
from torchgco.problem.problem import Problem
from torchgco.tracing import own_tensors


class KeptProblem:
    """Problems packed once, with iterates of their own.

    Args:
        engine: of the problems' form.
        problem: what is kept. Numbers that C reads as they are, such as the references of a quadratic cost and the
            centres of spheres, are those of the problem's own tensors: written there in place, they count at once.

    Attributes:
        X, U, lam: iterates (B, N+1, n), (B, N, m), and multipliers of every constraint (B, K, p).
        packed: the structure that C reads.
    """

    def __init__(self, engine: Engine, problem: Problem) -> None:
        B, N, n, m, like = problem.B, problem.N, problem.n, problem.m, problem.x0
        self.engine, self.problem = engine, problem
        self._read: Shared | None = None  # what functions have captured, when C was last given it
        self.X, self.U = like.new_zeros(B, N + 1, n), like.new_zeros(B, N, m)
        self.lam = tuple(like.new_zeros(B, *shape) for shape in problem.row_shapes)
        self._numbers = [engine.row_numbers(problem, i) for i in range(len(problem.constraints))]
        parts = zip(problem.constraints, problem.row_shapes, self._numbers, strict=True)
        rows = [constraint_of(part, shape, N, kind_of(part), numbers) for part, shape, numbers in parts]
        for row, lam in zip(rows, self.lam, strict=True):
            row.lam = lam
        self.packed = c.Problem(N=N, constraints=len(rows), constraint=rows, **shared_fields(engine.shared))
        self._model, self._cost = engine.model_numbers(problem), engine.cost_numbers(problem)
        self.packed.fill({"parameters": self._model, "cost_data": self._cost, "X": self.X, "U": self.U})
        self._copied = {i: arrays for i in engine.functions if (arrays := self._copies(i)) is not None}

    @property
    def is_outdated(self) -> bool:
        """Whether tensors that functions capture may have other numbers than C."""
        captured = self.engine.captured
        return captured.is_mixed or not captured.is_still(self._read)

    def refresh_captured(self) -> bool:
        """Read what functions capture again; whether the library computes with it as it is now."""
        self._read = self.engine.captured.read()
        if self._read is None:
            return False
        self.engine.shared.take_over(self._read)
        # Some of these numbers may be a knot's own, and problems' own ones computed from what was captured.
        for i in self.engine.functions:
            self.refresh_constraint(i)
        self.refresh_cost()
        self.refresh_model()
        return True

    def refresh_constraint(self, i: int) -> None:
        """Read the numbers of constraint i again, after its tensors have changed."""
        if i in self._copied:
            there, here, places = self._copied[i]
            there[:] = here[:, places]
            return
        new = self.engine.row_numbers(self.problem, i)
        arrays = [name for name, value in new.items() if isinstance(value, c.Array)]
        _copy([self._numbers[i][name] for name in arrays], [new[name] for name in arrays])

    def refresh_cost(self) -> None:
        """The same of the cost."""
        _copy(self._cost, self.engine.cost_numbers(self.problem))

    def refresh_model(self) -> None:
        """The same of the dynamics."""
        _copy([self._model], [self.engine.model_numbers(self.problem)])

    def _copies(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Of traced rows all of whose numbers are some of one tensor's: where C reads them (B, K|1, count), the tensor
        (B, size), and their places in it; None of others.
        """
        picks, part = self.engine.functions[i].picks, self.problem.constraints[i]
        if picks is None or picks.numel() == 0 or kind_of(part) is not Kind.FUNCTION or part.row_radii is not None:
            return None
        first, every = 0, own_tensors(part)
        for own in (every[index] for index in self.engine.functions[i].span.traced.named):
            size = math.prod(own.shape[1:])
            if first <= int(picks.min()) and int(picks.max()) < first + size:
                (there,) = self._numbers[i]["bound"].kept
                fits = own.is_contiguous() and len(own) == self.problem.B == len(there) and own.dtype == torch.float64
                return (there.numpy(), own.reshape(len(own), -1).numpy(), (picks - first).numpy()) if fits else None
            first += size
        return None


def _copy(old: list[c.Array], new: list[c.Array]) -> None:
    """Write the numbers of arrays into the memory of others, which keep their places and shapes."""
    for before, after in zip(old, new, strict=True):
        for there, here in zip(before.kept, after.kept, strict=True):
            if there.data_ptr() != here.data_ptr():
                there.copy_(here)


ZEROED = "regularisation", "inner", "iterations", "rung", "status", "converged", "refused", "lost", "alpha", "used"
STATE_TYPES = {
    **dict.fromkeys(("inner", "iterations", "rung"), torch.int64),
    **dict.fromkeys(("status", "converged", "refused", "lost"), torch.int32),
}


class KeptDescent(KeptProblem):
    """Kept problems for inner solves: the same bits as `solvers.ilqr.descend`, which packs its problems again.

    Args:
        engine, problem: see `KeptProblem`.
        options: of the descent; phr: the form of inequalities' terms, as of a `Lagrangian`.
    """

    def __init__(self, engine: Engine, problem: Problem, options: c.Options, phr: bool) -> None:
        super().__init__(engine, problem)
        B, like = problem.B, problem.x0
        self.mu = like.new_zeros(B)
        names = ("cost", "merit", *ZEROED)
        state = {name: torch.zeros(B, dtype=STATE_TYPES.get(name, torch.float64)) for name in names}
        bounded = int(engine.cost is None and is_bounded(problem.cost))
        self.packed.fill({"mu": self.mu, "phr": phr, "bounded": bounded, "options": options, **state})
        self.packed.fill({"limit": options.max_iterations, "replicas": engine.replicas_of(B)})
        self.worst = like.new_zeros(B)
        self._measured = self.packed.fill({"merit": self.worst}, copied=True)
        # The same memory by NumPy, which takes a small share of PyTorch's time for a few numbers.
        self._x0, self._X, self._U = (tensor.numpy() for tensor in (problem.x0, self.X, self.U))
        self._lam, self._mu = [tensor.numpy() for tensor in self.lam], self.mu.numpy()
        self._state = {name: tensor.numpy() for name, tensor in state.items()}

    def solve(self, U: torch.Tensor, multipliers: Multipliers) -> bool:
        """One inner solve of every problem from controls U (B, N, m), into `X` and `U`.

        False where C can't make it alone, as rollouts diverge or aren't finite; `X` and `U` then hold nothing.
        """
        B, library, state = self.problem.B, self.engine.library, self._state
        self._X[:, 0], self._U[:], self._mu[:] = self._x0, U.numpy(), multipliers.mu.numpy()
        for target, lam in zip(self._lam, multipliers.lam, strict=True):
            target[:] = lam.numpy()
        for name in ZEROED:
            state[name][:] = 0
        run(library.tgco_open_loop, B, self.engine.lanes, self.packed)
        run(library.tgco_value, B, self.engine.lanes, self.packed)
        if not math.isfinite(state["merit"].sum() + self._X.sum()):  # what overflows is left to others, too
            return False
        run(library.tgco_ilqr, B, self.engine.lanes, self.packed)
        return not ((state["status"] == Status.RUNNING).any() or state["lost"].any())

    def violation(self) -> torch.Tensor:
        """The largest violation (B,) of `X` and `U`, of problems that the library `measures`."""
        run(self.engine.library.tgco_violation, self.problem.B, self.engine.lanes, self._measured)
        return self.worst.clone()
