"""solve and compare: one call with a default solver, for notebooks and first steps."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Any, Never, overload

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError, shown
from torchgco.base.options import Positive, check_value, option_places
from torchgco.base.shapes import check_shape, check_untransformed, computing_on
from torchgco.constraints.bounds import bounds_of
from torchgco.constraints.norms import within_norms
from torchgco.fleets import Fleet, FleetSolution
from torchgco.fleets.solve import solve_fleet
from torchgco.guesses import Guess, guesses_of, solve_guesses
from torchgco.judging.judge import judge, judged_columns
from torchgco.kernels import copied_to, current, is_mixed, on_cpu, open_loop, served_by
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.phases import Phases, PhasesSolution
from torchgco.phases.solution import solve_phases
from torchgco.presets import named
from torchgco.problem.horizons import for_solvers
from torchgco.problem.in_time import guessing_times
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.refusals import spared
from torchgco.search import Restarts
from torchgco.sensitivity import asks_for_gradients, attached, check_smoothing
from torchgco.solution import Solution
from torchgco.solvers.contracts import Solver
from torchgco.solvers.watching import Watcher
from torchgco.warned import CLAIMS, warn_of

if TYPE_CHECKING:
    import pandas as pd

LEAST_SECONDS = 1e-3  # of a solve for whose fleet no time is left


@overload
def solve(
    problem: Problem,
    U0: Tensor | None = None,
    solver: Solver | str | None = None,
    seed: int = 0,
    ids: Tensor | None = None,
    warm: Solution | None = None,
    max_seconds: float | None = None,
    X0: Tensor | None = None,
    record: bool = False,
    verbose: bool | None = None,
    smoothing: float | None = None,
    guesses: Sequence[Guess | Solution | Mapping[str, Any]] | None = None,
    **misplaced: Never,
) -> Solution: ...
@overload
def solve(
    problem: Fleet,
    *,
    solver: Solver | str | None = None,
    seed: int = 0,
    ids: Tensor | None = None,
    max_seconds: float | None = None,
    verbose: bool | None = None,
) -> FleetSolution: ...
@overload
def solve(
    problem: Phases,
    U0: Sequence[Tensor | None] | None = None,
    *,
    solver: Solver | str | None = None,
    seed: int = 0,
    ids: Tensor | None = None,
    warm: PhasesSolution | None = None,
    max_seconds: float | None = None,
    X0: Sequence[Tensor | None] | None = None,
    verbose: bool | None = None,
) -> PhasesSolution: ...


def solve(
    problem: Problem | Fleet | Phases,
    U0: Any = None,
    solver: Solver | str | None = None,
    seed: int = 0,
    ids: Tensor | None = None,
    warm: Any = None,
    max_seconds: float | None = None,
    X0: Any = None,
    record: bool = False,
    verbose: bool | None = None,
    smoothing: float | None = None,
    guesses: Sequence[Guess | Solution | Mapping[str, Any]] | None = None,
    **misplaced: Never,
) -> Solution | FleetSolution | PhasesSolution:
    """Solve every problem of the batch; all vehicles of a `Fleet`; all `Phases`, with a list of U0 and of X0.

    A ContactWarning names feasible trajectories that touch an obstacle between knots; a ScaleWarning those with a
    violation that is large beside its row; a StepWarning those with too long a `dt` for the model; a HorizonWarning
    horizons, or longest times, too short for the way to a stated goal (`solution.needed`). Where tensors in or around
    the problem ask for gradients, X, U, cost and multipliers have them (`solution.differentiable`); not in `no_grad()`.

    Args:
        problem: B problems.
        U0: initial controls (B, N, m). Default: those of `warm`, else the cost's reference, else zero; the middle of
            the bounds where that breaks these, or where the rollout overflows; within `NormBounds` and cones.
        solver: a solver, or the name of a preset (`torchgco.presets`). Default: "gco".
        seed, ids: the key of the random draws; ids are int64 (B,), by default 0..B-1.
        warm: an earlier solution of problems of this form: the solve starts from its multipliers and, without U0, from
            its controls; where starts are free, from its starts too; where the time is, from its states and times.
        max_seconds: after which the best trajectories so far are returned, of peers the guess; see `Solver.solve`.
        X0: states to begin with (B, N+1, n), such as waypoints; U0 need not lead to them. For `interior_point`, `ipopt`
            and `fatrop`, and without obstacles, or with a free time, `gco`. Default: those that U0 leads to; where the
            time is free, those of its estimate. A problem whose guess isn't finite, of `warm` too, ends NON_FINITE.
        record: keep `solution.trace` and, of `gco`, `solution.search`, where the solver can: `solution.explain` then
            says more. The results are the same.
        verbose: True: a line on stdout for every row of the solver's table that worked on some problem, and one at the
            end. None: in a terminal and in a notebook a bar on stderr, once it takes 2 s; False: nothing.
        smoothing: mu > 0 in units of the cost: the minimum of J_var - mu sum log(-c) over all rows c <= 0 near the
            solver's, FEASIBLE, whose gradients are smooth; `solution.reason` where none is found. None: the solver's.
        guesses: several per problem, in the place of U0, X0 and warm; see `Guess`. The best result of each is kept.

    Raises:
        InputError: U0, ids, warm, X0 or an argument don't fit, no preset has this name, the solver can't begin with X0,
            solve has no such argument, or a function that branches on values mixes knots or problems in what is found.
    """
    check_untransformed("solve")
    others = {"record": record or None, "smoothing": smoothing, "guesses": guesses, **misplaced}
    if isinstance(problem, Phases | Fleet):
        return _solve_parts(problem, others, solver, {"U0": U0, "X0": X0, "warm": warm}, seed, ids, max_seconds)
    asked = problem = current_problem(problem)
    warm, solver = _checked(warm), "gco" if solver is None else solver
    differentiates, smoothing = asks_for_gradients(problem), check_smoothing(problem, smoothing)
    name, record = _refuse(misplaced, problem, solver), check_value(record, bool, "record")
    tried = _tried(guesses, problem, {"U0": U0, "X0": X0, "warm": warm, "record": record or None})
    solver, X0 = _solver(solver, problem, record), warm.X if X0 is None and warm and problem.time else X0
    if solver.kernels is None and (there := on_cpu(problem)) is not None:
        problem, (U0, ids, warm, X0, tried) = there, copied_to((U0, ids, warm, X0, tried), there.x0)
    with served_by(asked.x0.device, is_mixed(problem)):
        problem, U0 = spared(problem, partial(_start, warm, solver, U0))
        multipliers, verbose = None if warm is None else warm.multipliers, check_value(verbose, bool | None, "verbose")
        watcher = Watcher(name or type(solver).__name__, problem.B, isinstance(solver, Restarts), verbose)
        found = _watched(watcher, solver, tried, (problem, U0, seed, ids, multipliers), max_seconds, X0)
        warn_of(problem, found, warm is None)
        problem, found = _returned(asked, problem, found, name)
        return attached(asked, problem, found, smoothing, differentiates) if differentiates or smoothing else found


def _watched(
    watcher: Watcher,
    solver: Solver,
    guesses: Sequence[Guess] | None,
    call: tuple[Problem, Tensor, int, Tensor | None, Multipliers | None],
    max_seconds: float | None,
    X0: Tensor | None,
) -> Solution:
    """The solution of a call, from several guesses where there are some, under the eyes of the watcher."""
    with closing(watcher):
        if guesses is None:
            found = solver.solve(*call, watcher.callback, max_seconds, X0)
        else:
            found = solve_guesses(solver, guesses, *call[:4], watcher.callback, max_seconds)
        watcher.end(found)
        return found


def _returned(asked: Problem, problem: Problem, found: Solution, name: str | None) -> tuple[Problem, Solution]:
    """The problem and the solution on the device of the problem that was asked for, which the solution knows."""
    if problem.x0.device != asked.x0.device:
        problem, found = current(asked), copied_to(found, asked.x0)
    return problem, replace(found, account=found.account and found.account.asked(asked, name))


def _solve_fleet(
    fleet: Fleet,
    others: Mapping[str, Any],
    solver: Solver | str | None,
    seed: int,
    ids: Tensor | None,
    max_seconds: float | None,
) -> FleetSolution:
    if given := [name for name, value in others.items() if value is not None]:
        raise InputError(f"solve.{given[0]}", "None of a fleet: it has solver, seed, ids and max_seconds", given[0])
    check_value(max_seconds, Positive | None, "max_seconds")
    if ids is not None:
        check_shape(ids, (fleet.B,), "ids")
    ends = None if max_seconds is None else clock.seconds() + max_seconds

    def own(problem: Problem, **options: Any) -> Solution:
        left = None if ends is None else max(LEAST_SECONDS, ends - clock.seconds())
        return solve(problem, max_seconds=left, verbose=False, **options)

    return solve_fleet(fleet, own, seed, ids, "gco" if solver is None else solver, ends)


def _solve_parts(
    parts: Phases | Fleet,
    others: Mapping[str, Any],
    solver: Solver | str | None,
    guess: dict[str, Any],
    seed: int,
    ids: Tensor | None,
    max_seconds: float | None,
) -> PhasesSolution | FleetSolution:
    if isinstance(parts, Fleet):
        return _solve_fleet(parts, guess | dict(others), solver, seed, ids, max_seconds)
    expected = "None of phases: they have U0, X0, solver, seed, ids, warm, max_seconds and smoothing"
    if given := [name for name, value in others.items() if value is not None and name != "smoothing"]:
        raise InputError(f"solve.{given[0]}", expected, given[0])
    if guess["warm"] is not None and (guess["U0"], guess["X0"]) != (None, None):
        raise InputError("warm", "None beside U0 and X0", "a solution")
    made = _solver("interior_point" if solver is None else solver, parts.members[0], False)
    more = {"seed": seed, "ids": ids, "max_seconds": max_seconds, "smoothing": others["smoothing"]}
    return solve_phases(parts, made, **guess, **more, rest=_within_bounds)


def compare(
    problem: Problem,
    solvers: Sequence[Solver | str] | Mapping[str, Solver | str],
    U0: Tensor | None = None,
    seed: int = 0,
    max_seconds: float | None = None,
) -> pd.DataFrame:
    """Solve the same problems by several solvers, one after the other: one table.

    Args:
        solvers: names of presets, or solvers; a mapping gives them names of its own.
        U0, seed, max_seconds: of every solve, as in `solve`.

    Returns:
        A row per solver and problem, with index `solver` and `element`: the columns of `Solution.to_frame(problem)`;
        `cost_ratio` to the cheapest trajectory of the problem that is as good (its goal reached, where that is judged,
        else feasible), NaN for those that aren't, and where the least cost isn't above 0; `seconds` per problem, those
        of the whole solve divided by B, without compiling; the `threads` and the `device` that they were measured on.

    Raises:
        InputError: as `solve`; no solver, or two of the same name.
    """
    import pandas as pd

    check_untransformed("compare")
    problem = current_problem(problem)
    made = _named_solvers(problem, solvers)
    frames, feasible = [], []
    for name, solver in made.items():
        prepared = solver.prepare(problem)
        began = clock.seconds()
        with torch.no_grad():
            found = solve(problem, U0, prepared, seed, max_seconds=max_seconds, verbose=False)
        if problem.x0.device.type == "cuda":
            torch.cuda.synchronize(problem.x0.device)
        seconds = (clock.seconds() - began) / max(1, problem.B)
        frame, sound = _judged_frame(problem, found)
        on = {"threads": torch.get_num_threads(), "device": str(problem.x0.device)}
        frames.append(frame.assign(solver=name, seconds=seconds, **on).reset_index())
        feasible.append(sound.cpu())
    table = pd.concat(frames, ignore_index=True)
    good = table["reached"] if "reached" in table else pd.Series(torch.cat(feasible).numpy())
    cost = table["cost"].where(good.astype(bool))
    best = cost.groupby(table["element"]).transform("min")
    table.insert(table.columns.get_loc("cost") + 1, "cost_ratio", (cost / best).where(best > 0))
    return table.set_index(["solver", "element"])


def _named_solvers(problem: Problem, solvers: Any) -> dict[str, Solver]:
    """The solvers by name, in their order."""
    if isinstance(solvers, Mapping):
        pairs = [(str(name), solver) for name, solver in solvers.items()]
    elif isinstance(solvers, Sequence) and not isinstance(solvers, str):
        pairs = [(one if isinstance(one, str) else type(one).__name__, one) for one in solvers]
    else:
        pairs = []
    made = {name: _solver(solver, problem, False) for name, solver in pairs}
    if not made or len(made) < len(pairs):
        got = [name for name, _ in pairs] or shown(solvers)
        raise InputError("solvers", 'a list of different ones, such as ["gco", "al_ilqr"], or a dict by name', got)
    return made


def _judged_frame(problem: Problem, solution: Solution) -> tuple[pd.DataFrame, Tensor]:
    """The table of a solution, and which trajectories are feasible between the knots, too, and through every gate."""
    frame, start = solution.to_frame(), None if problem.free_start is None else solution.X[:, 0]
    try:
        verdict = judge(problem, solution.U, start=start, times=solution.times)
    except InputError:  # obstacles of a kind that can't be judged
        return frame, torch.isin(solution.status, torch.tensor(CLAIMS, device=solution.status.device))
    return frame.assign(**judged_columns(problem, verdict)), verdict.feasible


def _solver(solver: Solver | str, problem: Problem, record: bool) -> Solver:
    """The solver, or that of a preset's name, which records where it is asked to."""
    made = named(solver, problem) if isinstance(solver, str) else solver
    if not isinstance(made, Solver):
        raise InputError("solver", "a solver, such as presets.gco(problem), or the name of a preset", shown(solver))
    return made.recording() if record else made


