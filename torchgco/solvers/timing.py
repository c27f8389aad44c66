"""Solves of problems with a free time: from a long guess that obeys the model, and with the time held where that fails.

From a guess that doesn't obey the dynamics, the first step of a method may shorten the time until no trajectory is
left, and no local method gets out of that: a vehicle that moves away from its goal is closest to being at rest there
after the time it takes to stop. From a trajectory the same method converges in a few iterations, however long it takes.
So the guess is the trajectory of a linear model, from which the time is free at once. Where that fails, and among
obstacles, a trajectory at a held time is sought first; where there is none, at twice the time, up to the longest.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, smooth_normal, standard_normal
from torchgco.base.errors import NAMED, HorizonWarning
from torchgco.base.status import Status
from torchgco.base.tree import put, spread, take
from torchgco.constraints.gates import gates_of
from torchgco.costs.base import WrappedCost
from torchgco.kernels import open_loop, path_clearance
from torchgco.lagrangian.lagrangian import Iterate, Multipliers, SolveEnd
from torchgco.lagrangian.quality import is_better
from torchgco.problem.in_time import at_held_times, factors_in, fitting_factors, in_time, states_in_time, times_of
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.convexity import KNOTS, STREAM, controls_of, looks_convex
from torchgco.solvers.ending import appended, in_units
from torchgco.solvers.straight import Legs, LinearTime, straight_line

HELD_FIRST = 1.5  # the first time that is held, as a multiple of an estimate
HELD_NEXT = 2.0  # the next one, of the one before
AT_LEAST = 1.05  # a factor within this of `least` may have fallen there from too short a guess
BEYOND = 16.0  # how much longer than `most` a time is looked for that would do
DRAWN_TIMES, DRAWN_CONTROLS = 0.5, 0.5  # deviations of drawn guesses: in octaves, and of half a control's range
DRAWN_AGAIN = 4  # draws where nothing is feasible: of 36 goals close behind a car one draw reaches 27, four 35
NEAR = 1e-2  # violation up to which a rough solve says what a trajectory costs
SAME_TIME = 0.1  # difference of two times, as a share, that makes no other search


class Runs(Protocol):
    """A solver, of what `contracts.Call` holds."""

    def run(self, call: Any) -> Solution: ...
    def take_states(self, problem: Problem) -> bool: ...


@dataclass(frozen=True)
class Chooser:
    """What solves problems with a free time.

    Attributes:
        held: finds a trajectory at a time that is held.
        free: takes the time as a variable, from states to begin with.
        limit: violation up to which a trajectory is feasible.
        first: takes the time as a variable at once, in few iterations; None: it is held first.
        paces: shares of the times found at which it is searched again, as another way may be the better one there.
        through: takes the time of problems with gates as a variable at once; None: as of others.
        starts: drawn guesses of the time and the controls, from which it is taken as a variable, too, in the end.
        others: so many of problems that have converged.
        rough: solves from these roughly, without a verdict; None: there are none.
        arrivals: guesses with times of their own among obstacles that move: `search.arrivals`; None: there are none.
    """

    held: Runs
    free: Runs
    limit: float
    first: Runs | None = None
    paces: tuple[float, ...] = ()
    through: Callable[[Any], Solution] | None = None
    starts: int = 0
    others: int = 0
    rough: Callable[[Any], SolveEnd] | None = None
    arrivals: Any = None


class Timed:
    """One solve of problems with a free time.

    Args:
        problem: the user's.
        call: of the problem in free time, whose X0 and warm multipliers, where given, are guesses of the user.

    Attributes:
        best: the best trajectories, from the first attempt on, which is at all problems.
        clear: whether these touch no obstacle between two knots, (B,) bool.
        found: whether these were begun from a way among obstacles that move, (B,) bool: there is no use in other times.
    """

    best: Solution
    clear: Tensor

    def __init__(self, chooser: Chooser, problem: Problem, call: Any) -> None:
        self.chooser, self.problem, self.call = chooser, problem, call
        assert problem.time is not None
        self.time = problem.time
        self.through_gates = gates_of(problem) is not None and problem.dynamics.position is not None
        self.first = self._first()
        self.found = torch.zeros_like(problem.x0[:, 0], dtype=torch.bool)

    @cached_property
    def _line(self) -> Tensor:
        return straight_line(self.problem)

    @cached_property
    def _legs(self) -> Legs | None:
        return Legs.of(self.problem, self._line[:, -1])

    @cached_property
    def _steering(self) -> LinearTime:
        line, legs = self._line, self._legs
        if legs is not None:  # as long as the way to the stop that is farthest from the start
            line = line.clone()
            line[:, -1, self.problem.position] = legs.farthest
        return LinearTime(self.problem, line)

    @cached_property
    def _estimate(self) -> Tensor:
        """The factors (B, 1 or S) of the linear model, perhaps NaN: calls with states and times need none at first."""
        estimate, legs, time, N = self._steering.factors().unsqueeze(-1), self._legs, self.time, self.problem.N
        if legs is None:
            return estimate
        each = legs.stage_factors(torch.where(estimate.isnan(), 1.0, estimate), N)
        segments = time.of_stages(N)
        return each.new_zeros(len(each), time.count).index_add(1, segments, each) / torch.bincount(segments)

    @cached_property
    def own(self) -> Tensor:
        """`HELD_FIRST` times the estimate, within the bounds, (B, S)."""
        factors = HELD_FIRST * torch.where(self._estimate.isnan(), 1.0, self._estimate)
        return factors.clamp(self.time.least, self.time.most)

    @cached_property
    def _guess(self) -> tuple[Tensor, Tensor]:
        """States and controls of the user's problem to begin with."""
        U = self.call.U0[..., : self.problem.m]
        if self.call.X0 is not None or self.through_gates:
            return self._line, U
        return self._steering.guess(self.first.amax(-1), U)

    def run(self) -> Solution:
        """Solve at longer and longer times; see the module."""
        rows, time = torch.arange(self.problem.B, device=self.problem.x0.device), self.time
        guess, again = self.first, torch.zeros_like(rows)
        has_states = self.call.X0 is not None
        if self.chooser.arrivals is not None and time.count == 1 and self.call.warm is None:
            rows = self._arrived(rows, guess)
        while rows.numel() > 0:
            self._tried(rows, guess[rows], has_states)
            best = self.best
            over = (best.status == Status.CONVERGED) | (best.status == Status.INVALID_START)
            if self.chooser.paces:  # a search that found a way is followed by others anyway
                over = over | (best.violation <= self.chooser.limit)
            short = over & self._is_short(torch.arange(len(over)), best) & (again == 0)  # once more, to be sure
            again += short
            left = (~over | short) & (guess < time.most).any(-1)
            rows = rows[left[rows]]
            guess, has_states = torch.minimum(HELD_NEXT * guess, time.most), False
            if self.call.late:
                break
        self._freed_where_none_is()
        self._again()
        self._from_drawn()
        return self.best

    def _arrived(self, rows: Tensor, guess: Tensor) -> Tensor:
        """Take the time as a variable from the guess, and from ways that arrive at times of their own.

        The problems (b,) are left of which no way leads to a feasible trajectory.
        """
        call = replace(self._at(rows, guess, self.call.X0 is not None), warm=None)
        each, number, many = self.chooser.arrivals.calls(self.problem, call)
        self._keep(rows, self.chooser.free.run(call))
        if each.numel() > 0:
            ends = self.chooser.free.run(many)
            for k in number.unique():
                self._keep(each[number == k], ends.take((number == k).nonzero().flatten()))
        self.found[each] = True
        self.found &= self.best.violation <= self.chooser.limit
        return rows[~self.found]

    def _first(self) -> Tensor:
        """The factors (B, S) to begin with: the guess, else those that states to begin with take, else `own`.

        A guess shorter than the estimate is no time in which the model, as far as it is linear, gets to the end; beside
        states to begin with it counts all the same.
        """
        guess, time, X = self.time.guess, self.time, self.call.X0
        if guess is None and X is not None:
            fitting = fitting_factors(self.problem, X, self.call.U0[..., : self.problem.m]).clamp(time.least, time.most)
            return fitting if not bool(fitting.isnan().any()) else torch.where(fitting.isnan(), self.own, fitting)
        if guess is None:
            return self.own
        return guess if self.call.X0 is not None else torch.where(guess < self._estimate, self.own, guess)

    def _tried(self, rows: Tensor, guess: Tensor, has_states: bool) -> None:
        """Solve problems with the time held at `guess` (b, S), then free; `has_states`: from the user's states."""
        call = self._at(rows, guess, has_states)
        if has_states and self.call.warm is not None:
            self._keep(rows, self.chooser.free.run(call))
            return
        solution = self._at_once(replace(call, warm=None), has_states)
        if solution is not None:
            self._keep(rows, solution)
            left = (solution.status != Status.CONVERGED) | self._is_short(rows, solution)
            left = left.nonzero().flatten()
            rows, call = rows[left], call.take(left)
        if rows.numel() > 0:
            self._held(rows, call)

    def _at_once(self, call: Any, has_states: bool) -> Solution | None:
        """Solve a call with the time free from its start; None where it is held first."""
        if self.through_gates and self.chooser.through is not None:
            return self.chooser.through(call)
        if self.chooser.first is None:
            return None
        # States that were chosen, and those through gates, are worth the while.
        return (self.chooser.free if has_states or self.through_gates else self.chooser.first).run(call)

    def _held(self, rows: Tensor, call: Any) -> None:
        """Find trajectories at the time of the call's starts, and free it."""
        fixed = replace(call, problem=at_held_times(call.problem, self.problem.n), warm=None)
        solver = self.chooser.held
        first = solver.run(fixed if solver.take_states(fixed.problem) else replace(fixed, X0=None))
        does = first.violation <= self.chooser.limit
        status = torch.where(does & (first.status == Status.CONVERGED), int(Status.FEASIBLE), first.status)
        self._keep(rows, replace(first, status=status))  # stationary for this time alone
        does = does.nonzero().flatten()
        if does.numel() > 0:
            self._keep(rows[does], self._freed(call.take(does), first.take(does)))

    def _is_short(self, rows: Tensor, solution: Solution) -> Tensor:
        """Whether trajectories are as short as they may be."""
        return (factors_in(self.problem.take(rows), solution.X) <= AT_LEAST * self.time.least[rows]).all(-1)

    def _freed(self, call: Any, start: Solution | Iterate) -> Solution:
        """The trajectories with the time free."""
        return self.chooser.free.run(replace(call, X0=start.X, U0=start.U, warm=None))

    def _freed_where_none_is(self) -> None:
        """Free the time where no time that was held does: where few do, from the given guess and the least violated."""
        guess, rows = self.time.guess, self._lost
        if guess is not None and rows.numel() > 0 and not self.call.late:
            self._tried(rows, guess[rows], False)
        rows = self._lost
        if rows.numel() > 0 and not self.call.late:
            start = self.best.take(rows)
            call = self._at(rows, factors_in(self.problem.take(rows), start.X), False)
            self._keep(rows, self._freed(call, start))

    @property
    def _lost(self) -> Tensor:
        """The problems (b,) that could be solved, and have no feasible trajectory."""
        lost = ~(self.best.violation <= self.chooser.limit) & (self.best.status != Status.INVALID_START)
        return lost.nonzero().flatten()

    def _again(self) -> None:
        """Search again at other times, and keep what is better with the time free.

        These are the estimate, where a guess was far from it, and shares of the times found so far: what is found then
        depends little on the guess.
        """
        if not self.chooser.paces or self.through_gates:  # whose legs were searched with the time free
            return
        far = ((self.first / self.own - 1.0).abs() > SAME_TIME).any(-1)
        for pace in (None, *self.chooser.paces):
            feasible = (self.best.violation <= self.chooser.limit) & ~self.found
            rows = (feasible & far if pace is None else feasible).nonzero().flatten()
            factors = self.own if pace is None else pace * factors_in(self.problem, self.best.X)
            if rows.numel() > 0 and not self.call.late:
                self._tried(rows, factors.clamp(self.time.least, self.time.most)[rows], False)

    def _from_drawn(self) -> None:
        """Take the time as a variable from trajectories of drawn controls in drawn times about the one found.

        Least times are local: of controls that turn a thrust there are many. Where nothing has converged yet, each
        guess is solved; where nothing is feasible, the time found says nothing, and all that are allowed are drawn,
        several times over: a guess beside a saddle, as of a goal behind what only drives forwards, leads there mostly.
        Elsewhere, but for problems that look convex, all are solved roughly, side by side; the best of each problem is
        solved on where it may be better than what is known.
        """
        user, done = self.problem, self.best.status == Status.CONVERGED
        if self.chooser.starts == 0 or self.call.late:
            return
        rows = (~done & (self.best.status != Status.INVALID_START)).nonzero().flatten()
        again = 0
        while rows.numel() > 0 and again < DRAWN_AGAIN and not self.call.late:
            ends = self.chooser.free.run(self._drawn(rows, self.chooser.starts, again))
            for number in range(self.chooser.starts):
                self._keep(rows, ends.take(slice(number, None, self.chooser.starts)))
            rows, again = self._lost, again + 1
        rows, rough = done.nonzero().flatten(), self.chooser.rough
        rows = rows[~looks_convex(user.take(rows), self.best.X[rows, :, : user.n], self.best.U[rows, :, : user.m])]
        if rows.numel() > 0 and rough is not None and not self.call.late:
            call, old = self._drawn(rows, self.chooser.others), self.best.take(rows)
            ends = rough(call)
            self.best.iterations[rows] += ends.iterations.view(len(rows), -1).sum(1)
            cost = torch.where(ends.best.violation <= NEAR, ends.best.cost, torch.inf)
            least, start = cost.view(len(rows), -1).min(-1)
            chosen = (least < old.cost).nonzero().flatten()
            if chosen.numel() > 0:
                index = chosen * self.chooser.others + start[chosen]
                self._keep(rows[chosen], self._freed(call.take(index), take(ends.best, index)))

    def _drawn(self, rows: Tensor, count: int, again: int = 0) -> Any:
        """The call of `count` guesses for each of the problems `rows` (b,), others for each `again`."""
        each = rows.repeat_interleave(count)
        start = torch.arange(again * count, (again + 1) * count, device=rows.device).repeat(rows.numel())
        call, user = replace(self.call.take(each), callback=None, warm=None), self.problem.take(each)
        of_time, of_controls = (DrawKey(call.seed, call.ids, STREAM + 2 * start + i) for i in (0, 1))
        U = call.U0[..., : user.m]
        U = controls_of(user, U, DRAWN_CONTROLS * smooth_normal(of_controls, KNOTS, U))
        factors = factors_in(user, self.best.X[each])
        pace = standard_normal(of_time, 1, range(1), factors.dtype)[0]
        least, most = self.time.least[each], self.time.most[each]
        guess = (factors * torch.exp2(DRAWN_TIMES * pace)).clamp(least, most)
        lost = ~(self.best.violation[each] <= self.chooser.limit).unsqueeze(-1)
        guess = torch.where(lost, least * (most / least) ** torch.special.ndtr(pace), guess)
        x0 = call.problem.x0.clone()
        x0[:, user.n] = guess[:, 0]
        lifted = call.problem._with({"x0": x0}, call.problem.known)
        _, U = states_in_time(user, self._line[each], U, guess)
        return replace(call, problem=lifted, X0=open_loop(lifted, U), U0=U)

    def _at(self, rows: Tensor, guess: Tensor, has_states: bool) -> Any:
        """The call of some problems with the guess (b, S) of their factors in starts, states and controls."""
        call, user, n = self.call.take(rows), self.problem.take(rows), self.problem.n
        X, U = (call.X0, call.U0) if has_states and call.X0 is not None else (z[rows] for z in self._guess)
        X, U = states_in_time(user, X[..., :n], U[..., : user.m], guess)
        x0 = call.problem.x0.clone()
        x0[:, n] = guess[:, 0]
        return replace(call, problem=call.problem._with({"x0": x0}, call.problem.known), X0=X, U0=U)

    def _keep(self, rows: Tensor, solution: Solution) -> None:
        """Keep what is better than before; iterations add up, and so do records."""
        limit, problem = self.chooser.limit, self.call.problem.take(rows)
        clear = path_clearance(problem, solution.X, solution.U) >= 0.0
        if "best" not in vars(self):
            self.best, self.clear = solution, clear
            return
        best, old, was = self.best, self.best.take(rows), self.clear[rows]
        better = is_better(solution.cost, solution.violation, old.cost, old.violation, limit)
        same = (solution.cost <= old.cost) & (solution.violation <= limit)
        better |= same & (solution.status == Status.CONVERGED)
        # Of feasible trajectories those that touch no obstacle between two knots come first.
        both = (solution.violation <= limit) & (old.violation <= limit)
        better = torch.where(both & (clear != was), clear, better)
        where = better.nonzero().flatten()
        self.clear[rows[where]] = clear[where]
        for name in ("X", "U", "K", "d", "multipliers", "cost", "violation", "status"):
            put(getattr(best, name), rows[where], take(getattr(solution, name), where))
        for name in ("iterations", "outer_iterations", "guided"):
            getattr(best, name)[rows] += getattr(solution, name)
        searches = [record for record in (best.search, solution.search) if record is not None]
        search = searches[0].followed_by(searches[1]) if len(searches) == 2 else next(iter(searches), None)
        self.best = replace(best, trace=appended(best.trace, solution.trace), search=search)


