"""Native kernels where they can be used, PyTorch's elsewhere: one choice and one warning per form of problems."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.constraints.separation import Separation
from torchgco.dynamics import rollout
from torchgco.eager.kernels import EagerInterior
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.quality import violation
from torchgco.native.compiler import NativeError, find_compiler
from torchgco.native.engine import Engine
from torchgco.native.identity import signature
from torchgco.native.interior import InteriorEngine, begin_interior
from torchgco.native.kernels import native
from torchgco.native.sampler import Sampler
from torchgco.native.store import trim
from torchgco.obstacles.base import TOUCH, Obstacles
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.border import check_eager
from torchgco.problem.problem import Problem
from torchgco.tracing import Facts

NUDGE = 1e-14  # relative change of the controls that tests a rollout's sensitivity
CURRENT = "current"  # marks the form of problems that a solve works on
EAGER_INTERIOR = "eager interior"  # marks the interior point's kernels in PyTorch
EXPECTED = "expected"  # marks that the interior point will be asked for
EAGER = "eager"  # marks that PyTorch's kernels have differentiated a user's parts
WARNED = "warned"  # the reasons that an EagerWarning has named for a problem
KEPT = 64  # engines, the most recent ones
CAPTURED = 1 << 26  # bytes of tensors that these have captured: each is held four times, as it was read and for C, too
AMPLIFIED = 1e6  # times NUDGE: where the states change by less, different last bits don't matter


class EagerWarning(UserWarning):
    """Native kernels can't be used for a problem; PyTorch's are, which takes longer."""


def current(problem: Problem) -> Problem:
    """The problem as its parts are now: nothing is kept from an earlier solve but code of the same computation.

    Every solve begins with this call: the tensors, numbers and modules that a user's code captures may have changed.
    Within a solve, subsets and other forms of the problem share the kernels of its beginning.
    """
    if CURRENT in problem.form:
        return problem
    fresh = problem.renewed()
    fresh.form[CURRENT] = True
    fresh.form[WARNED] = problem.form.setdefault(WARNED, set())
    return fresh


def engine_of(problem: Problem) -> Engine | None:
    """The library for problems of this form, compiled at the first call; None where PyTorch's kernels are used.

    PyTorch's are used on a GPU, in single precision, where the process has chosen them (`kernels.use_native`), and
    where a part can't be traced or nothing compiles, which an EagerWarning explains.
    """
    if not native() or problem.x0.dtype != torch.float64 or problem.x0.device.type != "cpu":
        if EAGER not in problem.form:
            check_eager(problem.dynamics, problem.cost, problem.constraints, problem.x0, problem.N)
            problem.form[EAGER] = True
        return None
    if "engine" not in problem.form:
        try:
            problem.form["engine"] = _engine(problem)
        except (InputError, NativeError) as error:
            problem.form["engine"] = None
            check_eager(problem.dynamics, problem.cost, problem.constraints, problem.x0, problem.N)
            _warn(problem, error)
    return problem.form["engine"]


def _warn(problem: Problem, error: Exception) -> None:
    """Say once why PyTorch's kernels are used."""
    reason = str(error).splitlines()[0]
    warned = problem.form.setdefault(WARNED, set())
    if reason not in warned:
        warned.add(reason)
        warnings.warn(f"solved by PyTorch's kernels, many times slower: {reason}", EagerWarning, stacklevel=5)


def kernels_of(problem: Problem) -> str:
    """The kernels that have worked on problems of this form: "native" or "pytorch"."""
    return "pytorch" if problem.form.get("engine") is None or not native() else "native"


def expect_interior(problem: Problem) -> None:
    """Have the interior point's library compiled beside the first one, where that isn't made yet."""
    problem.form[EXPECTED] = True


def _engine(problem: Problem) -> Engine:
    """The engine of an earlier solve where nothing that its code depends on has changed, else a new one."""
    before, ahead = signature(problem), begin_interior if EXPECTED in problem.form else None
    if before is None:
        return Engine(problem, ahead)
    key = before.key, find_compiler()
    known = _engines.pop(key, None)
    if known is not None and (shared := known[0].captured.read()) is not None:
        _engines[key] = known  # the most recent one is the last
        return known[0].with_shared(shared.copy())
    engine, after = Engine(problem, ahead), signature(problem)
    # Code that has changed what it reads, a counter for instance, does so at every solve.
    if after is not None and after.key == before.key and after.covers(engine.captured.traces):
        engine.forget_values()
        _engines[key] = engine, after.facts
        trim(_engines, KEPT, CAPTURED, lambda kept: kept[0].captured.nbytes)
    return engine.with_shared(engine.shared.copy())  # a compiled problem writes into it


_engines: dict[Hashable, tuple[Engine, Facts]] = {}  # the facts hold what their key names by identity


def sampler_of(problem: Problem, dtype: torch.dtype) -> Sampler | None:
    """The library that samples for problems of this form in precision `dtype`; None where PyTorch samples.

    Compiled at the first call: most solves never sample.
    """
    engine = engine_of(problem)
    if engine is None:
        return None
    if dtype not in problem.form:
        problem.form[dtype] = Sampler(engine, dtype)
    return problem.form[dtype]


