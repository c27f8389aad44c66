"""What the batched loop carries, and what it asks of the solver that starts it and of the guidance that steers it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from torchgco.constraints.guides import Guide, GuideRegion
from torchgco.draws import DrawKey
from torchgco.lagrangian import Multipliers
from torchgco.problem import Problem

if TYPE_CHECKING:
    from torchgco.solvers.ilqr import ILQR


@dataclass(frozen=True)
class Iterate:
    """A trajectory and its worth."""

    X: Tensor
    U: Tensor
    duals: Multipliers
    cost: Tensor
    violation: Tensor


@dataclass
class InnerState:
    """What an element carries from iteration to iteration; every tensor starts with the running batch."""

    rows: Tensor  # place in the batch as it was given
    X: Tensor
    U: Tensor
    cost: Tensor
    merit: Tensor
    regularisation: Tensor  # mu_r
    inner: Tensor  # iterations of this inner solve
    iterations: Tensor  # of the loop itself
    rung: Tensor  # int64: at which the next line search begins


@dataclass
class State(InnerState):
    """What it carries from pass to pass."""

    duals: Multipliers
    guide: Guide | None
    outer: Tensor  # inner solves ended
    advised: Tensor  # iterations of the solves that guidance made
    guided: Tensor
    last_cost: Tensor  # J_var when the inner solve before ended
    best: Iterate
    origin: Iterate  # the caught path that guidance first replaced
    attempt: Tensor  # plans tried from there, 0 while none was
    since: Tensor  # `outer` when the attempt began
    led: Tensor  # bool: the attempt goes on from a plan with its own penalty, and guidance keeps silent


@dataclass(frozen=True)
class Progress:
    """What a callback receives after every pass, or after every problem from a solver that takes them one by one."""

    passes: int
    rows: Tensor  # (b,) int64: places in the batch of the problems that this pass worked on, side by side
    finished: int
    total: int
    state: State | None  # None from a solver that carries no batch


Callback = Callable[[Progress], None]


@dataclass(frozen=True)
class InnerEnd:
    """How the inner solve ended, for the elements that have just ended one; every tensor is (B',)."""

    converged: Tensor
    refused: Tensor  # no step length was acceptable
    outer: Tensor  # inner solves ended in this attempt, this one included
    cost: Tensor
    last_cost: Tensor  # when the inner solve before ended; infinite at first
    violation: Tensor


@dataclass(frozen=True)
class Advice:
    """What guidance says of a solved batch: where to draw the next inner solve, or from where to start it."""

    guide: GuideRegion  # penalty of the next inner solve
    U: Tensor  # (B', N, m): controls to go on from
    taken: Tensor  # (B',) bool: where U replaces the iterate
    # To go on with where U is taken, and left alone until the attempt ends; NaN in mu, or None: the solver's own.
    duals: Multipliers | None = None
    iterations: Tensor | None = None  # (B',) int64: of the solves that guidance made for this; None: it made none


class Guidance(Protocol):
    """Plug-in of the outer loop, asked after every inner solve."""

    def suited(self, problem: Problem) -> Guidance | None:
        """The guidance that can serve these problems, asked once, when a solve starts; None: they are solved without.

        Guidance that can't be had is no error: a GuidanceWarning says which part is missing and why.
        """
        ...

    def start(self, problem: Problem, X: Tensor) -> GuideRegion:
        """The penalty that is no penalty yet, for every element."""
        ...

    def update(self, problem: Problem, X: Tensor, U: Tensor, guide: GuideRegion, key: DrawKey) -> Advice:
        """Advice for the elements whose inner solve has just ended, with X, U."""
        ...


class OuterLoop(Protocol):
    """What the loop asks of the solver that started it."""

    @property
    def inner(self) -> ILQR: ...
    @property
    def guidance(self) -> Guidance | None: ...
    @property
    def initial_penalty(self) -> float: ...
    @property
    def penalty_growth(self) -> float: ...
    @property
    def penalty_max(self) -> float: ...
    @property
    def grow_when_feasible(self) -> bool: ...
    @property
    def violation_tolerance(self) -> float: ...
    @property
    def hold_factor(self) -> float: ...
    @property
    def attempts(self) -> int: ...
    @property
    def arrival(self) -> float | None: ...
    @property
    def thorough(self) -> bool: ...
    @property
    def clip(self) -> bool: ...
    @property
    def slots(self) -> int | None: ...
    @property
    def record(self) -> bool: ...

    def verdict(self, inner: InnerEnd) -> Tensor:
        """A status (B',) for each element whose inner solve has ended; RUNNING starts the next one."""
        ...
