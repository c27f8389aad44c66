"""Free time: how long the stages of a problem may last, and what a second costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import MISTAKES, Dimensions, tensor
from torchgco.base.tree import PerElement
from torchgco.constraints.base import resolve_knots
from torchgco.costs.quadratic import QuadraticInFreeTime

A_CLOCK = "time as a state of the model's own, whose derivative is 1, says what it is"
ALIKE = 1e-9  # difference of a stage cost from that of another stage, as a share, that is no dependence on the stage


@dataclass(frozen=True)
class FreeTime(PerElement):
    """The duration of a trajectory is chosen, too: minimum time, free final time, one duration per phase.

    A stage lasts tau dt, with one factor tau for all stages of a segment. A model of x' = field(x, u) is integrated
    over the longer or shorter stages; stage costs, which stand for an integral, are multiplied by tau; `RateBounds`,
    which are per stage of dt, too. All factors are of the problem's own N dt.

        Problem(model, cost, constraints, x0, N=60, time=FreeTime(least=0.2, most=5.0, weight=1.0))

    Args:
        least, most: bounds of tau, above 0: numbers, or one per problem (B,), or per segment (B, S).
        weight: cost per second, at least 0: a number or (B,). At 0 the time is free of charge.
        guess: where the search for tau begins, as `least`. None: one and a half times an estimate from the bounds on
            controls. Too long a guess does little harm; from too short a one a solve may end where nothing can be
            reached, and is repeated with twice the time.
        segments: the number of segments, of equally many stages as far as N allows, or the knots within 1..N-1 at which
            a new one begins; each has a factor of its own. None: one for the whole trajectory.

    Raises:
        InputError: on `Problem(...)`: bounds crossed or not above 0, a guess outside of them, a negative weight, wrong
            shapes; a model that can't be integrated over other stages, or parts that follow the time of fixed ones.
    """

    least: Any = 0.5
    most: Any = 3.0
    weight: Any = 1.0
    guess: Any = None
    segments: Any = None

    batched: ClassVar[tuple[str, ...]] = ("least", "most", "weight", "guess")

    def bind(self, dims: Dimensions) -> Self:
        """The same for one problem: least, most and guess (B, S), weight (B,), segments the first stage of each."""
        firsts = _firsts(self.segments, dims)
        shape = dims.B, len(firsts)
        least, most = (_factors(getattr(self, name), f"time.{name}", shape, dims.like) for name in ("least", "most"))
        if not bool((least > 0).all()):
            raise InputError("time.least", "a factor of N dt above 0", float(least.min()))
        if bool((least > most).any()):
            b, s = (least > most).nonzero()[0].tolist()
            raise InputError("time.least", f"at most time.most = {float(most[b, s]):g}", float(least[b, s]))
        guess = None if self.guess is None else _factors(self.guess, "time.guess", shape, dims.like)
        if guess is not None and bool(((guess < least) | (guess > most)).any()):
            b, s = ((guess < least) | (guess > most)).nonzero()[0].tolist()
            within = f"{float(least[b, s]):g} to {float(most[b, s]):g}, as time.least and time.most"
            raise InputError("time.guess", within, float(guess[b, s]))
        weight = _factors(self.weight, "time.weight", (dims.B,), dims.like)
        if bool((weight < 0).any()):
            raise InputError("time.weight", "a cost per second of at least 0", float(weight.min()))
        return type(self)(least, most, weight, guess, firsts)

    @property
    def count(self) -> int:
        """The number of segments, once bound."""
        return len(self.segments)

    def of_stages(self, N: int) -> Tensor:
        """The segment of each stage, (N,) int64."""
        begins = torch.zeros(N, dtype=torch.int64, device=self.least.device)
        begins[list(self.segments[1:])] = 1
        return begins.cumsum(0)


def _firsts(segments: Any, dims: Dimensions) -> tuple[int, ...]:
    """The first stage of every segment."""
    field, N = "time.segments", dims.N
    value: Any = segments
    if segments is None:
        return (0,)
    if isinstance(segments, int) and not isinstance(segments, bool):
        if not 1 <= segments <= N:
            raise InputError(field, f"1 to N = {N} segments, or the knots at which they begin", segments)
        return tuple(round(s * N / segments) for s in range(segments))
    if isinstance(segments, tuple) and segments[:1] == (0,) and all(type(k) is int and k < N for k in segments):
        return segments  # bound before
    knots = resolve_knots(value, N, field, dims.like.device)
    firsts = [int(k) for k in torch.arange(N + 1)[knots if isinstance(knots, slice) else knots.cpu()]]
    if firsts != sorted(firsts) or firsts[0] < 1 or firsts[-1] > N - 1:
        raise InputError(field, f"knots within 1..{N - 1}, in their order", firsts)
    return 0, *firsts


def _factors(value: Any, field: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Numbers of this shape, (B,) or (B, S), from one, from (B,) or from all."""
    raw = tensor(value, field, like)
    whole = raw.unsqueeze(-1) if raw.dim() == 1 and len(shape) == 2 and raw.shape[0] == shape[0] else raw
    try:
        expanded = whole.expand(shape)
    except RuntimeError:
        raise InputError(field, f"a number, or shape {shape}", tuple(raw.shape)) from None
    if not bool(torch.isfinite(expanded).all()):
        raise InputError(field, "finite numbers", shown(value))
    return expanded.contiguous()