def _refuse(misplaced: Mapping[str, Any], problem: Problem, solver: Solver | str) -> str | None:
    """Raise InputError for an argument that `solve` doesn't have: where the solver has it, or which one is like it.

    Returns:
        The name of the solver, if it is given by that.
    """
    for name, value in misplaced.items():
        made = option_places(_solver(solver, problem, False))
        near = get_close_matches(name, inspect.signature(solve).parameters, n=1)
        expected = "an argument of solve" + "".join(f", such as {other}" for other in near)
        if places := [path for path in made if path.rpartition(".")[2] == name]:
            whose = f"presets.{solver}(problem)" if isinstance(solver, str) else "your solver"
            expected = f"an option of the solver in its place: {', '.join(places)} of {whose}, by dataclasses.replace"
        raise InputError(f"solve.{name}", expected, shown(value))
    return solver if isinstance(solver, str) else None


def _checked(warm: Any) -> Solution | None:
    """The guess of a warm start without gradients: it takes no part in derivatives."""
    if not isinstance(warm, Solution | None):
        raise InputError("warm", "a Solution, or None", type(warm).__name__)
    return warm and warm.detach()


def _tried(guesses: Any, problem: Problem, others: Mapping[str, Any]) -> tuple[Guess, ...] | None:
    """The guesses, bound; InputError beside what they take the place of."""
    if guesses is None:
        return None
    if given := [name for name, value in others.items() if value is not None]:
        raise InputError(f"solve.{given[0]}", "None beside guesses, each of which is solved from", given[0])
    return guesses_of(guesses, problem)


