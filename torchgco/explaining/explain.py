"""What happened to one problem of a batch, in words (`Solution.explain`), and what a solution keeps to be explained."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import check_shape, computing_on
from torchgco.base.status import Status
from torchgco.base.tree import PerElement, Rows
from torchgco.constraints.base import CONTACT_FACTOR
from torchgco.explaining.advice import Facts, advice, tells_to_record
from torchgco.explaining.passes import is_pathless, iterations_told, passes_told
from torchgco.explaining.places import caught_told, gates_told, lost_told, number, place_told
from torchgco.explaining.record import SearchRecord
from torchgco.judging.judge import columns as judged
from torchgco.judging.steps import step_errors
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.unmoved import unmoved, without_slope
from torchgco.maps.field import BoundField, distance_within
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.passage import widest_passage
from torchgco.obstacles.base import ADMITTED, Obstacles
from torchgco.problem.covered import covered_goals
from torchgco.problem.horizons import within_horizons
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.times import times


def goal_facts(problem: Problem, X: Tensor, U: Tensor) -> dict[str, Any]:
    """Those of `Facts` on a required goal that X (1, N+1, n), U (1, N, m) misses; none where it doesn't."""
    row = next((constraint for constraint in problem.constraints if constraint.is_goal), None)
    if row is None:
        return {}
    last = int(problem.stages[0])  # of a problem with its own horizon, whose rows stand at knot N
    missed = float(row.worst(X[:, [last] * X.shape[1]], U))
    if not missed > ADMITTED:
        return {}
    unit = " m" if row.in_metres else ""
    return {"missed": f"{missed:.4g}{unit}", "covered": bool(covered_goals(problem))}


def map_facts(problem: Problem, status: Status, arrived: bool) -> dict[str, Any]:
    """Those of `Facts` that maps know, for a batch of one; none where the vehicle arrived without contact."""
    fields = [field for field in problem.obstacles if field.map is not None]
    if status is Status.INVALID_START:
        return {"in_unknown": any(_is_unknown(problem, field.map) for field in fields if field.body is None)}
    if arrived or problem.goal is None or not bool(problem.x0[:, problem.position].isfinite().all()):
        return {}
    facts = [fact for field in fields if field.holds_at(problem.N) and (fact := _barred(problem, field)) is not None]
    return min(facts, key=lambda fact: fact["passage"], default={})


def _barred(problem: Problem, obstacle: Obstacles) -> dict[str, Any] | None:
    """The vehicle's radius and the largest that gets to the goal, where this one touches the map on every way."""
    field = obstacle.inscribed  # of a body, as the ball meets it that the body holds
    assert problem.goal is not None and isinstance(field, BoundField)
    start = problem.x0[0, problem.position].detach().cpu().double().numpy()
    goal = problem.goal.position[0].detach().cpu().double().numpy()
    radius, goal_radius = float(field.vehicle_radius[0]), float(problem.goal.radius[0])
    b, near = int(field.which[0]), radius - ADMITTED
    if distance_within(field.field.source, field.field.unknown, b, start, radius) < near:
        near = CONTACT_FACTOR * radius  # from so near a start it may leave
    passage = widest_passage(field.field, b, start, goal, goal_radius, near)
    if passage is None:
        return None
    ends = {"start": start, "goal": goal}
    off = [name for name, point in ends.items() if passage == 0.0 and _shuts_out(field, point)]
    return {"radius": radius, "passage": passage, "body": obstacle is not field, "off_map": off[0] if off else None}


def _shuts_out(field: BoundField, point: np.ndarray) -> bool:
    """Whether a place lies outside of a grid whose outermost cells are all occupied."""
    source = field.field.single(int(field.which[0])).source
    if not isinstance(source, OccupancyGrid) or source.holds(point):
        return False
    (cells,) = source.held(field.field.unknown)
    return all(bool(cells.take((0, -1), axis).all()) for axis in range(source.d))


def _is_unknown(problem: Problem, field: BoundField) -> bool:
    """Whether the vehicle touches unknown cells at the start, and no others of this map."""
    source = field.field.source
    if not isinstance(source, OccupancyGrid) or bool(field.start_is_clear(problem.x0)[0]):
        return False
    p = problem.x0[0, problem.position].detach().cpu().double().numpy()
    least = CONTACT_FACTOR * float(field.vehicle_radius[0])
    known = distance_within(source, "free", int(field.which[0]), p, least + source.resolution)
    return known >= least and known > 0


