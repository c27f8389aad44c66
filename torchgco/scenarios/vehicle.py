"""Vehicle: a planning model with its weights, limits and defaults; with layouts it makes a batch of problems."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, nan
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtLeast, Count, Extended, Meters, Natural, check_options, check_value
from torchgco.base.shapes import check_device
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.constraints.gates import Gates
from torchgco.costs.quadratic import QuadraticCost
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlanning
from torchgco.maps.field import Field
from torchgco.obstacles.body import Body
from torchgco.obstacles.boxes import Boxes, OscillatingBoxes
from torchgco.obstacles.spheres import Spheres
from torchgco.problem.free_time import FreeTime
from torchgco.problem.goal import Goal
from torchgco.problem.problem import Problem
from torchgco.scenarios.base import Family, Footing, Scenario
from torchgco.scenarios.layouts import SINES, Layouts

STATE_ARRAYS = ("state_weight", "terminal_weight", "start", "goal")  # fields with one number per state
CONTROL_LIMITS = ("control_lower", "control_upper")
CONTROL_ARRAYS = ("control_weight", "control_reference", *CONTROL_LIMITS)
# The models of conf/model: dimension of space and number of states.
BUILT_IN = {
    "planar": (2, 6), "unicycle": (2, 4), "car": (2, 5), "disc": (2, 4), "quadrotor": (3, 14), "rotors": (3, 13),
}  # fmt: skip
# Share of the control weights that is left, per second, where time is the cost: without any, controls that time doesn't
# ask for would be anything.
BESIDE_TIME = 1e-4


@dataclass(frozen=True)
class Task:
    """A batch of planning problems, with initial guess, goal and layouts."""

    problem: Problem
    U0: Tensor  # (B, N, m), the vehicle at rest; N is the most stages of a layout
    goal: Tensor  # (B, d), m
    goal_radius: float  # m
    layouts: Layouts  # with the vehicle's own numbers where they gave none

    def take(self, places: Sequence[int] | np.ndarray) -> Task:
        """The problems at some places, ascending."""
        rows = torch.as_tensor(places, device=self.U0.device)
        return Task(
            self.problem.take(rows), self.U0[rows], self.goal[rows], self.goal_radius, self.layouts.take(places)
        )  # fmt: skip


@dataclass(frozen=True)
class Vehicle:
    """A planning model with the values of the paper's tables. Layouts override the control bounds and all below.

    Args:
        name: as the study's column `model` shows it.
        dynamics: planning model; the layouts' time step overrides its own.
        state_weight, control_weight, terminal_weight: diagonals of Q, R, Qf.
        control_reference: u_ref (m,), also the initial guess: the vehicle at rest.
        control_lower, control_upper: (m,), in the units of the inputs; None for an input: the limit of the dynamics
            themselves (`control_limits`, as QuadrotorPlanning has them).
        start, goal: states (n,).
        radius: r_veh, m.
        goal_radius: m.
        stages: N.
        state_lower, state_upper: (n,), bounds on the states at all knots but the first; None for a state, or for all:
            no bound.
        speed: the largest, m/s, forwards and backwards, of a model with a state of this name; None: no bound.
        arrives: which states must be those of the goal at the end, where layouts require the goal or leave the time
            free; None: the position, within the goal's radius.
        footprint: corners [lower, upper] of the box that the vehicle fills, (d,) each from its position along its own
            axes, m: a `Body` of balls that cover it takes the place of the radius, of the layouts' too; None: the
            vehicle is a ball.
        cells: of a footprint, d whole numbers: how many balls there are along each axis, as of `Body.covering`.
        shape: instead of a footprint any `Body`, also one with parts, such as a car with a trailer.
        constraints: that every problem has besides, without numbers per problem.

    Raises:
        InputError: a field of another kind, length or out of its range; on `task`: layouts of another dimension, with
            states of another length, or with different numbers of gates (see `Layouts.alike`).
    """

    name: str
    dynamics: Dynamics
    state_weight: Sequence[float]
    control_weight: Sequence[float]
    terminal_weight: Sequence[float]
    control_reference: Sequence[float]
    control_lower: Sequence[Extended | None]
    control_upper: Sequence[Extended | None]
    start: Sequence[float]
    goal: Sequence[float]
    radius: Annotated[float, AtLeast(0, "m")]
    goal_radius: Meters
    stages: Count
    state_lower: Sequence[Extended | None] | None = None
    state_upper: Sequence[Extended | None] | None = None
    speed: Annotated[float, Above(0, "m/s")] | None = None
    arrives: Sequence[Natural] | None = None
    footprint: Sequence[Sequence[float]] | None = None
    cells: Sequence[Count] | None = None
    shape: Body | None = None
    constraints: Sequence[Constraint] | None = None

    def __post_init__(self) -> None:
        check_options(self, "vehicle")
        n, m = self.dynamics.n, self.dynamics.m
        for name in ("state_lower", "state_upper"):
            if getattr(self, name) is not None and len(getattr(self, name)) != n:
                raise InputError(f"vehicle.{name}", f"{n} numbers", repr(getattr(self, name)))
        if self.speed is not None and "speed" not in self.dynamics.state_names:
            raise InputError("vehicle.speed", "none for a model without a state of this name", self.speed)
        if self.arrives is not None and not all(i < n for i in self.arrives):
            raise InputError("vehicle.arrives", f"some of the states 0..{n - 1}", repr(self.arrives))
        if (self.footprint is None) != (self.cells is None):
            raise InputError("vehicle.cells", "numbers for a footprint, and none without one", repr(self.cells))
        if self.footprint is not None and self.shape is not None:
            raise InputError("vehicle.shape", "none beside a footprint", self.shape)
        _ = self.body
        for names, length in ((STATE_ARRAYS, n), (CONTROL_ARRAYS, m)):
            for name in names:
                if len(getattr(self, name)) != length:
                    raise InputError(f"vehicle.{name}", f"{length} numbers", repr(getattr(self, name)))
        for name in CONTROL_LIMITS:
            self.limits(name)

    @classmethod
    def quadrotor(cls, airframe: Airframe | None = None, **changes: Any) -> Self:
        """A quadrotor with the paper's weights (Table 1); by default the paper's own.

            vehicle = Vehicle.quadrotor(Airframe(mass=1.2, arm=0.15, thrust_max=4.5, radius=0.3))

        Args:
            changes: other values of fields, such as state_weight.

        Raises:
            InputError: as the class.
        """
        frame = check_value(Airframe() if airframe is None else airframe, Airframe, "airframe")
        rest = [0.0] * 3 + [1.0] + [0.0] * 6 + [frame.gravity]  # after the position: v, q, w, a
        defaults: dict[str, Any] = {
            "name": "quadrotor", "dynamics": QuadrotorPlanning(airframe=frame),
            "state_weight": [1.0, 1, 100, *[1.0] * 7, 10, 10, 10, 10], "control_weight": [10.0, 10, 10, 1],
            "terminal_weight": [1.0, 1, 10, *[1.0] * 11], "control_reference": [0.0, 0, 0, frame.gravity],
            "control_lower": [-5.0, -5, -5, None], "control_upper": [5.0, 5, 5, None],  # rad/s
            "start": [-1.0, 1, 0, *rest], "goal": [20.0, 1, 0.2, *rest],
            "radius": frame.radius, "goal_radius": 2.0, "stages": 100,
        }  # fmt: skip
        return cls(**(defaults | changes))

    def among(self, scenario: Scenario, ids: Iterable[int], seed: int = 0, **where: Any) -> Task:
        """The problems of this vehicle, with its own radius, on layouts of a scenario; `where` as of `task`.

        Raises:
            InputError: as `task`.
        """
        if isinstance(scenario, Family):
            scenario = replace(scenario, vehicle_radius=self.radius)
        return self.task(self.at_rest(self.flying(scenario).draw(list(ids), seed)), **where)

    def flying(self, scenario: Scenario) -> Scenario:
        """The scenario with starts and goals that are free for this vehicle, where it is a body and they are drawn."""
        body, position = self.body, self.dynamics.position
        if body is None or position is None or scenario.dimension != self.dimension:
            return scenario
        nothing = Layouts(np.zeros((1, 0, self.dimension)), np.zeros((1, 0)))
        balls, inner = self.task(nothing).problem.obstacles[0].body, body.inscribed_radius
        if balls is None:  # a single ball at the position
            return scenario.flown_by(Footing.of_ball(inner, self.dimension))
        states = torch.tensor([list(self.start), list(self.goal)], dtype=torch.float64)
        centers = balls.points.at(states.unsqueeze(0))[0] - states[:, None, position]
        start, goal = torch.cat((centers, balls.radii.view(1, -1, 1).expand(2, -1, 1)), dim=-1).numpy()
        return scenario.flown_by(Footing(start, goal, inner))

    @property
    def dimension(self) -> int:
        """d of the space that the vehicle moves in; 0 for dynamics without a position."""
        position = self.dynamics.position
        return 0 if position is None else position.stop - position.start

    @property
    def body(self) -> Body | None:
        """The shape, or balls that cover the footprint, turned by heading or quaternion; None for a ball."""
        if self.footprint is None or self.cells is None:
            return self.shape
        if len(self.footprint) != 2:
            raise InputError("vehicle.footprint", "two corners of a box", repr(self.footprint))
        attitude = "heading" if self.dimension == 2 else "quaternion"
        try:
            return Body.covering(self.footprint[0], self.footprint[1], self.cells, attitude)
        except InputError as error:
            field = "vehicle.cells" if error.field == "body.cells" else "vehicle.footprint"
            raise InputError(field, error.expected, error.got) from None

    def limits(self, name: Literal["control_lower", "control_upper"]) -> list[float]:
        """The bounds (m,), with those of the dynamics where the vehicle gives none.

        Raises:
            InputError: none in a place where the dynamics have no limit either.
        """
        usual = getattr(self.dynamics, "control_limits", ([None] * self.dynamics.m,) * 2)[CONTROL_LIMITS.index(name)]
        bounds = list[float]()
        for i, (value, limit) in enumerate(zip(getattr(self, name), usual, strict=True)):
            bound = limit if value is None else value
            if bound is None:
                raise InputError(f"vehicle.{name}[{i}]", "a number: the dynamics have no limit here", None)
            bounds.append(bound)
        return bounds

    def task(self, layouts: Layouts, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float64) -> Task:
        """The planning problems of these layouts: quadratic cost to the goal, obstacles, control bounds (section 5).

        Raises:
            InputError: layouts that don't fit the vehicle, a device that isn't there, or another dtype than float64 and
                float32.
        """
        if not isinstance(layouts, Layouts):
            raise InputError("layouts", "Layouts", type(layouts).__name__)
        if dtype not in (torch.float64, torch.float32):
            raise InputError("dtype", "torch.float64 or torch.float32", repr(dtype))
        if layouts.vehicles is not None:
            raise InputError(
                "layouts.apart", "None: a fleet is a task for each of its vehicles, of_vehicle(v)", layouts.apart
            )
        device = check_device(device)
        if layouts.dimension != self.dimension:
            states = layouts.start if layouts.start is not None else layouts.goal
            wanted = fitting(layouts.dimension, None if states is None else states.shape[-1])
            raise InputError("model", f"{wanted} for the {layouts.dimension}-D {layouts.name}", self.name)
        whole = self.completed(layouts)
        assert whole.goal_radius is not None and whole.stages is not None
        tensor = partial(torch.as_tensor, dtype=dtype, device=device)
        dynamics = self.dynamics if layouts.dt is None else replace(self.dynamics, dt=layouts.dt)  # type: ignore
        longest = int(np.max(whole.stages))
        horizon = torch.as_tensor(whole.stages, device=device) if np.ndim(whole.stages) else None
        gates, legs = gates_of(layouts, longest)
        constraints = self._constraints(whole, tensor)
        constraints += [] if gates is None else [replace(gates, centers=tensor(gates.centers))]
        time, start, goal = free_time(layouts, legs), tensor(whole.start), tensor(whole.goal)
        rest, moving = (1.0, 1.0) if time is None else (0.0, BESIDE_TIME * dynamics.dt)
        at_rest = tensor(list(self.control_reference))
        cost = QuadraticCost(
            Q=rest * tensor(list(self.state_weight)), R=moving * tensor(list(self.control_weight)),
            Qf=rest * tensor(list(self.terminal_weight)), x_ref=goal.unsqueeze(1), u_ref=at_rest,
        )  # fmt: skip
        center = goal[:, dynamics.position]
        binds = time is not None or layouts.goal_required is True
        end = self._required(goal, center, whole.goal_radius) if binds else Goal(center, whole.goal_radius)
        problem = Problem(dynamics, cost, constraints, start, longest, end, horizon, time=time)
        return Task(
            problem, at_rest.expand(layouts.count, longest, -1).contiguous(), center, whole.goal_radius, whole
        )  # fmt: skip

    def _constraints(self, layouts: Layouts, tensor: Callable[[Any], Tensor]) -> list[Constraint]:
        """Obstacles and bounds of completed layouts, but for gates; `tensor` makes what they are made of."""
        assert layouts.vehicle_radius is not None
        radius, optional = self.body or layouts.vehicle_radius, lambda value: None if value is None else tensor(value)
        spheres = tensor(layouts.centers), tensor(layouts.radii), radius, optional(layouts.velocities)
        bounds = (tensor(_given(getattr(layouts, name), self.limits(name))) for name in CONTROL_LIMITS)
        constraints: list[Constraint] = [Spheres(*spheres), ControlBounds(*bounds)]
        if layouts.box_centers is not None:
            turns, rounding = optional(layouts.box_rotations), optional(layouts.box_radii)
            boxes = Boxes(tensor(layouts.box_centers), tensor(layouts.box_half_sizes), radius, turns, rounding)
            sines = [getattr(layouts, name) for name in SINES]
            constraints.append(boxes if sines[0] is None else OscillatingBoxes(boxes, *map(tensor, sines)))
        if layouts.map is not None:
            constraints.append(Field(layouts.map, radius))
        return constraints + self._state_bounds + list(self.constraints or ())

    @property
    def _state_bounds(self) -> list[StateBounds]:
        """Bounds on the states, where there are any."""
        if self.state_lower is None and self.state_upper is None and self.speed is None:
            return []
        sides = (self.state_lower, -inf), (self.state_upper, inf)
        lower, upper = (
            [none if bound is None else bound for bound in side or [None] * self.dynamics.n] for side, none in sides
        )
        if self.speed is not None:
            i = self.dynamics.state_names.index("speed")
            lower[i], upper[i] = max(lower[i], -self.speed), min(upper[i], self.speed)
        return [StateBounds(lower, upper)]

    def _required(self, goal: Tensor, center: Tensor, radius: float) -> Goal:
        """The goal that has to be met, at states (B, n)."""
        if self.arrives is None:
            return Goal(center, radius, required=True)
        free = torch.ones_like(goal[0], dtype=torch.bool)
        free[list(self.arrives)] = False
        return Goal(state=goal.masked_fill(free, nan), radius=radius, required=True)

    def completed(self, layouts: Layouts) -> Layouts:
        """The layouts with this vehicle's radius, start, goal and further numbers where they have none.

        These are the ones of `task`, and what a picture of its problems has to show.

        Raises:
            InputError: states of another length than the vehicle's.
        """
        layouts = self.at_rest(layouts)
        values: dict[str, Any] = {"vehicle_radius": self.radius, "goal_radius": self.goal_radius, "stages": self.stages}
        values = {name: _given(getattr(layouts, name), default) for name, default in values.items()}
        values |= {name: self._states(layouts, name) for name in ("start", "goal")}
        dt = self.dynamics.dt if layouts.dt is None else layouts.dt
        return replace(layouts, dt=dt if isinstance(dt, float | int) else None, **values)

    def at_rest(self, layouts: Layouts) -> Layouts:
        """The layouts with states where they give positions alone: the vehicle's own start or goal, moved there."""
        moved = {}
        for name in ("start", "goal"):
            points = getattr(layouts, name)
            if points is not None and points.shape[-1] == layouts.dimension == self.dimension:
                moved[name] = np.tile(np.array(getattr(self, name), np.float64), (*points.shape[:-1], 1))
                moved[name][..., self.dynamics.position] = points
        return replace(layouts, **moved) if moved else layouts

    def _states(self, layouts: Layouts, name: str):
        """start or goal (L, n): the layouts' own, or the vehicle's for all."""
        states = getattr(layouts, name)
        if states is None:
            return np.array([list(getattr(self, name))] * layouts.count, np.float64)
        if states.shape[-1] != self.dynamics.n:
            wanted = f"{self.dynamics.n} states of model={self.name}, or {self.dimension} coordinates"
            raise InputError(f"layouts.{name}", wanted, states.shape[-1])
        return states


