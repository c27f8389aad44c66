"""What to try where a problem ended badly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from torchgco.base.status import Status

FITS = (Status.CONVERGED, Status.FEASIBLE)
GAVE_UP = (Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, Status.NOT_POSITIVE_DEFINITE)  # it may be infeasible
LIMITS = ("max_outer_iterations", "max_iterations", "iterations", "rounds", "starts", "budget")  # options of solvers
DEEP = 2  # parts of a solver within each other in which limits are looked for
MANY = 3  # limits that are named

BY_STATUS = {
    Status.FEASIBLE: "More iterations lower the cost: torchgco.solve(problem, warm=solution), or higher "
    'limits{limits}; solver="interior_point" with it goes on to the last digits.',
    Status.MAX_ITERATIONS: "Higher limits{limits}, or torchgco.solve(problem, warm=solution), which goes on from here.",
    Status.LINE_SEARCH_FAILED: "Units in which states, controls and costs are of similar size; no kinks (abs, clamp) "
    "in dynamics, cost and constraints.",
    Status.NOT_POSITIVE_DEFINITE: "A small weight on every control, as R > 0 of a QuadraticCost; bounds, where the "
    "cost may fall without end.",
    Status.NON_FINITE: 'Another U0, bounds on the controls, a smaller dt, or another integrator: "rk4", for a stiff '
    'model "radau5".',
    Status.INFEASIBLE: "Another guess U0, {longer}wider bounds; or loosen {row}, to see whether it is what "
    "makes the problem infeasible.",
    Status.TIME_LIMIT: 'A larger max_seconds, or solver="gco_fast".',
    Status.UNBOUNDED: "Bounds on what grows, or a cost that keeps it small.",
    Status.INVALID_START: "A start x0 outside the obstacles, whose radii here include the vehicle's.",
}
OTHER_START = (
    "No control moves the row named above: the start x0 breaks it. The controls returned are those found for all other "
    "rows."
)
NO_SLOPE = (
    "The violated rows have no slope where it ended, as a comparison or a rounding has none, and a product whose "
    "factors are 0: no step lowers them."
)
SMOOTH_ROWS = (
    "Another guess U0; or rows that change smoothly with states and controls, such as x - 1 in the place of "
    "(x > 1) * 1.0."
)
MOVED = "A start x0 that keeps this row, or the row from a later knot on: knots=slice(1, N + 1)."
MISSED = "The goal is required, and no trajectory that was found meets it: the best one misses it by {missed}."
TOUCHES = "All constraints hold at the knots, and the vehicle touches an obstacle between two of them."
COVERED = "The goal is required, and an obstacle, grown by the vehicle's radius, covers all of it."
STOPS_SHORT = "{longer}or a larger terminal weight: the trajectory stops short of the goal."
ENOUGH = (
    'Another guess U0, solver="gco_max", or a larger terminal weight: the trajectory stops short of the goal, though '
    "the horizon suffices for the way."
)
NEARER = (
    "{longer}weaker limits, or a larger radius of the goal; without required=True the solve tells how near it gets."
)
OFF_MAP = (
    'A {off} on the map; or read(path, outside="free"), on the command line scenario.outside=free, where there is room '
    "around it."
)
OTHER_GOAL = "A goal that no obstacle covers, or a larger radius of it."
SHORTER_STEPS = 'A smaller dt, or integrator="rk4" where it is another one; of a stiff model integrator="radau5".'
FINITE_CODE = (
    "Numbers and code of that part that are finite there, derivatives too: no root or norm at 0, for instance."
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
        flat: whether no violated row has a slope where the solve ended.
        horizon: of the stages and the way to the goal, with `suffices`, and a sentence as its text; None: unknown.
        body: whether the vehicle isn't a ball: `radius` is then that of the ball about its position that it holds.
        off_map: "start" or "goal", where that lies outside of a map that is occupied all around.
        named: whether the row that is violated most is named to the reader before.
        missed: by how much a required goal is missed, with its unit; None: it isn't, or isn't required.
        covered: whether one obstacle covers all of a required goal.
        steps: what shows that dt is too long for the model; None: nothing does.
        lost: which part isn't finite along finite states, and where; None: none, or the states aren't finite.
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
    flat: bool = False
    named: bool = False
    missed: str | None = None
    covered: bool = False
    horizon: Any = None
    body: bool = False
    off_map: str | None = None
    steps: str | None = None
    lost: str | None = None

    @property
    def touches(self) -> bool:
        """Whether it ended badly between the knots alone."""
        bad = self.status is Status.INFEASIBLE and not self.named
        return bad and self.clearance is not None and self.clearance < 0

    @property
    def told(self) -> list[str]:
        """Why the solve ended so, in sentences."""
        if self.unmoved:
            return [OTHER_START]
        if self.lost is not None:
            return [self.status.sentence, f"{self.lost}."]
        if self.touches:
            return [TOUCHES]
        if self.flat:
            return [self.status.sentence, NO_SLOPE]
        if self.radius is None and self.missed is not None:
            return [self.status.sentence, COVERED if self.covered else MISSED.format(missed=self.missed)]
        if self.radius is None:
            return [self.status.sentence]
        room = "none of any radius" if self.passage == 0.0 else f"the widest has room for {self.passage:.3g} m"
        what = "the ball inside the body," if self.body else "a vehicle"
        no_way = f"No way through the map leads {what} of radius {self.radius:.3g} m to the goal: {room}."
        if self.off_map is not None:
            no_way += f" The {self.off_map} lies outside of the map, which is occupied all around."
        return [self.status.sentence, no_way]

    @property
    def longer(self) -> str:
        """The horizon among other things to try, unless the way to the goal tells whether it is too short."""
        return "a longer horizon N, " if self.horizon is None or self.horizon.suffices is None else ""


def advice(facts: Facts) -> list[str]:
    """Sentences, the most useful first; none where nothing is amiss."""
    if facts.in_unknown:
        return [KNOWN_START]
    if facts.unmoved:
        return [MOVED]
    if facts.lost is not None:
        return [FINITE_CODE]
    if facts.off_map is not None:
        return [OFF_MAP.format(off=facts.off_map)]
    if facts.flat:
        return [SMOOTH_ROWS]
    if facts.radius is not None:
        size = "a narrower body" if facts.body else f"a vehicle_radius of at most {facts.passage:.3g} m"
        smaller = f", or {size}" if facts.passage > 0 else ""
        return [f"A goal on the start's side of the walls, or a map with a wider way{smaller}."]
    sentences = list[str]()
    if facts.steps is not None:
        sentences.append(SHORTER_STEPS)
    if facts.among_obstacles and facts.seeks_paths is False and not (facts.status in FITS and facts.reached):
        sentences.append('solver="gco", the default, which seeks paths around obstacles on a roadmap.')
    if facts.horizon is not None and facts.horizon.suffices is False and not facts.reached:
        sentences.append(str(facts.horizon))
    if facts.pathless and not facts.reached:
        sentences.append("A look at the scene (torchgco.plot): no path to the goal was found between the obstacles.")
    if facts.touches:
        sentences.append("A smaller dt, or a larger vehicle_radius: constraints hold at the knots alone.")
    elif facts.status in FITS and facts.reached is False:
        suffices = facts.horizon is not None and facts.horizon.suffices
        sentences.append(ENOUGH if suffices else capital(STOPS_SHORT.format(longer=facts.longer).removeprefix("or ")))
    elif facts.missed is not None and facts.status is Status.INFEASIBLE:
        sentences.append(OTHER_GOAL if facts.covered else capital(NEARER.format(longer=facts.longer)))
    elif facts.status in BY_STATUS:
        limits = [f"{name}={value}" for name, value in limits_of(facts.solver)][:MANY]
        row = "the row named above" if facts.named else "one constraint after the other"
        limited = f" ({', '.join(limits)})" if limits else ""
        reasons = [Status.INFEASIBLE] if facts.named and facts.status in GAVE_UP else []
        sentences += [
            BY_STATUS[s].format(limits=limited, row=row, longer=facts.longer) for s in (*reasons, facts.status)
        ]
    if tells_to_record(facts):
        sentences.append("torchgco.solve(..., record=True), after which explain tells what each pass did.")
    return sentences


def capital(text: str) -> str:
    """The text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


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