class Account(PerElement):
    """The problem that was solved, and the solver; no dataclass, so that nothing is copied with a solution's tensors.

    Of a solution that was loaded or sent to another process, only the times of the knots and the kernels are left.

    Args:
        problem: as the user gave it.
        solver: that solved it.
        name: of the preset that the user named; None: the solver's class.
        rows: the problems (b,) of the account; None: all.
        t: times, where the problem isn't there.
        kernels: that solved: "native", "cuda", "pytorch", or another library's name; None where that isn't known.
        smoothing: of the solution, in units of the cost.
    """

    def __init__(
        self,
        problem: Problem | None = None,
        solver: Any = None,
        name: str | None = None,
        rows: Tensor | None = None,
        t: Tensor | None = None,
        kernels: str | None = None,
        smoothing: float = 0.0,
    ) -> None:
        self._whole, self.solver, self._name, self._rows, self._t = problem, solver, name, rows, t
        self.kernels, self.smoothing = kernels, smoothing

    @property
    def problem(self) -> Problem | None:
        """The problems of the account; taken from the batch only when they are asked for."""
        return self._whole if self._whole is None or self._rows is None else self._whole.take(self._rows)

    @property
    def name(self) -> str | None:
        """What solved the problem; None where that isn't known."""
        return type(self.solver).__name__ if self._name is None and self.solver is not None else self._name

    def asked(self, problem: Problem, name: str | None) -> Account:
        """The same of the problem as the user gave it, and of a preset of this name; None: of no preset."""
        return Account(problem, self.solver, name, self._rows, self._t, self.kernels, self.smoothing)

    def smoothed(self, by: float) -> Account:
        """The same of the solution with a smoothing."""
        return Account(self._whole, self.solver, self._name, self._rows, self._t, self.kernels, by)

    def as_solved(self) -> Problem | None:
        """`problem`, where its numbers are still those that were solved for.

        Raises:
            InputError: they were changed in place since.
        """
        if self._whole is not None and self._whole.current() is not self._whole:
            expected = "a problem whose numbers are as they were solved: pass a copy of it as problem="
            raise InputError("solution", expected, "one whose numbers were changed in place since")
        return self.problem

    def times(self) -> Tensor:
        """The times of the knots, (N+1,) or (b, N+1), s.

        Raises:
            InputError: dynamics without a time step, no times in the file that was loaded, or changes in place since.
        """
        if self._whole is not None:
            self.as_solved()
            t = times(self._whole)
        elif self._t is not None:
            t = self._t
        else:
            raise InputError("solution", "one that knows its times: solved here, or saved with them", "a loaded one")
        return t if self._rows is None or t.dim() == 1 else t[self._rows]

    def take(self, index: Rows) -> Account:
        """The account of some problems."""
        if isinstance(index, slice):
            like = self._t if self._whole is None else self._whole.x0
            if self._rows is not None:
                rows = self._rows[index]
            elif like is None or like.dim() == 1:  # times alone, which all problems share
                rows = None
            else:
                rows = torch.arange(len(like), device=like.device)[index]
        else:
            index = index.nonzero().flatten() if index.dtype == torch.bool else index
            rows = index if self._rows is None else self._rows[index]
        return Account(self._whole, self.solver, self._name, rows, self._t, self.kernels, self.smoothing)

    def __getstate__(self) -> dict[str, Any]:
        """Times and name alone: a problem may hold functions that no other process can read."""
        try:
            t = self.times()
        except InputError:
            t = None
        return {"_whole": None, "solver": None, "_name": self.name, "_rows": None, "_t": t,
                "kernels": self.kernels, "smoothing": self.smoothing}  # fmt: skip


if TYPE_CHECKING:
    import pandas as pd

LINE_WIDTH = 110  # letters of a line


class Solved(Protocol):
    """What is read of a solution."""

    X: Tensor
    U: Tensor
    cost: Tensor
    violation: Tensor
    status: Tensor
    iterations: Tensor
    outer_iterations: Tensor
    guided: Tensor
    trace: pd.DataFrame | None
    search: SearchRecord | None
    account: Account | None
    multipliers: Multipliers
    times: Tensor | None
    needed: Tensor | None


