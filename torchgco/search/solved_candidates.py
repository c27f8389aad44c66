"""Candidates solved by the interior point as they are, and what is sound at the end of a search: nothing of it is lost.

Passes choose by cost at the knots, and what is found last may touch an obstacle between two of them. Nor does a search
have to find the way of its guess again, as all passes but the first begin elsewhere; and where it finds nothing, coming
to rest may still be sound.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.kernels import chord_clearance, measured
from torchgco.lagrangian.lagrangian import Iterate, Multipliers, SolveEnd
from torchgco.lagrangian.quality import has_arrived, leaves_goal, outside_goal
from torchgco.problem.problem import Problem
from torchgco.receding.holding import held
from torchgco.search.candidates import Candidates, Refine, Refined
from torchgco.search.finish import WORTH, ClearChords, Converge, clear_further, solved_nearby
from torchgco.search.following import Paths
from torchgco.search.proposals import Part
from torchgco.search.search import Search, is_sound
from torchgco.solvers.ending import STATIONARY
from torchgco.solvers.interior import InteriorPoint

LAST_DEPTH = 0.8  # depth in an obstacle, in R, of candidates that come after all others
CUT = 0.3  # depth between two knots, in R, of solved ones that don't count beside others: that may be through a wall
# From a trajectory that is clear, a barrier of 0.1 leads into other classes; the last row of a table goes on from here.
SOLVER = InteriorPoint(tolerance=1e-4, max_iterations=300, initial_barrier=1e-3)
SAME = 1e-3  # share of the cost by which solved candidates of one way differ
BOTH = Refine(top=2)  # marks candidates as solved in the record


def in_order(candidates: Candidates) -> Tensor:
    """Places (B, count) of each problem's candidates: live ones that aren't deep in an obstacle first, then cheap.

    What a candidate costs as it is says more of what it will cost than its depth does, which will be repaired.
    """
    merit = torch.full_like(candidates.unit, torch.inf)
    for rows in candidates.parts():
        merit[rows] = candidates.of(rows).cost.total(candidates.X[rows], candidates.U[rows])
    order = merit.nan_to_num(torch.inf).view(-1, candidates.count).argsort(dim=-1, stable=True)
    deep, dead = candidates.penetration() > LAST_DEPTH * candidates.R, ~candidates.live
    last = torch.where(dead, 2, deep.to(torch.int8)).view(-1, candidates.count)
    return order.gather(1, last.gather(1, order).argsort(dim=-1, stable=True))


def solved(search: Search, rows: Tensor, chosen: Candidates, grown: Tensor | None = None) -> Refined:
    """Every chosen candidate solved; of each problem in `rows` the best that is feasible and arrives is kept.

    None that steps over an obstacle from one knot to the next counts; where that leaves none, they are solved again
    among larger obstacles. Obstacles have `grown` (b,), m, for the solves.
    """
    problem, limit = chosen.problem, search.solver.violation_tolerance
    finite = [torch.isfinite(part).flatten(1).all(-1) for part in (chosen.X, chosen.U)]
    some = (chosen.live & finite[0] & finite[1]).nonzero().flatten()
    made = chosen.iterations
    multipliers = Multipliers(tuple(chosen.U.new_zeros(0, *s) for s in problem.row_shapes), chosen.unit)
    if some.numel() == 0:
        return Refined(chosen, multipliers, some.new_zeros(problem.B), torch.full_like(chosen.unit, torch.inf))
    call = replace(search.call.take(rows[some // chosen.count]), U0=chosen.U[some], warm=None, callback=None)
    if grown is None:
        end = solved_nearby(SOLVER, call, chosen.X[some])
    else:
        larger = replace(call, problem=call.problem.grown(grown[some // chosen.count]))
        end = solved_nearby(SOLVER, larger, chosen.X[some])
        end = replace(end, best=replace(end.best, violation=measured(call.problem, end.best.X, end.best.U)))
    cost, clear = _merits(call.problem, end, chosen, some, limit)
    without = ~torch.isfinite(cost.view(problem.B, -1)).any(1)
    touching = (without[some // chosen.count] & _fits(call.problem, end, limit)).nonzero().flatten()
    if touching.numel() > 0 and not call.late:  # steps are longer than the vehicle is wide
        again = take(end, touching)
        clear_further(search, call.take(touching), again)
        put(end, touching, again)
        cost, clear = _merits(call.problem, end, chosen, some, limit)
    made = made.index_add(0, some // chosen.count, end.iterations)
    for merit in (clear, cost):  # the cheapest that is clear between knots, too, is remembered by `Best.keep`
        _keep(search, rows, chosen.count, some, end, merit, made)
        made = torch.zeros_like(made)
    without = ~torch.isfinite(clear.view(problem.B, -1)).any(1, keepdim=True)
    _remember(search, rows, some, end, torch.where(without, cost.view(problem.B, -1), torch.inf))
    best = cost.view(-1, chosen.count).argmin(1) + torch.arange(problem.B, device=rows.device) * chosen.count
    X, U = chosen.X.clone(), chosen.U.clone()
    X[some], U[some] = end.best.X, end.best.U
    return Refined(replace(chosen, X=X, U=U), multipliers, best, cost)


def _fits(problem: Problem, end: SolveEnd, limit: float) -> Tensor:
    """Which solved candidates keep all rows at the knots and arrive, (b,) bool."""
    return (end.best.violation <= limit) & has_arrived(problem, end.best.X)


def _merits(problem: Problem, end: SolveEnd, chosen: Candidates, some: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The costs (B * count,) of candidates, infinite where one doesn't count, and of those alone that are clear.

    Args:
        end: how candidates `some` (b,) have ended.
    """
    cost = torch.full_like(chosen.unit, torch.inf)
    clear, fits = cost.clone(), _fits(problem, end, limit).nonzero().flatten()
    if fits.numel() > 0:  # others may end anywhere
        clearance = chord_clearance(problem.take(fits), end.best.X[fits])
        for merit, least in ((cost, -CUT * chosen.R[some[fits]]), (clear, torch.zeros_like(clearance))):
            merit[some[fits]] = torch.where(clearance >= least, end.best.cost[fits], torch.inf)
    return cost, clear


