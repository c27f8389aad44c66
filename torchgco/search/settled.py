"""What is sound isn't lost at the end of a search: trajectories that others replaced, the given guess, ways to rest.

Passes choose by cost at the knots, and what is found last may touch an obstacle between two of them. Nor does a search
have to find the way of its guess again, as all passes but the first begin elsewhere; and where it finds nothing, coming
to rest may still be sound.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.base.tree import take
from torchgco.kernels import measured, open_loop
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.quality import leaves_goal, outside_goal
from torchgco.lagrangian.state import Iterate, SolveEnd
from torchgco.problem.problem import Problem
from torchgco.receding.holding import held
from torchgco.search.best import is_sound
from torchgco.search.chords import ClearChords, clear_further
from torchgco.search.converge import WORTH, Converge, solved_nearby
from torchgco.search.search import Search
from torchgco.search.solved_candidates import SOLVER


def settle(search: Search, chords: ClearChords | None) -> None:
    """Clear what touches at the end of all passes, then fall back on what is sound, and go on from there.

    Args:
        chords: the row that clears; None: there is none.
    """
    if chords is not None and not search.call.late:
        chords.run(search)
    search.best.settle()
    for candidates in (_better_guesses, _ways_to_rest):
        rows, sound = candidates(search)
        if rows.numel() == 0:
            continue
        none = torch.zeros_like(rows)
        ended = SolveEnd(sound, sound, torch.full_like(rows, int(Status.MAX_ITERATIONS)), none, none, none)
        search.best.replace(rows, torch.ones_like(rows, dtype=torch.bool), sound, ended)
        if not search.call.late and Converge.worth(search.call.problem):
            _go_on(search, rows, sound)


def _better_guesses(search: Search) -> tuple[Tensor, Iterate]:
    """The problems (b,) whose guess is better than the best trajectory, and these guesses.

    That is a sound guess: where the best trajectory isn't sound, doesn't arrive as the guess does, or costs more, by
    more than the solver's tolerance, or by more than what a smaller violation is worth.
    """
    call, end, limit = search.call, search.best.end, search.solver.violation_tolerance
    problem, best = call.problem, end.best
    X, sound = open_loop(problem, call.U0), is_sound(problem, best, limit, search.best.clearance)
    rows = ((~sound | ~_falls_short(problem, X, best.X)) & (end.status != Status.INVALID_START)).nonzero().flatten()
    if rows.numel() == 0:
        return rows, best
    asked, X, U, old = problem.take(rows), X[rows], call.U0[rows], take(best, rows)
    cost, violation = asked.cost.total(X, U), measured(asked, X, U)
    cheaper = cost < old.cost - _worth(search, violation, old.violation) * old.cost.abs()
    better = ~sound[rows] | _falls_short(asked, old.X, X) | cheaper
    better = (better & (violation <= limit) & torch.isfinite(cost)).nonzero().flatten()
    lam = tuple(torch.zeros_like(rows_of[better]) for rows_of in old.multipliers.lam)
    guess = Iterate(X[better], U[better], Multipliers(lam, old.multipliers.mu[better]), cost[better], violation[better])
    clear = is_sound(asked.take(better), guess, limit).nonzero().flatten()
    return rows[better[clear]], take(guess, clear)


def _ways_to_rest(search: Search) -> tuple[Tensor, Iterate]:
    """The problems (b,) without a sound trajectory that one would serve which comes to rest, and these trajectories.

    A required goal isn't where a vehicle comes to rest.
    """
    call, end, limit = search.call, search.best.end, search.solver.violation_tolerance
    problem, best = call.problem, end.best
    rows = (~is_sound(problem, best, limit) & (end.status != Status.INVALID_START)).nonzero().flatten()
    if problem.dynamics.dt is None or call.late or (problem.goal is not None and problem.goal.required):
        rows = rows[:0]
    if rows.numel() > 0:
        rows = rows[torch.isfinite(problem.x0[rows]).all(-1)]
    if rows.numel() == 0:
        return rows, take(best, rows)
    asked, old = problem.take(rows), take(best, rows)
    found = held(asked, None, 0.0)
    cost, violation = asked.cost.total(found.X, found.U), measured(asked, found.X, found.U)
    lam = tuple(torch.zeros_like(one) for one in old.multipliers.lam)
    ways = Iterate(found.X, found.U, Multipliers(lam, old.multipliers.mu), cost, violation)
    sound = (is_sound(asked, ways, limit) & torch.isfinite(cost)).nonzero().flatten()
    return rows[sound], take(ways, sound)


def _falls_short(problem: Problem, X: Tensor, other: Tensor) -> Tensor:
    """Whether states (B, N+1, n) end farther from a stated goal than others, by its tolerance or its ball, (B,)."""
    return leaves_goal(problem, X, other) | (outside_goal(problem, X) & ~outside_goal(problem, other))


def _worth(search: Search, violation: Tensor, other: Tensor) -> Tensor:
    """The share (B,) of the cost by which a trajectory has to be cheaper than another one, by their violations."""
    loose = violation > other.clamp(min=search.interior.admitted(search.call.problem))
    return torch.where(loose, WORTH, search.interior.tolerance)


def _go_on(search: Search, rows: Tensor, guess: Iterate) -> None:
    """The interior point from sound guesses; what is sound, too, and costs no more takes their places."""
    call = replace(search.call.take(rows), callback=None, warm=None)
    solver = replace(search.interior, initial_barrier=SOLVER.initial_barrier)
    end = solved_nearby(solver, call, guess.X)
    clear_further(search, call, end)
    new, share = end.best, _worth(search, guess.violation, end.best.violation)
    serves = is_sound(call.problem, new, search.solver.violation_tolerance) & torch.isfinite(new.cost)
    serves &= ~_falls_short(call.problem, new.X, guess.X) & (new.cost <= guess.cost + share * guess.cost.abs())
    search.best.replace(rows, serves, new, end)
