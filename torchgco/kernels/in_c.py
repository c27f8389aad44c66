"""Kernels in C for float64 on a CPU: functions traced and compiled, several problems side by side."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.eager.sampling import Sampling
from torchgco.ilqr import descent, lifted
from torchgco.ilqr.descent import Descent
from torchgco.ilqr.line_search import Rollouts
from torchgco.ilqr.riccati import BackwardPass
from torchgco.ilqr.step import keep_lifted
from torchgco.kernels.in_pytorch import InteriorKernels, Kernels, clearance_of
from torchgco.kernels.outer import NativeOuter
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.state import InnerState, PassEnd, State
from torchgco.native.engine import Engine
from torchgco.native.interior import InteriorEngine
from torchgco.native.kept_descent import KeptDescent
from torchgco.native.sampler import Sampler
from torchgco.native.structures import End, Options
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem

CONTROL_NUDGE = 1e-14  # relative change of the controls that tests a rollout's sensitivity
AMPLIFIED = 1e6  # times CONTROL_NUDGE: where the states change by less, different last bits don't matter
ITERATED = "X", "U", "cost", "merit", "regularisation", "inner", "iterations", "rung"


class NativeKernels(Kernels):
    """See `Kernels`.

    Args:
        engine: the library of the problems' form.
        B: problems of a solve, all in all; see `InteriorEngine`.
        warn: is called with the reason why something is left to PyTorch's kernels.
    """

    name = "native"
    compiled = True

    def __init__(self, engine: Engine, B: int, warn: Callable[[Exception], None]) -> None:
        self.engine, self.B, self._warn, self.affine = engine, B, warn, engine.model.affine
        self._samplers: dict[Hashable, Sampler] = {}

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        return self.engine.open_loop(problem, U)

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        return self.engine.closed_loop(problem, X, U, torch.nn.functional.pad(K, (0, 1)))

    def value(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        return self.engine.value(lagrangian, X, U)

    def scale(self, problem: Problem) -> None:
        if self.engine.cost is not None:
            slopes, H = self.engine.expand(problem, *problem.at_rest)
            object.__setattr__(problem, "cost_scale", problem.scale_of(slopes, H.diagonal(dim1=-2, dim2=-1)))

    def violation(self, problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
        if self.engine.measures:
            return self.engine.violation(problem, X, U, obstacles)
        return super().violation(problem, X, U, obstacles)

    def chord_clearance(self, problem: Problem, X: Tensor, share: float) -> Tensor:
        parts = [c.bare for c in problem.constraints]
        others = [part for part in parts if type(part) is not BoundSpheres]
        least = clearance_of(others, X, share)
        return least if len(others) == len(parts) else torch.minimum(least, self.engine.chords(problem, X, 1.0 - share))

    def slack(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Tensor:
        return self.engine.slack(lagrangian, X, U)

    def optimality_pass(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Callable[[Tensor], BackwardPass]:
        def backward(mu: Tensor) -> BackwardPass:
            G, linear, quadratic, failed = self.engine.gains(lagrangian, X, U, mu)
            return BackwardPass(G.transpose(0, 1), linear, quadratic, failed)

        return backward

    def descend(self, lagrangian: Lagrangian, s: InnerState, how: Descent, limit: int) -> PassEnd:
        state = {name: getattr(s, name).contiguous() for name in ITERATED}
        for name, part in state.items():
            setattr(s, name, part)
        out = self.engine.inner_solve(lagrangian, state, native_options(how), limit)
        converged, stuck, lost = (out[name] != 0 for name in ("converged", "refused", "lost"))
        ended = out["status"] == End.ENDED
        failed = ~ended & (out["status"] != Status.RUNNING)
        rows = lost.nonzero().flatten()
        if rows.numel() > 0:
            won = rows[keep_lifted(s, rows, self.lifted(lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows]))]
            ended[won] = s.inner[won] >= how.max_iterations
            s.regularisation[won] = 0.0
        status = torch.where(failed, out["status"].long(), int(Status.RUNNING))
        return PassEnd(ended, converged, stuck, status, out["alpha"], out["used"], failed)

    def lifted(self, lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor) -> Rollouts:
        """`ilqr.lifted.lifted_search` in C."""
        given = {"X": X, "U": U, "cost": merit, "merit": merit}
        state = {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in given.items()}
        accepted = self.engine.lift(lagrangian, state, lifted.LIFTED_STEPS, lifted.GAIN)
        return Rollouts(**state, alpha=torch.ones_like(merit), accepted=accepted)

    def kept_descent(self, problem: Problem, how: Descent, phr: bool) -> KeptDescent | None:
        return KeptDescent(self.engine, problem, native_options(how), phr) if self.engine.measures else None

    def outer_passes(self, problem: Problem, s: State, how: Descent, **limits: Any) -> NativeOuter | None:
        return NativeOuter(self.engine, native_options(how), problem, s, **limits) if self.engine.measures else None

    def interior(self, problem: Problem) -> InteriorKernels:
        try:
            return InteriorEngine(self.engine, self.B)
        except InputError as error:  # second derivatives whose code would be too long
            self._warn(error)
            return super().interior(problem)

    def sample(self, problem: Problem, U: Tensor, how: Sampling) -> Tensor:
        if how.dtype not in self._samplers:  # compiled at the first call: most solves never sample
            self._samplers[how.dtype] = Sampler(self.engine, how.dtype)
        return self._samplers[how.dtype].improve(problem, U, how)

    def differing(self, problem: Problem, X: Tensor, U: Tensor) -> Tensor:
        start = problem.held_at(X[:, 0])
        other = self.engine.open_loop(start, U + CONTROL_NUDGE * U.abs().amax(dim=1, keepdim=True))
        scale = X.abs().flatten(1).amax(-1).clamp(min=CONTROL_NUDGE)
        return (~((other - X).abs().flatten(1).amax(-1) <= AMPLIFIED * CONTROL_NUDGE * scale)).nonzero().flatten()


def native_options(how: Descent) -> Options:
    """The options in the structure that the library reads."""
    search, printed = how.line_search, how.as_printed
    ladder = _numbers(*search.ladder(printed))
    return Options.complete(
        ladder=ladder, rungs=len(ladder), back=-1 if search.back is None else search.back, accept_last=printed,
        ratio_min=search.ratio_min, ratio_max=search.ratio_max, smallest=search.smallest,
        max_iterations=how.max_iterations, tolerance=0.0 if printed else how.tolerance,
        absolute_tolerance=how.tolerance if printed else 0.0, rounding=descent.ROUNDED_OFF, lost=lifted.LOST_BY,
        regularisation_first=descent.REGULARISATION_FIRST, regularisation_growth=descent.REGULARISATION_GROWTH,
        regularisation_max=descent.REGULARISATION_MAX, damping=0.0 if printed else descent.DAMPING,
        damping_growth=descent.DAMPING_GROWTH, damping_decay=descent.DAMPING_DECAY, damp_below=how.damp_below,
    )  # fmt: skip


@lru_cache(maxsize=64)
def _numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
