"""Several guesses per problem: all are solved in one batch, and the best result of each problem is kept."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import HorizonWarning, InputError, shown
from torchgco.base.shapes import check_shape, tensor
from torchgco.base.tree import PerElement, put, take
from torchgco.explaining.explain import Account
from torchgco.explaining.record import GuessRecord
from torchgco.lagrangian.quality import is_preferred
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.in_time import factors_of, guessing_times
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import LEAST_SECONDS, Callback, Solver
from torchgco.solvers.ending import STATIONARY, touches

COUNTS = "iterations", "outer_iterations", "guided"
TRAJECTORY = "X", "U", "K", "d", "multipliers", "cost", "violation", "status"


@dataclass(frozen=True)
class Guess(PerElement):
    """Where a solve begins; what is None, it chooses as it does without a guess.

        torchgco.solve(problem, guesses=[Guess(U0=left), {"U0": right}, Guess(), solution])

    A dict of the arguments serves as well, and an earlier solution, without its multipliers. All are solved in one
    batch, and the best result of each problem is kept: `solution.guess` says from which, and
    `solution.guesses.to_frame()` what became of each.

    Args:
        U0: controls (B, N, m), or (N, m) for all problems.
        X0: states (B, N+1, n), or (N+1, n) for all problems, for solvers that begin with states.
        times: of the knots (B, N+1), or (N+1,) for all problems, s, where the time is free.

    Raises:
        InputError: on `solve`: other shapes, times that don't rise or where the time isn't free, or none beside states
            where it is.
    """

    U0: Any = None
    X0: Any = None
    times: Any = None

    batched: ClassVar[tuple[str, ...]] = ("U0", "X0", "times")

    def bind(self, problem: Problem, field: str) -> Guess:
        """The guess with one row per problem."""
        sizes = {"U0": (problem.N, problem.m), "X0": (problem.N + 1, problem.n), "times": (problem.N + 1,)}
        given = {name: getattr(self, name) for name in sizes}
        made = {
            name: None if value is None else _per_problem(value, f"{field}.{name}", problem, sizes[name])
            for name, value in given.items()
        }
        if made["times"] is not None:
            if problem.time is None:
                raise InputError(f"{field}.times", "None, as the problem's time isn't free", "times")
            if not bool((made["times"].diff(dim=1) > 0).all()):
                raise InputError(f"{field}.times", "times that rise from knot to knot", "others")
            factors_of(problem, made["times"])
        return Guess(**made)


def guesses_of(guesses: Any, problem: Problem) -> tuple[Guess, ...]:
    """The guesses of `torchgco.solve`, bound.

    Raises:
        InputError: none, something else, two that are the same, or states or times of some guesses alone.
    """
    expected = 'guesses, such as [Guess(U0=...), {"U0": ..., "X0": ...}, solution]'
    if not isinstance(guesses, Sequence) or isinstance(guesses, str) or not guesses:
        raise InputError("guesses", f"a list of {expected}", shown(guesses))
    bound, names = [], [f.name for f in fields(Guess)]
    for i, guess in enumerate(guesses):
        if isinstance(guess, Solution):
            guess = guess.detach()
            guess = Guess(guess.U, *(() if problem.time is None else (guess.X, guess.t)))
        if isinstance(guess, Mapping) and set(guess) <= set(names):
            guess = Guess(**guess)
        if not isinstance(guess, Guess):
            raise InputError(f"guesses[{i}]", f"one of the {expected}", shown(guess))
        bound.append(guess.bind(problem, f"guesses[{i}]"))
    for name in ("X0", "times"):
        missing = [i for i, guess in enumerate(bound) if getattr(guess, name) is None]
        if 0 < len(missing) < len(bound):
            raise InputError(f"guesses[{missing[0]}].{name}", f"{name} in all guesses, or in none", "None")
    for j, guess in enumerate(bound):
        for i, other in enumerate(bound[:j]):
            if all(_is_same(getattr(guess, name), getattr(other, name)) for name in names):
                raise InputError(f"guesses[{j}]", "guesses that differ", f"the same as guesses[{i}]")
    return tuple(bound)


def solve_guesses(
    solver: Solver,
    guesses: Sequence[Guess],
    problem: Problem,
    default: Tensor,
    seed: int,
    ids: Tensor | None,
    callback: Callback | None,
    max_seconds: float | None,
) -> Solution:
    """The best solution of each problem from several guesses; `solution.guess` says from which.

    All problems times guesses are one batch. Where the solver searches, or tries times, by itself, a local one solves
    from the guesses, as the search would be the same from each; then the solver goes on from the best.

    Args:
        guesses: bound.
        default: controls (B, N, m) to begin with where a guess has none.
    """
    k, ends = len(guesses), None if max_seconds is None else clock.seconds() + max_seconds
    rows = torch.arange(problem.B, device=problem.x0.device).repeat_interleave(k)
    whole, local = problem.take(rows), solver.from_guesses(problem)
    U0 = torch.stack([default if guess.U0 is None else guess.U0 for guess in guesses], 1).flatten(0, 1)
    X0, times = (
        None if getattr(guesses[0], name) is None else torch.stack([getattr(g, name) for g in guesses], 1).flatten(0, 1)
        for name in ("X0", "times")
    )
    whole = whole if times is None else guessing_times(whole, times)
    keys = rows if ids is None else ids[rows]  # each guess draws what it would draw alone
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HorizonWarning)  # which counts guesses as problems
        found = local.solve(whole, U0, seed, keys, None, callback if local is solver else None, max_seconds, X0)
    chosen = _best(problem, found, touches(whole, found), k)
    best, counts = found.take(chosen), {name: getattr(found, name).view(-1, k).sum(1) for name in COUNTS}
    if local is solver:
        kernels = None if found.account is None else found.account.kernels
        end = replace(best, account=Account(problem, solver, kernels=kernels), **counts)
    else:
        left = None if ends is None else max(LEAST_SECONDS, ends - clock.seconds())
        states = None if X0 is None else X0[chosen]
        options = {"seed": seed, "ids": ids, "callback": callback, "max_seconds": left}
        end = _continued(solver, problem, best, (U0[chosen], states), options)
        end = replace(end, **{name: getattr(end, name) + count for name, count in counts.items()})
    table = (getattr(found, name).view(-1, k) for name in ("cost", "violation", "status", "iterations"))
    return replace(end, guess=chosen % k, guesses=GuessRecord(*table))


def _best(problem: Problem, found: Solution, touching: Tensor, k: int) -> Tensor:
    """Where the best of each problem's k results (B k) lies, (B,): as `Best.keep` and `settle` compare them."""
    first = torch.arange(0, len(found), k, device=found.cost.device)
    best = first.clone()
    for j in range(1, k):
        new, old = found.take(first + j), found.take(best)
        better = is_preferred(problem, new, old, ADMITTED)
        both = (new.violation <= ADMITTED) & (old.violation <= ADMITTED)
        now, before = touching[first + j], touching[best]
        best = torch.where(torch.where(both & (now != before), before, better), first + j, best)
    return best