class Explanation(str):
    """A text that notebooks and consoles show as it is, line by line."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def explanation(solution: Any, b: int, problem: Problem | None = None, what: str | None = None) -> Explanation:
    """What happened to the problem at place b of a solution; see `Solution.explain`. `what` names it, by default b."""
    with computing_on(solution.U.device):
        return _explanation(solution, b, problem, what)


def _explanation(solved: Solved, b: int, problem: Problem | None, what: str | None) -> Explanation:
    B = solved.U.shape[0]
    if isinstance(b, bool) or not isinstance(b, int) or not 0 <= b < B:
        raise InputError("b", f"the place of a problem, 0 to {B - 1}", shown(b))
    account = solved.account or Account()
    whole = account.problem if problem is None else problem
    if problem is not None:
        problem = current_problem(problem)
        check_shape(solved.X, (problem.B, problem.N + 1, problem.n), "problem: solution.X")
        check_shape(solved.U, (problem.B, problem.N, problem.m), "problem: solution.U")
    single = None if whole is None else _One(whole, solved, b)
    facts = _facts(solved, b, account, single)
    by = f" by {account.name}" if account.name else ""
    parts = [
        ("", [f"{what or f'Problem {b} of {B}'}, solved{by}: {facts.status.name}."]),
        ("Result", _result(solved, b, facts, single)),
        ("Caught", _caught(solved, b, single)),
        ("Passes", _passes(solved, b, account, facts)),
        ("Iterations", _iterations(solved, b)),
        ("Why it ended", facts.told),
        ("What to try", advice(facts)),
    ]
    return Explanation("\n".join(_block(title, lines) for title, lines in parts if lines))


class _One:
    """One problem of the batch, with its trajectory and the times of its knots."""

    def __init__(self, whole: Problem, solved: Solved, b: int) -> None:
        rows = torch.tensor([b], device=whole.x0.device)
        self.rows, self.problem = rows, whole.take(rows)
        self.X, self.U = solved.X[rows], solved.U[rows]
        self.lams = [lam[rows] for lam in solved.multipliers.lam]
        self.t: Tensor | None = None
        self.times = None if solved.times is None else solved.times[rows]  # where the time is free
        self.held, self.full_X, self.full_U = at_times(within_horizons(self.problem), self.X, self.U, self.times)
        try:
            t = times(self.problem) if self.times is None else self.times
            self.t = t if t.dim() == 1 else t[0]
        except InputError:  # dynamics without a time step
            pass

    @property
    def lost_at(self) -> int | None:
        """The first knot whose state isn't finite."""
        lost = (~torch.isfinite(self.X[0]).all(-1)).nonzero().flatten()
        return int(lost[0]) if lost.numel() else None

    def lost(self, status: Status) -> str | None:
        """Which part isn't finite, where states and controls are; None where all are."""
        if status is not Status.NON_FINITE or self.lost_at is not None or not bool(torch.isfinite(self.U).all()):
            return None
        return lost_told(self.held, self.full_X, self.full_U, self.t)

    @property
    def goal_distance(self) -> float | None:
        problem = self.problem
        if problem.goal is None:
            return None
        return float(problem.goal.distance(self.X[:, -1, problem.position])[0])

    def long_steps(self) -> str | None:
        """What shows that dt is too long for the model; None where nothing does."""
        errors = step_errors(self.problem, self.X, self.U, self.times, self.lams, doubted=True)
        return errors.told(0, self.problem) if bool(errors.large) else None

    def verdict(self) -> dict[str, Any]:
        """`clearance` and `reached` by the judge, where it knows them."""
        start = None if self.problem.free_start is None else self.X[:, 0]
        try:
            return {name: column[0] for name, column in judged(self.problem, self.U, start, self.times).items()}
        except InputError:  # obstacles of a kind that can't be judged
            return {}


def _facts(solved: Solved, b: int, account: Account, single: _One | None) -> Facts:
    solver, status = account.solver, Status(int(solved.status[b]))
    recording = getattr(solver, "recording", None)
    could = solved.trace is None and recording is not None and recording() != solver
    if single is None:
        return Facts(status, solver, could_record=could)
    horizon = getattr(solver, "horizon", None)
    verdict = single.verdict()
    reached = bool(verdict["reached"]) if "reached" in verdict else None
    clearance = float(verdict["clearance"]) if "clearance" in verdict else None
    return Facts(
        status=status,
        solver=solver,
        seeks_paths=None if solver is None else hasattr(solver, "passes"),
        among_obstacles=bool(single.problem.obstacles),
        reached=reached,
        goal_distance=single.goal_distance,
        clearance=clearance,
        pathless=solved.search is not None and is_pathless(solved.search, b),
        could_record=could,
        unmoved=status is Status.INFEASIBLE and bool(unmoved(single.held, single.full_X, single.full_U, ADMITTED)),
        horizon=None if reached or horizon is None else horizon(single.problem),
        flat=single.lost_at is None and bool(without_slope(single.held, single.full_X, single.full_U, ADMITTED)),
        steps=single.long_steps(),
        lost=single.lost(status),
        named=single.lost_at is None and place_told(single.problem, single.X, single.U, single.t) is not None,
        **goal_facts(single.problem, single.X, single.U),
        **map_facts(single.problem, status, bool(reached) and (clearance is None or clearance >= 0)),
    )