def gates_of(layouts: Layouts, stages: int) -> tuple[Gates | None, list[int]]:
    """The gates of layouts, and the knots of a free time's legs, which have as many stages but for rounding.

    Raises:
        InputError: different numbers of gates.
    """
    counts = layouts.gate_counts
    if counts is None or layouts.gate_centers is None or layouts.gate_radii is None or not counts.any():
        return None, []
    count = int(counts[0])
    if (counts != count).any():
        raise InputError("layouts.gate_centers", "as many gates in all layouts of a batch", counts.tolist())
    legs = [round(stages * (leg + 1) / (count + 1)) for leg in range(count)]
    knots = None if layouts.free_time is None else legs
    return Gates(layouts.gate_centers[:, :count], layouts.gate_radii[:, :count].tolist(), knots=knots), legs


def free_time(layouts: Layouts, legs: list[int]) -> FreeTime | None:
    """The free time of layouts, with a duration for each leg; None where the time is given."""
    if layouts.free_time is None:
        return None
    least, most, weight = layouts.free_time.tolist()
    return FreeTime(least, most, weight, segments=legs or None)


def fitting(dimension: int, states: int | None) -> str:
    """The built-in models for layouts of this dimension and number of states (None: any), as words of a command."""
    fits = {name: n for name, (d, n) in BUILT_IN.items() if d == dimension}
    names = [name for name, n in fits.items() if n == states] or list(fits)
    return " or ".join(f"model={name}" for name in names)


def _given(value, default):
    return default if value is None else value
