"""`torchgco.judge`, of problems, fleets and phases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.solution import FleetSolution
from torchgco.fleets.verdict import FleetVerdict, judge_fleet
from torchgco.judging import judge as judging
from torchgco.judging.judge import Verdict
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution
from torchgco.phases.verdict import PhasesVerdict, judge_phases
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