def _result(solved: Solved, b: int, facts: Facts, single: _One | None) -> list[str]:
    counts = f"{int(solved.iterations[b])} iterations"
    if outer := int(solved.outer_iterations[b]):
        counts += f", {outer} outer iteration{'s' if outer > 1 else ''}"
    if guided := int(solved.guided[b]):
        counts += f", {guided} of them guided"
    lines = [f"cost {number(float(solved.cost[b]))}, violation {number(float(solved.violation[b]))}, after {counts}"]
    if single is None:
        return lines
    if single.lost_at is not None:
        lines.append(f"the state at knot {single.lost_at} isn't finite: the stage before it is where the model fails")
        return lines
    lines += _duration(solved, b, single)
    worst = place_told(single.problem, single.X, single.U, single.t)
    lines.append("no constraint is violated" if worst is None else f"violated most: {worst}")
    lines += gates_told(single.held, single.full_X, single.full_U)
    if facts.steps is not None:
        lines.append(f"steps are too long for the model: {facts.steps}")
    if facts.clearance is not None and facts.clearance < float("inf"):
        side = "touches an obstacle" if facts.clearance < 0 else "clear of obstacles"
        lines.append(f"{side}: {number(facts.clearance)} m to contact, between the knots too")
    if facts.goal_distance is not None and single.problem.goal is not None:
        radius = float(single.problem.goal.radius[0])
        near = facts.goal_distance < radius
        within = "reached" if facts.reached else "not judged" if facts.reached is None else "not reached"
        within = "not reached, as constraints are violated" if near and facts.reached is False else within
        away = f"{number(facts.goal_distance)} m from it, radius {number(radius)} m"
        lines.append(f"goal {within}: the last knot is {away}")
    return lines


def _duration(solved: Solved, b: int, single: _One) -> list[str]:
    """How long the trajectory lasts, where that was free, and whether the longest time does."""
    time = single.problem.time
    if time is None or single.t is None:
        return []
    sizes = torch.bincount(time.of_stages(single.problem.N))
    least, most = ((factors[0] * sizes).sum() * single.problem.dynamics.dt for factors in (time.least, time.most))
    lines = [f"duration {number(float(single.t[-1]))} s, of {number(float(least))} to {number(float(most))} s allowed"]
    if solved.needed is not None and float(solved.violation[b]) > ADMITTED:
        needed = float(solved.needed[b])
        reason = "none longer that was tried does" if needed != needed else f"{number(needed)} s would do"
        lines.append(f"no duration up to time.most was found to do; {reason}")
    return lines


def _caught(solved: Solved, b: int, single: _One | None) -> list[str]:
    """Where the first solve was caught, where that is recorded; else where the returned trajectory is."""
    if single is None:
        return []
    if solved.search is not None and solved.search.caught is not None:
        rows, X = solved.search.caught
        index = (rows == b).nonzero().flatten()
        if index.numel() == 0:
            return ["no: the first solve wasn't stopped between obstacles"]
        lines = caught_told(single.held, X[index], single.full_U, single.t)
        return [f"the first solve was stopped {lines}" if lines else "the first solve was stopped between obstacles"]
    if single.lost_at is not None:
        return []
    lines = caught_told(single.held, single.full_X, single.full_U, single.t, ADMITTED)
    return [f"the returned trajectory lies {lines}"] if lines else []


def _passes(solved: Solved, b: int, account: Account, facts: Facts) -> list[str]:
    if solved.search is None:
        untold = facts.could_record and facts.seeks_paths and not tells_to_record(facts)
        return ["not recorded; torchgco.solve(..., record=True) keeps what each did"] if untold else []
    table = getattr(account.solver, "table", None)
    return passes_told(solved.search, b, {} if table is None else table()["problems"].to_dict())


def _iterations(solved: Solved, b: int) -> list[str]:
    return [] if solved.search is not None or solved.trace is None else iterations_told(solved.trace, b)


def _block(title: str, lines: list[str]) -> str:
    if not title:
        return "\n".join(lines)
    first = f"{title}: "
    wrapped = [textwrap.fill(line, LINE_WIDTH, initial_indent="  ", subsequent_indent="    ") for line in lines]
    return "\n".join([first.rstrip(), *wrapped])
