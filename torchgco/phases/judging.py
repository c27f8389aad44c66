"""`torchgco.judge` and `certify`, of problems, fleets and phases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.solution import FleetSolution
from torchgco.fleets.verdict import FleetVerdict, judge_fleet
from torchgco.judging import certificate
from torchgco.judging import judge as judging
from torchgco.judging.certificate import Certificate
from torchgco.judging.judge import Verdict
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution, PhasesVerdict, certify_phases, judge_phases
from torchgco.problem.problem import Problem


@overload
def judge(
    problem: Problem,
    U: Tensor,
    goal: Tensor | None = None,
    goal_radius: Tensor | float | None = None,
    start: Tensor | None = None,
    times: Tensor | None = None,
) -> Verdict: ...
@overload
def judge(problem: Fleet, U: FleetSolution | Sequence[Tensor]) -> FleetVerdict: ...
@overload
def judge(problem: Phases, U: PhasesSolution) -> PhasesVerdict: ...


def judge(
    problem: Problem | Fleet | Phases,
    U: Tensor | FleetSolution | PhasesSolution | Sequence[Tensor],
    goal: Tensor | None = None,
    goal_radius: Tensor | float | None = None,
    start: Tensor | None = None,
    times: Tensor | None = None,
) -> Verdict | FleetVerdict | PhasesVerdict:
    """Judge controls U (B, N, m) by their rollout from the start: any controls of any model, in float64.

    Args:
        problem: the problems; of a model without a position cost, violation and feasibility are judged. Those in
            float32 are judged in float64, with their numbers as they are. Or a fleet, whose vehicles are judged one by
            one, and in pairs: between the knots, too. Or phases, each judged as a problem that begins where the jump
            leads from the end of the one before.
        U: controls, float64 or float32; NaN where a solver returned none: such a problem is neither feasible nor
            reached. Of a fleet its solution, or controls of each vehicle, and of phases their solution; nothing more.
        goal: positions (B, d) or (d,), m. None: the problem's goal; where it has none, nothing is reached.
        goal_radius: number or (B,), m, above 0. None: that of the problem's goal.
        start: (B, n), the starts found, such as `solution.X[:, 0]`, where some are free. One that differs from x0 in a
            component that isn't free is not feasible. None: x0, where none is free.
        times: (B, N+1), s, of the knots where the time is free, such as `solution.t`; a duration out of its bounds is
            not feasible. None: the time isn't free.

    Raises:
        InputError: U, goal, radius or start don't fit the problem, a goal is given without a radius, or for dynamics
            without a position, starts are free and none are given, or obstacles are of a kind that can't be judged.
    """
    more = {"goal": goal, "goal_radius": goal_radius, "start": start, "times": times}
    if not isinstance(problem, Fleet | Phases):
        controls: Any = U
        return judging.judge(problem, controls, **more)
    if given := [name for name, value in more.items() if value is not None]:
        whose = "a fleet" if isinstance(problem, Fleet) else "phases"
        raise InputError(f"judge.{given[0]}", f"None of {whose}, whose problems say all", shown(more[given[0]]))
    if isinstance(problem, Phases):
        return judge_phases(problem, U)
    controls = [one.U for one in U] if isinstance(U, FleetSolution) else U
    if isinstance(controls, Tensor) or not isinstance(controls, Sequence) or len(controls) != problem.V:
        raise InputError("U", f"a FleetSolution, or controls (B, N, m) of each of {problem.V} vehicles", shown(U))
    return judge_fleet(problem, controls)


@overload
def certify(
    problem: Problem,
    X: Tensor,
    U: Tensor,
    asked: Tensor | None = None,
    multipliers: Sequence[Tensor] | None = None,
    times: Tensor | None = None,
) -> Certificate: ...
@overload
def certify(problem: Phases, X: PhasesSolution, *, asked: Tensor | None = None) -> Certificate: ...


def certify(
    problem: Problem | Phases,
    X: Tensor | PhasesSolution,
    U: Tensor | None = None,
    asked: Tensor | None = None,
    multipliers: Sequence[Tensor] | None = None,
    times: Tensor | None = None,
) -> Certificate:
    """Certify trajectories X (B, N+1, n), U (B, N, m); or all phases and jumps of a solution as one problem.

    The clearance includes collisions between knots that are both outside an obstacle. With Euler steps, positions and
    obstacles move straight from knot to knot, so distances are exact (for boxes: lower bounds within 1e-9). For
    midpoint and rk4 the path leaves the chord by at most dt^2 / 8 times the largest acceleration; this is subtracted.
    The acceleration is sampled at both ends of the interval and at the half step, and the largest difference between
    samples is added: this is a bound only if the acceleration varies by no more than that between them. Steps without a
    known field (`integrator="none"`, a class that overrides `step` alone) have no path between knots; distances are
    then those of the chord. Geometric constraints other than obstacles count at their knots only, as violations.

    Rows that may have a fitted multiplier are equalities, and inequalities with a slack of at most 1e-3 (m for
    obstacles). A test to many digits needs multipliers that are given: those of an interior point push a little from
    far rows, too.

    Args:
        problem: the planning problems; those in float32 are certified in float64, with their numbers as they are. Or
            phases, of whose steps in all the largest error counts, and by how much they change the cost of all.
        X, U: the trajectories that a solver returned, float64 or float32; of phases their solution alone, with whose
            multipliers they are tested.
        asked: (B,) bool, the problems to certify; NaN for the others. None: all.
        multipliers: (B, K, p) of each constraint, such as `solution.multipliers.lam`; wherever they come from, they are
            tested. Below 0 they count as 0, but for equalities. None: fitted.
        times: (B, N+1), s, of the knots where the time is free, such as `solution.t`. The KKT residual then is with
            respect to the factors of time, too; multipliers of their bounds are those that fit best.

    Raises:
        InputError: X, U, asked or multipliers don't fit the problem.
    """
    if not isinstance(problem, Phases):
        trajectory: tuple[Any, Any] = X, U
        return certificate.certify(problem, *trajectory, asked, multipliers, times)
    for name, value in (("U", U), ("multipliers", multipliers), ("times", times)):
        if value is not None:
            raise InputError(f"certify.{name}", "None of phases, whose solution says all", shown(value))
    return certify_phases(problem, X, asked)