class InteriorKernels(Protocol):
    """The interior point: `native.interior.InteriorEngine` in C, `eager.kernels.EagerInterior` in PyTorch."""

    def solve(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], barrier: Tensor, **options: Any
    ) -> dict[str, Tensor]:
        """See `InteriorEngine.solve`."""
        ...


def interior_of(problem: Problem) -> InteriorKernels:
    """The interior point's kernels for problems of this form: in C where there are native kernels, else PyTorch's.

    Raises:
        InputError: rows that join knots.
    """
    engine = engine_of(problem)
    if engine is not None:
        try:
            return InteriorEngine(engine)
        except InputError as error:  # second derivatives whose code would be too long
            _warn(problem, error)
    if EAGER_INTERIOR not in problem.form:
        problem.form[EAGER_INTERIOR] = EagerInterior.of(problem)
    return problem.form[EAGER_INTERIOR]


def cost_unit(problem: Problem) -> Tensor:
    """`problem.cost_unit` (B,), computed by the native library where PyTorch would need autodiff for it.

    The problem keeps its scale: `problem.in_cost_units()` then needs no autodiff either.
    """
    engine = engine_of(problem)
    if engine is not None and engine.cost is not None and "cost_scale" not in vars(problem):
        slopes, H = engine.expand(problem, *problem.at_rest)
        object.__setattr__(problem, "cost_scale", problem.scale_of(slopes, H.diagonal(dim1=-2, dim2=-1)))
    return problem.cost_unit


def open_loop(problem: Problem, U: Tensor) -> Tensor:
    """X (B, N+1, n) from controls U (B, N, m)."""
    engine = engine_of(problem)
    return rollout.open_loop(problem.dynamics, problem.x0, U) if engine is None else engine.open_loop(problem, U)


def followed(problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The rollout, X and U, that brings the problem's start back to X (B, N+1, n) by the feedback u = U + K (x - X).

    Free components of the start are those of X.
    Gains K (B, N, m, n) that aren't finite count as 0.
    """
    start = problem.start_in(X[:, 0])
    K, away, alpha = K.nan_to_num(0.0, 0.0, 0.0), start - X[:, 0], torch.zeros_like(X[:, 0, 0])
    U = torch.cat((U[:, :1] + (K[:, 0] * away.unsqueeze(1)).sum(-1).unsqueeze(1), U[:, 1:]), dim=1)
    X, G = torch.cat((start.unsqueeze(1), X[:, 1:]), dim=1), torch.nn.functional.pad(K, (0, 1))
    engine = engine_of(problem)
    if engine is not None:
        return engine.closed_loop(problem, X, U, G)
    return rollout.closed_loop(problem.dynamics, X, U, G.transpose(0, 1).contiguous(), alpha)


def reproducible(problem: Problem, X: Tensor, U: Tensor, gains: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """X (B, N+1, n) and U (B, N, m) of native kernels, mended where PyTorch's rollout of U would not give X.

    The two kinds of kernels differ in the last bits. Where unstable dynamics amplify this, as a rollout of slightly
    different controls shows, PyTorch tracks X with the `gains` (b, N, m, n) of these rows (b,), and X and U of that
    rollout are returned.
    """
    engine = engine_of(problem)
    if engine is None:
        return X, U
    other = engine.open_loop(problem.held_at(X[:, 0]), U + NUDGE * U.abs().amax(dim=1, keepdim=True))
    scale = X.abs().flatten(1).amax(-1).clamp(min=NUDGE)
    rows = (~((other - X).abs().flatten(1).amax(-1) <= AMPLIFIED * NUDGE * scale)).nonzero().flatten()
    if rows.numel() == 0:
        return X, U
    K = gains(rows)
    G = torch.cat((K, torch.zeros_like(K[..., :1])), dim=-1).nan_to_num(0.0).transpose(0, 1)
    X, U, alpha = X.clone(), U.clone(), torch.zeros_like(scale[rows])
    X[rows], U[rows] = rollout.closed_loop(problem.dynamics.take(rows), X[rows], U[rows], G.contiguous(), alpha)
    return X, U


def value(lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
    """J_var (B,) and L_M (B,)."""
    engine = engine_of(lagrangian.problem)
    return lagrangian.value(X, U) if engine is None else engine.value(lagrangian, X, U)


def measured(problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
    """The largest violation (B,) of trajectories, of all constraints or of `obstacles` alone (geometric ones)."""
    engine = engine_of(problem)
    if engine is not None and engine.measures:
        return engine.violation(problem, X, U, obstacles)
    return violation(problem.geometric if obstacles else problem.constraints, X, U)


def chord_clearance(problem: Problem, X: Tensor, share: float = TOUCH) -> Tensor:
    """Smallest distance (B,) from the straight lines between knots to obstacles, m, negative in contact.

    Counted from a `share` of an obstacle's margin beneath its surface, by default from where bodies touch; infinite
    without obstacles and positions that keep a distance.
    """
    engine, least = engine_of(problem), X.new_full(X.shape[:1], torch.inf)
    parts = [part for part in (c.bare for c in problem.constraints) if isinstance(part, Obstacles | Separation)]
    if engine is not None and any(type(part) is BoundSpheres for part in parts):
        least = engine.chords(problem, X, 1.0 - share)
        parts = [part for part in parts if type(part) is not BoundSpheres]
    for part in parts:
        least = torch.minimum(least, part.chord_clearance(X, share))
    return least