def _continued(
    solver: Solver, problem: Problem, best: Solution, guess: tuple[Tensor, Tensor | None], options: Mapping[str, Any]
) -> Solution:
    """What the solver makes of the best local solutions, by options of its `solve`; U0 (B, N, m) and maybe X0 are
    their guess."""
    U0, X0 = guess
    sound = (torch.isfinite(best.cost) & torch.isfinite(best.U).flatten(1).all(-1)).view(-1, 1, 1)
    U, X, start = torch.where(sound, best.U, U0), None, problem
    if problem.time is not None and best.times is not None:
        start = guessing_times(problem, best.times)
        X = torch.where(sound, best.X, problem.at_rest[0] if X0 is None else X0)
    elif problem.free_start is not None:
        start = problem.guessing(torch.where(sound[:, 0], best.X[:, 0], problem.x0))
    end = solver.solve(start, U, X0=X, **options)
    least = replace(end, cost=end.cost - STATIONARY * end.cost.abs())  # which may be left in a stationary one
    clear = ~touches(problem, best)
    rows = (is_preferred(problem, best, least, ADMITTED) & clear).nonzero().flatten()
    for name in (*TRAJECTORY, *(() if best.times is None else ("times",))):
        put(getattr(end, name), rows, take(getattr(best, name), rows))
    return end


def _per_problem(value: Any, field: str, problem: Problem, size: tuple[int, ...]) -> Tensor:
    values = tensor(value, field, problem.x0)
    values = values.expand(problem.B, *size) if values.shape == size else values
    check_shape(values, (problem.B, *size), field)
    return values


def _is_same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b if a is None or b is None else torch.equal(a, b)