def solve_cheapest(
    search: Search,
    rows: Tensor,
    part: Part,
    paths: Paths,
    candidates: Candidates,
    count: int,
    others: Tensor | None = None,
) -> None:
    """Solve the first of the candidates `in_order`, `count` for each problem in `rows`, and record what became of all.

    Args:
        part: the same problems, with the paths that the candidates follow.
        others: (B * candidates,) bool: candidates of which as many are solved beside the first of the rest.
    """
    kinds = [candidates.live] if others is None else [candidates.live & ~others, candidates.live & others]
    orders = [in_order(replace(candidates, live=live))[:, :count] for live in kinds]
    live = [kind.view(rows.numel(), -1).gather(1, order) for kind, order in zip(kinds, orders, strict=True)]
    chosen = replace(candidates.pick(torch.cat(orders, dim=1)), live=torch.cat(live, dim=1).flatten())
    search.best.end.iterations[rows] += part.proposal.iterations  # of the trajectories without constraints
    ends = solved(search, rows, chosen)
    if search.record is not None:
        every, found = torch.arange(rows.numel(), device=rows.device), ends.cost[ends.best].isfinite()
        part.note(every, paths, BOTH, candidates, chosen, chosen.live, ends, found)


def _keep(search: Search, rows: Tensor, count: int, some: Tensor, end: SolveEnd, merit: Tensor, made: Tensor) -> None:
    """Keep the solved candidate of least merit (B * count,) of each problem in `rows`; `made` (B,) iterations."""
    least, at = merit.view(-1, count).min(1)
    place = torch.full_like(merit, -1, dtype=torch.int64)
    place[some] = torch.arange(some.numel(), device=some.device)
    chosen = place.view(-1, count).gather(1, at.unsqueeze(1))[:, 0]
    found = torch.isfinite(least).nonzero().flatten()
    one = take(end, chosen[found])
    one.status[:] = int(Status.MAX_ITERATIONS)  # the last row brings it to its own tolerance
    one.iterations[:] = made[found]
    search.best.keep(rows[found], one)
    lost = (~torch.isfinite(least)).nonzero().flatten()
    search.best.end.iterations[rows[lost]] += made[lost]


