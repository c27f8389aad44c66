"""Kernels in C for float64 on a CPU: functions traced and compiled, several problems side by side."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.eager.sampling import Sampling
from torchgco.ilqr import step as iteration
from torchgco.ilqr.line_search import Rollouts, rungs_of
from torchgco.ilqr.riccati import BackwardPass
from torchgco.ilqr.step import Descent, keep_lifted
from torchgco.kernels.in_pytorch import Judged, Kernels, clearance_of
from torchgco.kernels.outer import NativeOuter, blank_end, pass_end
from torchgco.lagrangian.lagrangian import InnerState, Lagrangian, Multipliers, PassEnd, State
from torchgco.native import structures
from torchgco.native.cuda.engine import current_device
from torchgco.native.engine import OF_MODEL, OF_ROWS, WHOLE, Engine, Sampler, run
from torchgco.native.interior import InteriorEngine, InteriorKernels
from torchgco.native.kept_problem import KeptDescent
from torchgco.obstacles.base import TOUCH
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem

CONTROL_NUDGE = 1e-14  # relative change of the controls that tests a rollout's sensitivity
AMPLIFIED = 1e6  # times CONTROL_NUDGE: where the states change by less, different last bits don't matter
ITERATED = "X", "U", "cost", "merit", "regularisation", "inner", "iterations", "rung"


class NativeKernels(Kernels):
    """See `Kernels`.

    Args:
        engine: the library of the problems' form.
        warn: is called with the reason why something is left to PyTorch's kernels.
    """

    name = "native"
    compiled = True

    def __init__(self, engine: Engine, warn: Callable[[Exception], None]) -> None:
        self.engine, self._warn, self.affine = engine, warn, engine.model.affine
        self._samplers: dict[Hashable, Sampler] = {}
        self._interiors: dict[Hashable, InteriorEngine] = {}

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        X = U.new_empty(problem.B, problem.N + 1, problem.n)
        X[:, 0] = problem.x0
        packed = self.engine.packed(problem, OF_MODEL, X=X, U=U.contiguous())
        run(self.engine.library.tgco_open_loop, problem.B, self.engine.lanes, packed)
        return X

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        X, U = X.clone(memory_format=torch.contiguous_format), U.clone(memory_format=torch.contiguous_format)
        gains = torch.nn.functional.pad(K, (0, 1)).contiguous()
        packed = self.engine.packed(problem, OF_MODEL, X=X, U=U, gains=gains)
        run(self.engine.library.tgco_closed_loop, problem.B, self.engine.lanes, packed)
        return X, U

    def value(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        B = lagrangian.problem.B
        cost, merit = X.new_empty(B), X.new_empty(B)
        packed = self.engine.terms(lagrangian, X=X.contiguous(), U=U.contiguous(), cost=cost, merit=merit)
        run(self.engine.library.tgco_value, B, self.engine.lanes, packed)
        return cost, merit

    def begun(self, lagrangian: Lagrangian, U: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        problem, B = lagrangian.problem, len(U)
        X, cost, merit = U.new_empty(B, problem.N + 1, problem.n), U.new_empty(B), U.new_empty(B)
        X[:, 0] = problem.x0
        packed = self.engine.terms(lagrangian, X=X, U=U.contiguous(), cost=cost, merit=merit)
        run(self.engine.library.tgco_begin, B, self.engine.lanes, packed)
        return X, cost, merit

    def scale(self, problem: Problem) -> None:
        if self.engine.cost is not None:
            slopes, H = self.expand(problem, *problem.at_rest)
            problem.derived["cost_scale"] = problem.scale_of(slopes, H.diagonal(dim1=-2, dim2=-1))

    def expand(
        self, problem: Problem, X: Tensor, U: Tensor, lagrangian: Lagrangian | None = None
    ) -> tuple[Tensor, Tensor]:
        """Gradients (B, N+1, n+m) and Hessians (B, N+1, n+m, n+m) of L_M; of J_var without a Lagrangian.

        Only the upper triangles of the Hessians are filled.
        """
        B, N, size = problem.B, problem.N, problem.n + problem.m
        slopes, H, none = X.new_empty(B, N + 1, size), X.new_empty(B, N + 1, size, size), X.new_zeros(B)
        values = {"X": X.contiguous(), "U": U.contiguous(), "cost": none, "merit": none}
        if lagrangian is None:
            packed = self.engine.packed(problem, WHOLE, **values, mu=none, constraints=0)
        else:
            packed = self.engine.terms(lagrangian, None, **values)
        packed.slopes, packed.curvatures = slopes, H
        run(self.engine.library.tgco_expand, B, self.engine.lanes, packed)
        return slopes, H

    def violation(self, problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
        if not self.engine.measures:
            return super().violation(problem, X, U, obstacles)
        worst, library = X.new_empty(problem.B), self.engine.library
        packed = self.engine.packed(problem, OF_ROWS, X=X.contiguous(), U=U.contiguous(), merit=worst)
        run(library.tgco_penetration if obstacles else library.tgco_violation, problem.B, self.engine.lanes, packed)
        return worst

    def chord_clearance(self, problem: Problem, X: Tensor, share: float | None) -> Tensor:
        others = [row for row in problem.distances if type(row) is not BoundSpheres]
        if len(others) == len(problem.distances):
            return clearance_of(others, X, share)
        U, least = X.new_zeros(problem.B, problem.N, problem.m), X.new_empty(problem.B)
        contact = 1.0 - (TOUCH if share is None else share)
        packed = self.engine.packed(problem, OF_ROWS, X=X.contiguous(), U=U, merit=least, gain=contact)
        run(self.engine.library.tgco_chords, problem.B, self.engine.lanes, packed)
        return clearance_of(others, X, share, least) if others else least

    def rolled_out(self, problem: Problem, X: Tensor, U: Tensor, gains: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        B, worst = problem.B, X.new_empty(problem.B)
        X, U = X.clone(memory_format=torch.contiguous_format), U.clone(memory_format=torch.contiguous_format)
        packed = self.engine.packed(problem, OF_ROWS, X=X, U=U, gains=gains.contiguous(), merit=worst)
        run(self.engine.library.tgco_follow, B, self.engine.lanes, packed)
        return X, U, worst if self.engine.measures else super().violation(problem, X, U)

    def judged(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Judged:
        B, X, U = lagrangian.problem.B, X.contiguous(), U.contiguous()
        slack, worst, sensitive = X.new_empty(B), X.new_empty(B), _flags(B)
        more = {"slack": slack, "violation": worst, "sensitive": sensitive, "nudge": CONTROL_NUDGE}
        run = partial(self._backward, lagrangian, X, U)
        step = run(X.new_zeros(B), gain=AMPLIFIED * CONTROL_NUDGE, **more)
        if not self.engine.measures:
            worst = super().violation(lagrangian.problem, X, U)
        return Judged(step, slack, worst, sensitive != 0, run)

    def _backward(self, lagrangian: Lagrangian, X: Tensor, U: Tensor, mu: Tensor, **more: Any) -> BackwardPass:
        B, N, m, n = *U.shape, X.shape[-1]
        G, status, linear, quadratic = X.new_empty(B, N, m, n + 1), _flags(B), X.new_empty(B), X.new_empty(B)
        packed = self.engine.terms(
            lagrangian, X=X, U=U, regularisation=mu.contiguous(), cost=linear, merit=quadratic, gains=G, status=status,
            optimality=True, **more,
        )  # fmt: skip
        run(self.engine.library.tgco_gains, B, self.engine.lanes, packed)
        return BackwardPass(G.transpose(0, 1), linear, quadratic, status != Status.RUNNING)

    def costates(self, problem: Problem, X: Tensor, U: Tensor, lam: Sequence[Tensor]) -> Tensor:
        """See `kernels.costates`."""
        found, none = torch.zeros_like(X), X.new_zeros(problem.B)
        packed = self._of_multipliers(problem, X, U, lam, cost=none, merit=none, slopes=found, optimality=1)
        run(self.engine.library.tgco_costates, problem.B, self.engine.lanes, packed)
        return found

    def regulated(
        self, problem: Problem, X: Tensor, U: Tensor, lam: Sequence[Tensor], F: Tensor, slopes: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See `kernels.regulated`."""
        first, second = X.new_zeros(2, problem.B)
        own = {"halves": F.contiguous(), "slopes": slopes.contiguous()}
        packed = self._of_multipliers(problem, X, U, lam, cost=first, merit=second, optimality=2, **own)
        run(self.engine.library.tgco_regulated, problem.B, self.engine.lanes, packed)
        return first, second

    def _of_multipliers(
        self, problem: Problem, X: Tensor, U: Tensor, lam: Sequence[Tensor], **values: Any
    ) -> structures.Problem:
        """A trajectory with multipliers and no penalty."""
        lagrangian = Lagrangian(problem, Multipliers(tuple(lam), X.new_zeros(problem.B)), None, True)
        return self.engine.terms(lagrangian, X=X.contiguous(), U=U.contiguous(), **values)

    def descend(self, lagrangian: Lagrangian, s: InnerState, how: Descent, limit: int, begins: bool = False) -> PassEnd:
        B = lagrangian.problem.B
        for name in ITERATED:
            setattr(s, name, getattr(s, name).contiguous())
        out = blank_end(B)
        state = {name: getattr(s, name) for name in ITERATED}
        packed = self.engine.terms(
            lagrangian, None, **state, **out, options=native_options(how), limit=limit,
            replicas=self.engine.replicas_of(B),
        )  # fmt: skip
        library = self.engine.library
        run(library.tgco_descend if begins else library.tgco_ilqr, B, self.engine.lanes, packed)
        end = pass_end(out)
        if out["lost"].any():
            rows = out["lost"].nonzero().flatten()
            won = rows[keep_lifted(s, rows, self.lifted(lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows]))]
            end.ended[won] = s.inner[won] >= how.max_iterations
            s.regularisation[won] = 0.0
        return end

    def lifted(self, lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor) -> Rollouts:
        """`ilqr.lifted.lifted_search` in C."""
        starts = {"X": X, "U": U, "cost": merit, "merit": merit}
        state = {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in starts.items()}
        accepted, mu_r = _flags(lagrangian.problem.B), torch.zeros_like(merit)
        packed = self.engine.terms(
            lagrangian, None, **state, converged=accepted, regularisation=mu_r, limit=iteration.LIFTED_STEPS,
            gain=iteration.GAIN,
        )  # fmt: skip
        run(self.engine.library.tgco_lift, lagrangian.problem.B, self.engine.lanes, packed)
        return Rollouts(**state, alpha=torch.ones_like(merit), accepted=accepted != 0)

    def kept_descent(self, problem: Problem, how: Descent, phr: bool) -> KeptDescent | None:
        return KeptDescent(self.engine, problem, native_options(how), phr) if self.engine.measures else None

    def outer_passes(self, problem: Problem, s: State, how: Descent, **limits: Any) -> NativeOuter | None:
        return NativeOuter(self.engine, native_options(how), problem, s, **limits) if self.engine.measures else None

    def interior(self, problem: Problem) -> InteriorKernels:
        served = current_device(), self.engine.B
        if served not in self._interiors:
            try:
                self._interiors[served] = InteriorEngine(self.engine)
            except InputError as error:  # second derivatives whose code would be too long
                self._warn(error)
                return super().interior(problem)
        return self._interiors[served]

    def sample(self, problem: Problem, U: Tensor, how: Sampling) -> Tensor:
        if how.dtype not in self._samplers:  # compiled at the first call: most solves never sample
            self._samplers[how.dtype] = Sampler(self.engine, how.dtype)
        return self._samplers[how.dtype].improve(problem, U, how)