def check_served(problem: Any) -> None:
    """Refuse, in one line each, what a free time doesn't serve.

    Raises:
        InputError: names the part, and says what would do.
    """
    model, cost = problem.dynamics, problem.cost
    if problem.horizon is not None:
        raise InputError("time", "problems without a horizon of their own: a free time is one already", "horizon")
    if getattr(model, "dt", None) is None:
        raise InputError("dynamics.dt", "a time step, whose multiple the length of a stage is", "none")
    if not model.stretches:
        got = f"{type(model).__name__}, which makes whole steps"
        raise InputError("dynamics", "a model of x' = field(x, u) where the time is free", got)
    if model.at(0) is not model:
        raise InputError("dynamics", f"the same model at all stages where the time is free; {A_CLOCK}", "one per stage")
    if _depends_on_stage(problem):
        raise InputError("cost", f"the same cost at all stages where the time is free; {A_CLOCK}", "one per stage")
    if isinstance(cost, QuadraticInFreeTime) and problem.time.count > 1:
        raise InputError("time.segments", "None where x_ref follows the time", f"{problem.time.count} segments")
    for i, constraint in enumerate(problem.constraints):
        if getattr(constraint, "moving", False):
            if constraint.in_free_time(problem.n, problem.m, 0) is constraint:
                expected = "where the time is free, obstacles at rest, or Spheres that a ball is clear of"
                raise InputError(
                    f"constraints[{i}]", expected, f"{type(constraint).__name__.removeprefix('Bound')} that move"
                )
            if problem.time.count > 1:
                raise InputError("time.segments", "None among obstacles that move", f"{problem.time.count} segments")


def _depends_on_stage(problem: Any) -> bool:
    """Whether the cost of a stage is another one at another stage, near the start."""
    x = problem.x0 + 1e-3 * (1.0 + problem.x0.abs()) * scattered(problem.x0)
    u = problem.x0.new_zeros(problem.B, problem.m)
    X, U = (z.unsqueeze(1).expand(-1, problem.N, -1).contiguous() for z in (x, u + 1e-3 * (1.0 + 0.5 * scattered(u))))
    cost = problem.cost.of_errors if isinstance(problem.cost, QuadraticInFreeTime) else problem.cost
    try:
        value = cost.stage(X, U, torch.arange(problem.N, device=X.device))
    except MISTAKES:
        return False  # what is wrong there is told elsewhere
    first = value[:, :1]
    return bool(((value - first).abs() > ALIKE * (1.0 + first.abs())).any())