def _start(warm: Solution | None, solver: Solver, U0: Tensor | None, problem: Problem) -> tuple[Problem, Tensor]:
    """Controls (B, N, m) to begin with, where none are given, and the problem with the guess of its free starts."""
    if problem.B > 0:
        problem = current(problem)  # traced once, for the guess, for the solve and for the warnings after it
    if U0 is not None:
        return problem, U0
    if warm is not None:
        if problem.time is not None:
            problem = guessing_times(problem, warm.t)
        if problem.free_start is not None:
            check_shape(warm.X, (problem.B, problem.N + 1, problem.n), "warm.X")
            problem = problem.guessing(warm.X[:, 0])
        return problem, warm.U
    if problem.B == 0:
        return problem, problem.x0.new_zeros(0, problem.N, problem.m)
    whole = for_solvers(problem)
    solver.announce(whole)
    return problem, problem.derive("guess", partial(_guess, problem, whole)).clone()


def _guess(problem: Problem, whole: Problem) -> Tensor:
    """Controls (B, N, m) at rest; the middle of their bounds where rest breaks these or overflows."""
    with computing_on(problem.x0.device):
        rest, middle, outside = _at_rest(problem)
        next_factors = rest.new_ones(*rest.shape[:2], whole.m - problem.m)  # where the time is free
        lost = ~torch.isfinite(open_loop(whole, torch.cat((rest, next_factors), dim=-1))).flatten(1).all(-1)
        return torch.where(outside.logical_or(lost).view(-1, 1, 1), middle, rest)


def _within_bounds(problem: Problem) -> Tensor:
    """Controls (B, N, m) at rest; the middle of their bounds where rest breaks these."""
    rest, middle, outside = _at_rest(problem)
    return torch.where(outside.view(-1, 1, 1), middle, rest)


def _at_rest(problem: Problem) -> tuple[Tensor, Tensor, Tensor]:
    """Controls (B, N, m) at rest, those in the middle of their bounds, and where (B,) the former break these.

    A bound at infinity has no middle: there the other bound, or rest. Bounds on norms and cones move both inside.
    """
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    rest = within_norms(rest, problem.constraints)
    middle, outside = rest.clone(), torch.zeros_like(rest, dtype=torch.bool)
    for bounds in bounds_of(problem.constraints, "u"):
        held, (lower, upper) = rest[:, bounds.knots], bounds.by_knot
        outside[:, bounds.knots] |= (held < lower) | (held > upper)
        middle[:, bounds.knots] = bounds.middle(held)
    return rest, within_norms(middle, problem.constraints), outside.flatten(1).any(-1)
