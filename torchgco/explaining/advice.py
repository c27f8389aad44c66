"""What to try where a problem ended badly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from torchgco.base.status import Status

FITS = (Status.CONVERGED, Status.FEASIBLE)
LIMITS = ("max_outer_iterations", "max_iterations", "iterations", "rounds", "starts", "budget")  # options of solvers
DEEP = 2  # parts of a solver within each other in which limits are looked for
MANY = 3  # limits that are named

BY_STATUS = {
    Status.FEASIBLE: "More iterations lower the cost: torchgco.solve(problem, warm=solution), or higher "
    "limits{limits}; torchgco.Polish() refines float64 solutions.",
    Status.MAX_ITERATIONS: "Higher limits{limits}, or torchgco.solve(problem, warm=solution), which goes on from here.",
    Status.LINE_SEARCH_FAILED: "Units in which states, controls and costs are of similar size; no kinks (abs, clamp) "
    "in dynamics, cost and constraints.",
    Status.NOT_POSITIVE_DEFINITE: "A small weight on every control, as R > 0 of a QuadraticCost; bounds, where the "
    "cost may fall without end.",
    Status.NON_FINITE: 'Another U0, bounds on the controls, a smaller dt, or integrator="rk4".',
    Status.INFEASIBLE: "Another guess U0, a longer horizon N, wider bounds; or loosen {row}, to see whether it is what "
    "makes the problem infeasible.",
    Status.TIME_LIMIT: 'A larger max_seconds, or solver="gco_fast".',
    Status.UNBOUNDED: "Bounds on what grows, or a cost that keeps it small.",
    Status.INVALID_START: "A start x0 outside the obstacles, whose radii here include the vehicle's.",
}
OTHER_START = (
    "No control moves the row named above: the start x0 breaks it. The controls returned are those found for all other "
    "rows."
)
MOVED = "A start x0 that keeps this row, or the row from a later knot on: knots=slice(1, N + 1)."
MISSED = "The goal is required, and no trajectory that was found meets it: the best one misses it by {missed}."
COVERED = "The goal is required, and an obstacle, grown by the vehicle's radius, covers all of it."
NEARER = (
    "A longer horizon N, weaker limits, or a larger radius of the goal; without required=True the solve tells how near "
    "it gets."
)
OTHER_GOAL = "A goal that no obstacle covers, or a larger radius of it."
SHORTER_STEPS = (
    'A smaller dt, or integrator="rk4" where it is another one. A stiff model takes an implicit step, '
    'with integrator="none".'
)
KNOWN_START = (
    "A start where the map knows that it is free; or let unknown cells, which count as occupied, count as free: "
    'DistanceField.of(grid, unknown="free"), on the command line scenario.unknown=free.'
)


@dataclass(frozen=True)
class Facts:
    """What is known of one problem and its result.

    Args:
        seeks_paths: whether the solver looks for ways around obstacles; None: unknown.
        among_obstacles: whether there are any.
        reached: None where there is no goal, or none that can be judged.
        goal_distance: m, of the last knot.
        clearance: m, between knots too; None where it can't be judged.
        pathless: whether the record shows searches for paths, none of which found any.
        could_record: whether the solver can record more than it did.
        radius: of the vehicle, m, where no way through the map leads it to the goal.
        passage: the largest radius, m, that some way has room for; 0: none.
        in_unknown: whether the start is invalid for unknown cells of a map alone.
        unmoved: whether all violated rows have the same values for all controls.
        named: whether the row that is violated most is named to the reader before.
        missed: by how much a required goal is missed, with its unit; None: it isn't, or isn't required.
        covered: whether one obstacle covers all of a required goal.
        steps: what shows that dt is too long for the model; None: nothing does.
    """

    status: Status
    solver: Any = None
    seeks_paths: bool | None = None
    among_obstacles: bool = False
    reached: bool | None = None
    goal_distance: float | None = None
    clearance: float | None = None
    pathless: bool = False
    could_record: bool = False
    radius: float | None = None
    passage: float = 0.0
    in_unknown: bool = False
    unmoved: bool = False
    named: bool = False
    missed: str | None = None
    covered: bool = False
    steps: str | None = None

    @property
    def told(self) -> list[str]:
        """Why the solve ended so, in sentences."""
        if self.unmoved:
            return [OTHER_START]
        if self.radius is None and self.missed is not None:
            return [self.status.sentence, COVERED if self.covered else MISSED.format(missed=self.missed)]
        if self.radius is None:
            return [self.status.sentence]
        room = "none of any radius" if self.passage == 0.0 else f"the widest has room for {self.passage:.3g} m"
        no_way = f"No way through the map leads a vehicle of radius {self.radius:.3g} m to the goal: {room}."
        return [self.status.sentence, no_way]


def advice(facts: Facts) -> list[str]:
    """Sentences, the most useful first; none where nothing is amiss."""
    if facts.in_unknown:
        return [KNOWN_START]
    if facts.unmoved:
        return [MOVED]
    if facts.radius is not None:
        smaller = f", or a vehicle_radius of at most {facts.passage:.3g} m" if facts.passage > 0 else ""
        return [f"A goal on the start's side of the walls, or a map with a wider way{smaller}."]
    found = list[str]()
    if facts.steps is not None:
        found.append(SHORTER_STEPS)
    if facts.among_obstacles and facts.seeks_paths is False and not (facts.status in FITS and facts.reached):
        found.append('solver="gco", the default, which seeks paths around obstacles on a roadmap.')
    if facts.pathless and not facts.reached:
        found.append("A look at the scene (torchgco.plot): no path to the goal was found between the obstacles.")
    if facts.status in FITS and facts.clearance is not None and facts.clearance < 0:
        found.append("A smaller dt, or a larger vehicle_radius: constraints hold at the knots alone.")
    if facts.status in FITS and facts.reached is False:
        found.append("A longer horizon N, or a larger terminal weight: the trajectory stops short of the goal.")
    elif facts.missed is not None and facts.status is Status.INFEASIBLE:
        found.append(OTHER_GOAL if facts.covered else NEARER)
    elif facts.status in BY_STATUS:
        limits = [f"{name}={value}" for name, value in limits_of(facts.solver)][:MANY]
        row = "the row named above" if facts.named else "one constraint after the other"
        found.append(BY_STATUS[facts.status].format(limits=f" ({', '.join(limits)})" if limits else "", row=row))
    if tells_to_record(facts):
        found.append("torchgco.solve(..., record=True), after which explain tells what each pass did.")
    return found


def tells_to_record(facts: Facts) -> bool:
    """Whether a record is worth making."""
    return facts.could_record and not (facts.status in FITS and facts.reached is not False)


def limits_of(solver: Any, prefix: str = "", deep: int = 0) -> Iterator[tuple[str, Any]]:
    """The options of a solver that limit its work, with those of its parts: names as in `dataclasses.replace`."""
    if not is_dataclass(solver):
        return
    for name in LIMITS:
        if isinstance(value := getattr(solver, name, None), int) and not isinstance(value, bool):
            yield f"{prefix}{name}", value
    for field in fields(solver) if deep < DEEP else ():
        yield from limits_of(getattr(solver, field.name), f"{prefix}{field.name}.", deep + 1)