def _remember(search: Search, rows: Tensor, some: Tensor, end: SolveEnd, touching: Tensor) -> None:
    """Of each problem in `rows` that has no clear candidate, the cheapest of each other way than the best's.

    Args:
        some: places of the solved candidates among all, whose costs are `touching` (B, count), infinite where one
            doesn't count.
    """
    place = {at: i for i, at in enumerate(some.tolist())}
    for b, costs in enumerate(touching.tolist()):
        others, last = list[SolveEnd](), None
        for cost, k in sorted((cost, k) for k, cost in enumerate(costs) if cost < torch.inf):
            if last is not None and cost > last + SAME * abs(last):
                others.append(take(end, some.new_tensor([place[b * len(costs) + k]])))
            last = cost
        search.best.others[int(rows[b])] = others


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
    problem, best, guess, sound = call.problem, end.best, search.guess, search.best.sound
    # A stationary trajectory may leave something to save.
    tight = torch.where(end.status == Status.CONVERGED, STATIONARY, search.interior.tolerance)
    cheaper = guess.cost < best.cost - _worth(search, problem, tight, best.cost, guess.violation, best.violation)
    better = ~sound | (~_falls_short(problem, guess.X, best.X) & (cheaper | _falls_short(problem, best.X, guess.X)))
    better &= (guess.violation <= limit) & torch.isfinite(guess.cost) & (end.status != Status.INVALID_START)
    rows = better.nonzero().flatten()
    if rows.numel() == 0:
        return rows, best
    guess, old = take(guess, rows), take(best.multipliers, rows)
    guess = replace(guess, multipliers=Multipliers(tuple(torch.zeros_like(lam) for lam in old.lam), old.mu))
    clear = is_sound(problem.take(rows), guess, limit).nonzero().flatten()
    return rows[clear], take(guess, clear)


def _ways_to_rest(search: Search) -> tuple[Tensor, Iterate]:
    """The problems (b,) without a sound trajectory that one would serve which comes to rest, and these trajectories.

    A required goal isn't where a vehicle comes to rest.
    """
    call, end, limit = search.call, search.best.end, search.solver.violation_tolerance
    problem, best = call.problem, end.best
    rows = (~search.best.sound & (end.status != Status.INVALID_START)).nonzero().flatten()
    if problem.dynamics.dt is None or call.late or (problem.goal is not None and problem.goal.required):
        rows = rows[:0]
    if rows.numel() > 0:
        rows = rows[torch.isfinite(problem.x0[rows]).all(-1)]
    if rows.numel() == 0:
        return rows, best
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


def _worth(
    search: Search, problem: Problem, tight: Tensor | float, cost: Tensor, violation: Tensor, other: Tensor
) -> Tensor:
    """By how much (B,) a trajectory has to be cheaper than another one of this cost, by their violations.

    Args:
        tight: the share of the cost where it violates by no more.
    """
    loose, scale = violation > other.clamp(min=search.interior.admitted(search.call.problem)), problem.cost_scale
    return torch.where(loose, WORTH, tight) * ((cost - scale.constant).abs() + scale.size)


def _go_on(search: Search, rows: Tensor, guess: Iterate) -> None:
    """The interior point from sound guesses; what is sound, too, and costs no more takes their places."""
    call = replace(search.call.take(rows), callback=None, warm=None)
    solver = replace(search.interior, initial_barrier=SOLVER.initial_barrier)
    end = solved_nearby(solver, call, guess.X)
    clear_further(search, call, end)
    new = end.best
    more = _worth(search, call.problem, search.interior.tolerance, guess.cost, guess.violation, new.violation)
    serves = is_sound(call.problem, new, search.solver.violation_tolerance) & torch.isfinite(new.cost)
    serves &= ~_falls_short(call.problem, new.X, guess.X) & (new.cost <= guess.cost + more)
    search.best.replace(rows, serves, new, end)