def native_options(how: Descent) -> structures.Options:
    """The options in the structure that the library reads."""
    search, printed = how.line_search, how.as_printed
    return _options(
        search.shrink, back=-1 if search.back is None else search.back,
        accept_last=printed, ratio_min=search.ratio_min, ratio_max=search.ratio_max, smallest=search.smallest,
        max_iterations=how.max_iterations, tolerance=0.0 if printed else how.tolerance,
        absolute_tolerance=how.tolerance if printed else 0.0, rounding=iteration.ROUNDED_OFF, lost=iteration.LOST_BY,
        regularisation_first=iteration.REGULARISATION_FIRST, regularisation_growth=iteration.REGULARISATION_GROWTH,
        regularisation_max=iteration.REGULARISATION_MAX, damping=0.0 if printed else iteration.DAMPING,
        damping_growth=iteration.DAMPING_GROWTH, damping_decay=iteration.DAMPING_DECAY,
    )  # fmt: skip


@lru_cache(maxsize=64)
def _options(shrink: float, **numbers: Any) -> structures.Options:
    """The structure with these fields: there are few of them, and filling one takes long beside a small solve."""
    rungs = rungs_of(shrink, numbers["smallest"], numbers["accept_last"])
    return structures.Options.complete(ladder=torch.tensor(rungs, dtype=torch.float64), rungs=len(rungs), **numbers)


def _flags(B: int) -> Tensor:
    return torch.zeros(B, dtype=torch.int32)
