"""The interface of kernels: everything that solvers compute with, for the problems of one form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from torchgco.eager.sampling import Sampling
from torchgco.ilqr.descent import Descent
from torchgco.ilqr.riccati import BackwardPass
from torchgco.lagrangian.kkt import KktSolve, RightSides
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.state import InnerState, PassEnd, State
from torchgco.native.kept_descent import KeptDescent
from torchgco.problem.problem import Problem


class InteriorKernels(Protocol):
    """The interior point: `native.interior.InteriorEngine` in C, `eager.kernels.EagerInterior` in PyTorch."""

    def solve(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], barrier: Tensor, **options: Any
    ) -> dict[str, Tensor]:
        """See `InteriorEngine.solve`."""
        ...

    def kkt(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor,
        right: RightSides, give: Tensor | None = None, K: Tensor | None = None,
    ) -> KktSolve:  # fmt: skip
        """See `InteriorEngine.kkt`."""
        ...


class OuterPasses(Protocol):
    """Passes of AL-iLQR's outer loop over the problems of a `State`, in place: see `kernels.outer.NativeOuter`."""

    outcome: Tensor  # (b,) int64: RUNNING, or why a problem has ended

    @property
    def ended(self) -> Tensor:
        """(b,) bool: whether the inner solve of the last pass has ended."""
        ...

    def run(self, passes: int) -> None:
        """Up to `passes` inner solves of every problem, each with its outer iteration."""
        ...

    def run_half(self, at_once: int) -> None:
        """Passes until half of the problems have an outcome."""
        ...

    def iterate(self) -> PassEnd:
        """One iteration of every problem's inner solve."""
        ...

    def update(self) -> None:
        """The outer iterations of the problems whose inner solve has ended."""
        ...


class Kernels(Protocol):
    """Two implementations: `kernels.in_c.NativeKernels` in C and `kernels.in_pytorch.TorchKernels`, which serves any
    device, any dtype and any code. `kernels.choice.kernels_of` chooses once per form of problems.

    Both compute the same up to rounding. Trajectories are X (B, N+1, n), U (B, N, m).

    Attributes:
        name: "native" or "pytorch", as solutions and tables say it.
        compiled: the problem's functions are compiled from a trace: all that is asked of them works, in any precision,
            without autodiff and its memory; they may differ from the user's code.
    """

    name: str
    compiled: bool

    @property
    def affine(self) -> bool:
        """Whether the dynamics are known to be affine in states and controls."""
        ...

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        """X from the problem's start and controls U."""
        ...

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        """The rollout of U + K (x - X) from the first knots of X; gains K (B, N, m, n)."""
        ...

    def value(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """J_var (B,) and L_M (B,)."""
        ...

    def scale(self, problem: Problem) -> None:
        """Have the problem keep its `cost_scale`, without autodiff where that can be."""
        ...

    def violation(self, problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
        """The largest violation (B,), of all constraints or of `obstacles` alone (geometric ones)."""
        ...

    def chord_clearance(self, problem: Problem, X: Tensor, share: float) -> Tensor:
        """See `kernels.chord_clearance`."""
        ...

    def slack(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Tensor:
        """See `Lagrangian.slack`."""
        ...

    def optimality_pass(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Callable[[Tensor], BackwardPass]:
        """The backward pass on J_var + lam'c, for regularisations mu_r (B,)."""
        ...

    def descend(self, lagrangian: Lagrangian, s: InnerState, how: Descent, limit: int) -> PassEnd:
        """Iterations of every problem's inner solve, in place: one at least, `limit` at most."""
        ...

    def kept_descent(self, problem: Problem, how: Descent, phr: bool) -> KeptDescent | None:
        """Inner solves of problems that stay packed; None: the caller makes them from `descend`."""
        ...

    def outer_passes(self, problem: Problem, s: State, how: Descent, **limits: Any) -> OuterPasses | None:
        """Whole passes of the outer loop; None: the caller makes them from `descend`."""
        ...

    def interior(self, problem: Problem) -> InteriorKernels:
        """The interior point.

        Raises:
            InputError: rows that join knots.
        """
        ...

    def sample(self, problem: Problem, U: Tensor, how: Sampling) -> Tensor:
        """Controls (B, N, m): the weighted mean of the last round's samples, the first drawn around U."""
        ...

    def differing(self, problem: Problem, X: Tensor, U: Tensor) -> Tensor:
        """Problems (b,) of which rounding may decide where a rollout of U by PyTorch ends, for these X."""
        ...
