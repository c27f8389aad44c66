"""Problems with a free time in the form that solvers work on, the way back, and trajectories as guesses a while later.

The states are [x, tau, carried ones], the controls [u, next tau]: the first segment's factor tau is a
free component of the start, the next one a control of the last stage before its segment, and everywhere else tau stays
as it is. A control that would change the length at every stage takes several times the iterations. Only where there
are several segments is there a next tau, and only where rows are of two knots are there carried states.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_shape, lead
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.constraints.carried import Carrying, Taken
from torchgco.costs.base import Cost, WrappedCost
from torchgco.costs.quadratic import QuadraticInFreeTime
from torchgco.dynamics.base import INTEGRATORS, WrappedDynamics
from torchgco.problem.carried import carried_of, rows_of_one_knot
from torchgco.problem.free_time import FreeTime
from torchgco.problem.problem import Problem

FREE_TIME_FORM = "in free time"  # what is kept with the form of the problem for this one
HELD_FORM = "at held times"  # the same, where obstacles move
PIN = 1e-3  # cost of a next tau that nobody reads, per unit squared, as a share of that of the nominal stages' time
MISFIT = 0.1  # share of the states' squared changes by which the model's may miss them in states that it goes through
EQUAL = 1e-6  # difference of two stages of a segment, as a share of the duration: that of times in single precision


def in_time(problem: Problem, guess: Tensor | None = None) -> Problem:
    """The problem with its factors of time among its states and controls; itself where the time isn't free.

    Constraints keep their places, rows and knots; bounds on the factors come after them.

    Args:
        guess: factors (B, S) to begin with; None: those of the problem, else the nominal times.
    """
    time = problem.time
    if time is None:
        return problem
    guess = time.guess if guess is None else guess
    guess = torch.clamp(torch.ones_like(time.least), time.least, time.most) if guess is None else guess
    carried = carried_of(problem)
    x0 = torch.cat((problem.x0, guess[:, :1], *([] if carried is None else [carried.start])), dim=-1)
    free = problem.free_start
    free = torch.zeros_like(problem.x0, dtype=torch.bool) if free is None else free
    parts: dict[str, object] = {
        "dynamics": _Dynamics(problem.dynamics, carried and carried.taken, _switches(time, problem.N)),
        "cost": _cost(problem, time),
        "x0": x0,
        "free_start": pad(pad(free, (0, 1), value=True), (0, x0.shape[1] - problem.n - 1)),
        "time": None,
    }
    known = problem.known.of_lifted(f"{FREE_TIME_FORM} {time.segments}")
    rows = [c.in_free_time(problem.n, problem.m, time.count - 1) for c in rows_of_one_knot(problem, problem.n + 1)]
    bounds = _bounds(problem._with(parts, known), time, problem.n)
    return problem._with(parts | {"constraints": (*rows, *bounds)}, known)


def states_in_time(problem: Problem, X: Tensor, U: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
    """X (B, N+1, n), U (B, N, m) with the factors (B, S), as states and controls of the problem `in_time`."""
    time, N = problem.time, problem.N
    assert time is not None
    along = factors[:, time.of_stages(N)]
    parts = [X, torch.cat((along, along[:, -1:]), dim=1).unsqueeze(-1)]
    if (carried := carried_of(problem)) is not None:
        parts.append(carried.along(X, U, problem.along, along.unsqueeze(-1)))
    if time.count == 1:
        return torch.cat(parts, dim=-1), U
    later = torch.cat((along[:, 1:], torch.ones_like(along[:, :1])), dim=1)
    idle = _switches(time, N) == 0
    return torch.cat(parts, dim=-1), torch.cat((U, torch.where(idle, 1.0, later).unsqueeze(-1)), dim=-1)


def factors_in(problem: Problem, X: Tensor) -> Tensor:
    """The factors (B, S) in states X (B, N+1, n') of the problem `in_time`, for the user's problem."""
    assert problem.time is not None
    return X[:, list(problem.time.segments), problem.n]


def factor_controls(whole: Problem, k: int = 0) -> slice:
    """Which controls of stage k of a problem `in_time`, or of any other, are factors of time."""
    model: Any = whole.dynamics
    return model.factor_controls(k) if hasattr(model, "factor_controls") else slice(0, 0)


def factor_state(whole: Problem) -> int:
    """Which state of a problem `in_time` is the factor of time."""
    model = whole.dynamics
    assert isinstance(model, _Dynamics)
    return model.model.n


def times_of(problem: Problem, factors: Tensor) -> Tensor:
    """The times (B, N+1) of the knots, s."""
    assert problem.time is not None
    lengths = problem.dynamics.dt * factors[:, problem.time.of_stages(problem.N)]
    return torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)


def factors_of(problem: Problem, times: Any) -> Tensor:
    """The factors (B, S) of the times (B, N+1) of the knots, s.

    Raises:
        InputError: another shape, a first time other than 0, stages of a segment that differ.
    """
    time, N = problem.time, problem.N
    assert time is not None
    if not isinstance(times, Tensor):
        expected = "the times of the knots, such as solution.t, as the problem's time is free"
        raise InputError("times", expected, type(times).__name__)
    check_shape(times, (problem.B, N + 1), "times")
    times = times.to(problem.x0)
    lengths, segments = times.diff(dim=1) / problem.dynamics.dt, list(time.segments)
    sizes = torch.tensor([b - a for a, b in zip(segments, [*segments[1:], N], strict=True)], device=lengths.device)
    factors = lengths.new_zeros(lengths.shape[0], len(segments))
    factors = factors.index_add(1, time.of_stages(N), lengths) / sizes
    wrong = (lengths - factors[:, time.of_stages(N)]).abs() > EQUAL * times[:, -1:].abs() / problem.dynamics.dt
    if bool(wrong.any()) or bool((times[:, 0] != 0).any()):
        raise InputError("times", "knots from 0 s on, at equal distances within each segment", "others")
    return factors


def fitting_factors(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The factors (B, S) with which the model goes through states X (B, N+1, n) by controls U (B, N, m), nearly.

    Those of the least squares of x_k+1 - x_k - tau dt x', with x' the mean of a stage's ends; NaN where these are off.
    """
    time, model = problem.time, problem.dynamics
    assert time is not None
    rates = 0.5 * model.dt * (model.field(X[:, :-1], U) + model.field(X[:, 1:], U))
    size = X.amax(1, keepdim=True) - X.amin(1, keepdim=True)
    change, rates = ((z / torch.where(size > 0, size, 1.0)).flatten(2) for z in (X.diff(dim=1), rates))
    none, segment = X.new_zeros(problem.B, time.count), time.of_stages(problem.N)
    squares = change * rates, rates.square(), change.square()
    both, square, whole = (none.index_add(1, segment, z.sum(-1)) for z in squares)
    factors = both / square
    misses = whole - factors * both  # what is left of the squares
    return torch.where((misses <= MISFIT * whole) & (factors > 0), factors, torch.nan)


def guessing_times(problem: Problem, times: Any) -> Problem:
    """The problem with the times (B, N+1) of an earlier solution, s, as guesses within its bounds."""
    assert problem.time is not None
    guess = factors_of(problem, times).clamp(problem.time.least, problem.time.most)
    return problem._with({"time": replace(problem.time, guess=guess)}, problem.known)


def at_held_times(problem: Problem, n: int) -> Problem:
    """Problems `in_time` whose factor, their state n, is held at x0, and whose own starts stay as free as they are."""
    free = problem.free_start
    assert free is not None
    others_free, known = free.clone(), problem.known
    others_free[:, n] = False
    parts = tuple(constraint.at_factor(problem.x0[:, n]) for constraint in problem.constraints)
    if any(a is not b for a, b in zip(parts, problem.constraints, strict=True)):
        known = known.of_lifted(HELD_FORM)
    fixed = problem._with({"free_start": others_free, "constraints": parts}, known)
    return fixed if bool(others_free.any()) else fixed.held_at(problem.x0)


def at_times(problem: Problem, X: Tensor, U: Tensor, times: Any) -> tuple[Problem, Tensor, Tensor]:
    """The problem `in_time` with states X (B, N+1, n) and controls U (B, N, m) at the times (B, N+1), s, of its knots.

    All three as they are where the time isn't free.

    Raises:
        InputError: times that `factors_of` refuses, or times of a problem whose time isn't free.
    """
    if problem.time is None:
        if times is not None:
            raise InputError("times", "None, as the problem's time isn't free", "times")
        return problem, X, U
    factors = factors_of(problem, times)
    return in_time(problem, factors), *states_in_time(problem, X, U, factors)


def _switches(time: FreeTime, N: int) -> Tensor | None:
    """1 at the stages (N,) after which a new segment begins, else 0; None where there is one segment."""
    if time.count == 1:
        return None
    switches = time.least.new_zeros(N)
    switches[[first - 1 for first in time.segments[1:]]] = 1.0
    return switches


@dataclass(frozen=True)
class _Dynamics(WrappedDynamics):
    """A model whose stages last tau dt, with tau among its states."""

    taken: Carrying | None  # the further states
    switches: Tensor | None  # (N,): 1 at stages whose last control is the next tau
    k: Any = field(default=None, repr=False)  # the stage or the stages (K,), set by `at` where they differ

    batched: ClassVar[tuple[str, ...]] = ("model", "taken")

    calls_function = property(lambda self: is_users(self.model) or not isinstance(self.taken, Taken | None))
    n = property(lambda self: self.model.n + 1 + len(self.taken or ()))  # type: ignore[assignment]
    m = property(lambda self: self.model.m + (self.switches is not None))  # type: ignore[assignment]

    def at(self, k: int | Tensor) -> Self:
        same = self.switches is None and (self.taken is None or not self.taken.by_stage)
        return self if same else replace(self, k=k)

    def factor_controls(self, k: int) -> slice:
        """See `in_time.factor_controls`; stages where no segment ends have them, too."""
        return slice(0, 0) if self.switches is None else slice(self.m - 1, self.m)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """The derivative by the time that runs evenly from knot to knot, dt a stage."""
        n, model = self.model.n, self.model
        rates = x[..., n : n + 1] * model.field(model.settled(x[..., :n]), u[..., : model.m])
        return torch.cat((rates, torch.zeros_like(x[..., n:])), dim=-1)

    def settled(self, x: Tensor) -> Tensor:
        n = self.model.n
        return torch.cat((self.model.settled(x[..., :n]), x[..., n:]), dim=-1)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        n, m, model = self.model.n, self.model.m, self.model
        tau, v = x[..., n : n + 1], u[..., :m]
        rates = lambda z: tau * model.field(model.settled(z), v)
        ahead = model.settled(INTEGRATORS[model.integrator](rates, x[..., :n], model.dt))
        parts = [ahead, tau if self.switches is None else self._next(tau, u[..., m : m + 1])]
        if self.taken is not None:
            parts.append(self.taken.after(x[..., :n], v, x[..., n + 1 :], self.k, model, tau))
        return torch.cat(parts, dim=-1)

    def _next(self, tau: Tensor, chosen: Tensor) -> Tensor:
        if self.k is None:
            raise InputError("dynamics", "a stage, as in `dynamics.at(k).step(x, u)`", "none")
        switches = _of_stages(self.switches, self.k, tau[..., 0]).unsqueeze(-1)
        return switches * chosen + (1.0 - switches) * tau


def _of_stages(values: Any, k: int | Tensor, like: Tensor) -> Tensor:
    """Values (N,) of stage k or stages k (K,), shaped to fit `like` (B,), (B, S) or (B, K)."""
    return values[k].expand(like.shape)


def _cost(problem: Problem, time: FreeTime) -> Cost:
    dt = problem.dynamics.dt
    seconds = time.weight * dt
    pin = PIN * torch.where(seconds > 0, seconds, dt)
    idle = None if time.count == 1 else 1.0 - _switches(time, problem.N)  # type: ignore[operator]
    sizes = problem.n, problem.m
    if isinstance(problem.cost, QuadraticInFreeTime):
        return _QuadraticCost(problem.cost, *sizes, seconds, pin, idle)
    return _Cost(problem.cost, *sizes, seconds, pin, idle)


@dataclass(frozen=True)
class _Cost(WrappedCost):
    """A cost per time, and of the time itself."""

    n: int
    m: int
    seconds: Tensor  # (B,): cost of a stage of tau = 1
    pin: Tensor  # (B,): cost of a next tau that nobody reads, which makes the minimum strict
    idle: Tensor | None  # (N,): 1 at the stages of such ones

    batched: ClassVar[tuple[str, ...]] = ("cost", "seconds", "pin")

    def rest_controls(self, like: Tensor) -> Tensor:
        rest = self.cost.rest_controls(like[..., : self.m])
        return rest if self.idle is None else torch.cat((rest, torch.ones_like(rest[..., :1])), dim=-1)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        tau = x[..., self.n]
        value = tau * self._stage(x[..., : self.n], u[..., : self.m], k, tau) + lead(self.seconds, tau) * tau
        if self.idle is None:
            return value
        return value + lead(self.pin, tau) * _of_stages(self.idle, k, tau) * (u[..., self.m] - 1.0).square()

    def _stage(self, x: Tensor, u: Tensor, k: int | Tensor, tau: Tensor) -> Tensor:
        return self.cost.stage(x, u, k)

    def terminal(self, x: Tensor) -> Tensor:
        return self.cost.terminal(x[..., : self.n])

    def goal(self, x0: Tensor) -> None:
        """The problem has its goal already."""


@dataclass(frozen=True)
class _QuadraticCost(_Cost):
    """The same of a quadratic cost whose references follow the time."""

    cost: QuadraticInFreeTime

    def _stage(self, x: Tensor, u: Tensor, k: int | Tensor, tau: Tensor) -> Tensor:
        return self.cost.stage_at(x, u, k, tau)

    def terminal(self, x: Tensor) -> Tensor:
        return self.cost.terminal_at(x[..., : self.n], x[..., self.n])


def _bounds(whole: Problem, time: FreeTime, n: int) -> list[Constraint]:
    """Bounds on the factors: of the first in the start, of the others where they are chosen."""
    model, x0 = whole.dynamics, whole.x0
    dims = Dimensions(len(x0), whole.N, whole.n, whole.m, model.dt, model.position, x0, 1)
    first = [x0.new_full((len(x0), whole.n), free) for free in (-torch.inf, torch.inf)]
    for bound, factors in zip(first, (time.least, time.most), strict=True):
        bound[:, n] = factors[:, 0]
    bounds: list[Constraint] = [StateBounds(*first, knots=[0]).bind(dims)]
    if time.count > 1:
        later = [x0.new_full((len(x0), time.count - 1, whole.m), free) for free in (-torch.inf, torch.inf)]
        for bound, factors in zip(later, (time.least, time.most), strict=True):
            bound[..., -1] = factors[:, 1:]
        bounds.append(ControlBounds(*later, knots=[k - 1 for k in time.segments[1:]]).bind(dims))
    return bounds


@dataclass(frozen=True)
class Elapsed:
    """Where the knots of what is left of trajectories lie on these.

    Attributes:
        factors: of what is left, within the bounds, (B, S).
        place: of each knot among the knots of before, (B, N+1), from 0 to N.
        lengths: of its stage, as a multiple of the length of the one that it lies in, (B, N+1).
    """

    factors: Tensor
    place: Tensor
    lengths: Tensor

    @classmethod
    def of(cls, problem: Problem, factors: Tensor, seconds: float) -> Elapsed:
        """That of problems with a free time, of trajectories with factors (B, S), so many seconds later.

        The knots of the segment that is under way, and of those before, lie evenly from now to its end; later segments
        last as long as before.
        """
        time = problem.time
        assert time is not None
        firsts, dt, N = [*time.segments, problem.N], float(problem.dynamics.dt), problem.N
        sizes = factors.new_tensor([b - a for a, b in itertools.pairwise(firsts)])
        ends = (dt * sizes * factors).cumsum(-1)
        under_way = (ends <= seconds).sum(-1, keepdim=True).clamp(max=time.count - 1)
        even = (ends.gather(1, under_way) - seconds).clamp(min=0.0) / (dt * sizes.cumsum(0)[under_way])
        left = torch.where(torch.arange(time.count, device=factors.device) <= under_way, even, factors)
        old, new = times_of(problem, factors), seconds + times_of(problem, left)
        k = (torch.searchsorted(old, new, right=True) - 1).clamp(0, N - 1)
        stage = old.diff(dim=1)
        index = k + ((new - old.gather(1, k)) / stage.gather(1, k)).clamp(0.0, 1.0)
        durations = new.diff(dim=1)
        lengths = torch.cat((durations, durations[:, -1:]), dim=1) / stage.gather(1, k)
        return cls(left.clamp(time.least, time.most), index, lengths)

    def states(self, X: Tensor) -> Tensor:
        """Those (B, N+1, n) at the knots of what is left, on straight lines between X (B, N+1, n)."""
        return _between(X, self.place)

    def controls(self, U: Tensor, stages: Tensor) -> Tensor:
        """The means (B, N, m) of controls U (B, N, m), whose `stages` (B, N) lasted, s, over those of what is left."""
        added = (U * stages.unsqueeze(-1)).cumsum(1)
        added = torch.cat((torch.zeros_like(added[:, :1]), added), dim=1)
        over = torch.cat((torch.zeros_like(stages[:, :1]), stages.cumsum(1)), dim=1).unsqueeze(-1)
        lasts = _between(over, self.place).diff(dim=1)
        first = self.place[:, :-1].floor().clamp(max=U.shape[1] - 1).long().unsqueeze(-1).expand(-1, -1, U.shape[-1])
        means = _between(added, self.place).diff(dim=1) / torch.where(lasts > 0, lasts, 1.0)
        return torch.where(lasts > 0, means, U.gather(1, first))

    def multipliers(self, lam: Sequence[Tensor], knots: Sequence[Sequence[int]]) -> tuple[Tensor, ...]:
        """Multipliers (B, K, p) of rows at these knots: where the knots follow each other those of the same times, as
        they are of the lengths of the stages; elsewhere as before."""
        return tuple(self._along(values, indices) for values, indices in zip(lam, knots, strict=True))

    def _along(self, lam: Tensor, indices: Sequence[int]) -> Tensor:
        if len(indices) < 2 or lam.shape[2] == 0 or list(indices) != list(range(indices[0], indices[0] + len(indices))):
            return lam
        rows = slice(indices[0], indices[-1] + 1)
        index = (self.place[:, rows] - indices[0]).clamp(0.0, len(indices) - 1.0)
        return self.lengths[:, rows].unsqueeze(-1) * _between(lam, index)


def _between(values: Tensor, index: Tensor) -> Tensor:
    """Values (B, K, ...) at places (B, L) within 0..K-1, on straight lines."""
    k = index.floor().long().clamp(0, max(0, values.shape[1] - 2))
    share = (index - k).unsqueeze(-1)
    low, high = (values.gather(1, i.unsqueeze(-1).expand(-1, -1, values.shape[-1])) for i in (k, k + 1))
    return (1.0 - share) * low + share * high  # exact at both ends; exported C rounds alike, which it doesn't as lerp