def solve_in_time(chooser: Chooser, problem: Problem, call: Any, X0: Tensor | None) -> Solution:
    """The solution of a user's problem with a free time, for a call of the problem `in_time`.

    Args:
        X0: states (B, N+1, n) of the user's problem to begin with; None: those of the linear model, or on the straight
            line to the end.
    """
    solution = _solved(chooser, problem, replace(call, X0=X0))
    return of_user(problem, solution, needed_durations(chooser, problem, call, solution))


def _solved(chooser: Chooser, problem: Problem, call: Any) -> Solution:
    """What `Timed` finds, in the units of the call.

    It works in units of cost: seconds alone are small beside the barrier where stages are many and short, and a method
    then wanders before it sees them.
    """
    scaled, unit = call.in_cost_units()
    solution = Timed(chooser, problem, scaled).run()
    cost, multipliers = call.problem.cost.total(solution.X, solution.U), solution.multipliers.scaled(unit)
    units = spread(unit, call.rows), spread(call.problem.cost_scale.constant, call.rows)
    trace = None if solution.trace is None else in_units(solution.trace, *units)
    search = None if solution.search is None else solution.search.in_costs(*units)
    return replace(solution, cost=cost, multipliers=multipliers, trace=trace, search=search)


def of_user(problem: Problem, solution: Solution, needed: Tensor | None = None) -> Solution:
    """A solution of the problem `in_time` as one of the user's: its own states, controls and rows, and the times."""
    n, m, count = problem.n, problem.m, len(problem.constraints)
    times = times_of(problem, factors_in(problem, solution.X))
    multipliers = Multipliers(solution.multipliers.lam[:count], solution.multipliers.mu)
    X, K = solution.X[..., :n].contiguous(), solution.K[..., :m, :n].contiguous()
    U, d = solution.U[..., :m].contiguous(), solution.d[..., :m].contiguous()
    search = None if solution.search is None else solution.search.of_first_states(n)
    return replace(solution, X=X, U=U, K=K, d=d, multipliers=multipliers, times=times, needed=needed, search=search)


def lifted_multipliers(problem: Problem, whole: Problem, warm: Multipliers) -> Multipliers:
    """Multipliers of the user's rows with those of the bounds on the factors, 0."""
    warm.check(problem)
    more = [warm.mu.new_zeros(whole.B, *shape) for shape in whole.row_shapes[len(warm.lam) :]]
    return Multipliers((*warm.lam, *more), warm.mu)


def needed_durations(chooser: Chooser, problem: Problem, call: Any, solution: Solution) -> Tensor | None:
    """Durations (B,), s, beyond the longest allowed, at which problems can be solved that can't within it.

    NaN where nothing was asked or found; None where all is feasible. A HorizonWarning names them.
    """
    rows = (~(solution.violation <= chooser.limit) & (solution.status != Status.INVALID_START)).nonzero().flatten()
    if rows.numel() == 0 or call.late:
        return None
    subset = problem.take(rows)
    time = subset.time
    assert time is not None
    freed = replace(time, least=time.most, most=BEYOND * time.most, guess=None, weight=torch.ones_like(time.weight))
    longer = subset._with({"time": freed, "cost": _Nothing(subset.cost)})
    call = replace(call.take(rows), problem=in_time(longer), X0=None, warm=None)
    again = _solved(replace(chooser, starts=0), longer, call)
    needed = torch.full_like(solution.cost, torch.nan)
    does = again.violation <= chooser.limit
    needed[rows[does]] = times_of(subset, factors_in(subset, again.X))[does, -1]
    known = (~needed.isnan()).nonzero().flatten().tolist()
    if known:
        places = ", ".join(f"problem {b}: {float(needed[b]):.4g} s" for b in known[:NAMED])
        more = ", ..." if len(known) > NAMED else ""
        told = f"{len(known)} of {problem.B} problems need more time than that; the least found that would do is, for"
        warnings.warn(f"time.most: {told} {places}{more}", HorizonWarning, stacklevel=4)
    return needed


@dataclass(frozen=True)
class _Nothing(WrappedCost):
    """A cost of 0: the time alone counts."""

    batched = ("cost",)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return 0.0 * x[..., 0]

    def terminal(self, x: Tensor) -> Tensor:
        return 0.0 * x[..., 0]
