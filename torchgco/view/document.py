"""What a page shows: layouts with obstacles and trajectories, and what these violate or touch at which place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.version import VERSION
from torchgco.judging.contact import contacts
from torchgco.judging.worst import kind_of
from torchgco.obstacles.base import Obstacles
from torchgco.plotting.gates import outlines
from torchgco.plotting.style import solver_colours
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.plotting.ways import ways_along
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.view.packing import LARGEST_HALF, Packing, number
from torchgco.view.sensed import Sensed
from torchgco.view.shapes import Shapes, shapes_of, unknown_of
from torchgco.view.vehicles import Look, Shape, look_of, shape_of, turned

Rows = list[tuple[str, str]]


@dataclass(frozen=True)
class ShownPhase:
    """A phase of a layout whose vehicle, stages and obstacles are each phase's own.

    Args:
        problem: of the phase.
        first: its first knot among those of all phases, of which two are at the time of a jump.
    """

    problem: Problem
    first: int

    def packed(self) -> dict[str, Any]:
        """As the page reads it: its stages, s, and its vehicle."""
        shape, dt = shape_of(self.problem), getattr(self.problem.dynamics, "dt", None) or 1.0
        return {
            "first": self.first, "stages": self.problem.N, "dt": number(dt),
            "body": look_of(self.problem.dynamics).body, "radius": number(radius_of(self.problem)),
            "shape": None if shape is None else shape.packed(),
        }  # fmt: skip


def radius_of(problem: Problem, otherwise: float = 0.0) -> float:
    """The radius of a vehicle, m: its body's reach, else that with which its obstacles count."""
    shape = shape_of(problem)
    if shape is not None:
        return shape.reach
    return max((float(obstacles.vehicle_radius.max()) for obstacles in problem.obstacles), default=otherwise)


@dataclass(frozen=True)
class ShownFlight:
    """One solver's trajectory through one layout.

    Args:
        solver: its name.
        path: positions (K, d) at the knots, m, up to the first that isn't finite.
        attitude: unit quaternions (K, 4) from the body to space; None: nothing turns the body.
        result: "success", "reached", "feasible" or "failed".
        rows: what is known about it, labels and texts, for the table and the hover.
        violation: (K,) the largest violation at each knot; m for lengths.
        worst: (K,) int: of which constraint; -1 where nothing is violated.
        contacts: (C, d) places where bodies touch, between knots too.
        crossings: (C', d) places where gates are passed.
        plan: (K, P, d) what the vehicle planned at each knot, of missions; None: nothing.
        notes: one text per knot for the hover, of missions; none: nothing to say.
        sensed: what the vehicle saw and sought, of missions with a sensor.
        phase: which of several phases it is one of; None: there is but one.
        way: positions (T, d) along the path that is judged, m, with `pieces` chords for each stage; None: the path's.
        times: (K,) of the knots, s; None: multiples of the page's `dt`, or the layout's.
    """

    solver: str
    path: np.ndarray
    attitude: np.ndarray | None
    result: str
    rows: Rows
    violation: np.ndarray
    worst: np.ndarray
    contacts: np.ndarray
    crossings: np.ndarray
    plan: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    sensed: Sensed | None = None
    phase: ShownPhase | None = None
    way: np.ndarray | None = None
    pieces: int = 1
    times: np.ndarray | None = None

    def until(self, last: int) -> ShownFlight:
        """The same up to a knot."""
        kept = slice(0, last + 1)
        attitude, times = (None if part is None else part[kept] for part in (self.attitude, self.times))
        way = None if self.way is None else self.way[: last * self.pieces + 1]
        return replace(
            self, path=self.path[kept], attitude=attitude, violation=self.violation[kept], worst=self.worst[kept],
            way=way, times=times,
        )  # fmt: skip

    def packed(self, packing: Packing, number_of: int) -> dict[str, Any]:
        """As the page reads it, under the number of its solver."""
        entry: dict[str, Any] = {
            "solver": number_of, "result": self.result, "rows": self.rows, "notes": self.notes,
            "contacts": np.round(self.contacts, 3).tolist(), "crossings": np.round(self.crossings, 3).tolist(),
            "path": packing.put(self.path, steps=True),
        }  # fmt: skip
        if self.attitude is not None:
            entry["attitude"] = packing.put(self.attitude)
        if self.way is not None:
            entry |= {"way": packing.put(self.way, steps=True), "pieces": self.pieces}
        if self.times is not None:
            entry["times"] = packing.put(self.times, steps=True)
        bad = np.flatnonzero(self.violation > 0)
        entry["violated"] = [[int(k), number(self.violation[k], 3), int(self.worst[k])] for k in bad]
        if self.plan is not None:
            entry["plan"] = packing.put(np.nan_to_num(self.plan), steps=True)
        if self.sensed is not None:
            entry["sensed"] = self.sensed.until(len(self.path)).packed(packing, self.path[:, 2])
        if self.phase is not None:
            entry["phase"] = self.phase.packed()
        return entry


def violated(
    problem: Problem, X: Tensor, U: Tensor, admitted: float, times: Tensor | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The largest violation (B, N+1) of each knot above `admitted`, and of which constraint; 0 and -1 elsewhere.

    Args:
        times: of the knots (B, N+1), s, where the time is free.
    """
    whole, X, U = at_times(problem, X, U, times)
    most = X.new_full((problem.B, problem.N + 1), admitted)
    worst = torch.full_like(most, -1, dtype=torch.int64)
    for index, constraint in enumerate(whole.constraints[: len(problem.constraints)]):  # before those of the time
        rows = constraint.violation(X, U)
        if rows.numel() == 0:
            continue
        knots = torch.arange(problem.N + 1, device=X.device)[constraint.knots]
        largest = rows.flatten(2).amax(-1).nan_to_num(0.0)
        more = largest > most[:, knots]
        most[:, knots] = torch.where(more, largest, most[:, knots])
        worst[:, knots] = torch.where(more, index, worst[:, knots])
    return torch.where(worst < 0, 0.0, most).cpu().numpy(), worst.cpu().numpy()


def worst_row(problem: Problem, violation: np.ndarray, worst: np.ndarray) -> Rows:
    """Which constraint is violated most, where and by how much, from the violations (K,) at the knots."""
    k = int(violation.argmax()) if len(violation) else 0
    if not len(violation) or worst[k] < 0:
        return []
    constraint = problem.constraints[worst[k]]
    unit = " m" if isinstance(constraint, Obstacles) else ""
    return [("worst", f"{kind_of(constraint)}, knot {k}: {violation[k]:.2g}{unit}")]


def whole(X: np.ndarray) -> np.ndarray:
    """The knots (K, n) of states (N+1, n) before the first that isn't finite, or is too far to be drawn."""
    good = np.isfinite(X).all(axis=1) & (np.abs(np.nan_to_num(X)) < LARGEST_HALF).all(axis=1)
    return X if good.all() else X[: int(good.argmin())]


def flights_of(
    problem: Problem,
    look: Look,
    X: Tensor,
    U: Tensor,
    solver: str,
    results: list[str],
    rows: list[Rows],
    admitted: float,
    touching: np.ndarray,
    times: Tensor | None = None,
) -> list[ShownFlight]:
    """The trajectories X (B, N+1, n), U (B, N, m) of one solver.

    Args:
        results, rows: of each problem, as in `ShownFlight`.
        admitted: the violation up to which nothing is marked.
        touching: (B,) bool: where contact is looked for.
        times: of the knots (B, N+1), s, where the time is free.
    """
    (violation, worst), flights = violated(problem, X, U, admitted, times), []
    states, body = X.detach().cpu().double().numpy(), VehicleBody.of(problem)
    ways = ways_along(problem, X, U, times, [range(problem.n)[problem.position]])
    for b, way in enumerate(ways):
        kept = whole(states[b])
        path, knots = kept[:, problem.position], slice(0, len(kept))
        fine = way.X[: way.pieces * (len(kept) - 1) + 1] if len(kept) else kept
        places = path[:0]
        bad, which = violation[b, knots], worst[b, knots]
        if touching[b] and len(path):
            single = problem.take(torch.tensor([b], device=X.device))
            places = contacts(single.obstacles, fine[:, problem.position], float(way.clock[1]), fine)
        told = [*rows[b], *worst_row(problem, bad, which)]
        attitude = look.attitude(kept) if body is None else turned(body, kept)
        flight = ShownFlight(solver, path, attitude, results[b], told, bad, which, places, way.crossings)
        if way.pieces > 1:
            flight = replace(flight, way=fine[:, problem.position], pieces=way.pieces)
        flights.append(flight if times is None else replace(flight, times=times[b, knots].cpu().double().numpy()))
    return flights


RING_CORNERS = 32  # of a gate that is a ball
SHARED_FROM = 500  # obstacles of one kind from which on layouts with the same ones share them


@dataclass
class Document:
    """A page in the making; lengths in metres, times in seconds.

    Args:
        title: of the page.
        about: a line below it.
        dimension: of space, 2 or 3.
        dt: between two knots.
        look: of the vehicle.
        radius: of the vehicle, 0 where there are no obstacles; of a body, its reach.
        solvers: their names, the one under study first.
        constraints: names of the problem's constraints, in their order.
        mission: whether the trajectories are flights in closed loop.
        shape: of a vehicle with a body; None: a ball of the radius.
    """

    title: str
    about: str
    dimension: int
    dt: float
    look: Look
    radius: float
    solvers: Sequence[str]
    constraints: Sequence[str] = ()
    mission: bool = False
    shape: Shape | None = None
    notes: list[str] = field(default_factory=list)
    labels: list[dict[str, Any]] = field(default_factory=list)
    parts: list[str] = field(default_factory=list)
    maps: dict[bytes, str] = field(default_factory=dict)  # parts that layouts share, by what they hold

    @classmethod
    def of(cls, problem: Problem, radius: float = 0.0, **given: Any) -> Document:
        """The page of a batch of problems, whose vehicle has a `radius`, m, where there are no obstacles."""
        position = problem.position
        names = [kind_of(constraint) for constraint in problem.constraints]
        size = {"radius": radius_of(problem, radius), "shape": shape_of(problem)}
        return cls(dimension=position.stop - position.start, constraints=names, **size, **given)  # type: ignore[arg-type]

    def add(
        self,
        label: str,
        problem: Problem,
        b: int,
        flights: Sequence[ShownFlight],
        search: SearchPart | None = None,
        times: np.ndarray | None = None,
        phases: Sequence[Problem] = (),
    ) -> None:
        """Add a layout: problem b of a batch, and its trajectories in the order of the solvers, where there are any.

        Args:
            times: (K,) of the knots of all flights, s; None: each flight's own, or multiples of `dt`.
            phases: the problem of each of several phases, of which `problem` is the first one.
        """
        packing, position, members = Packing(), problem.position, phases or [problem]
        last = members[-1]
        start = problem.x0[b, position].detach().cpu().double().numpy()
        goal = None if last.goal is None else last.goal.position[b].cpu().double().numpy()
        middle = start if goal is None else 0.5 * (start + goal)
        names = list(self.solvers)
        knots = max([problem.N, *(len(flight.path) - 1 for flight in flights)])
        ends = [float(each[-1]) for each in (times, *(flight.times for flight in flights)) if each is not None]
        duration = max(ends, default=knots * self.dt)
        content: dict[str, Any] = {
            "start": _numbers(start), "goal": None if goal is None else _numbers(goal),
            "goal_radius": None if last.goal is None else number(last.goal.radius[b]),
            "map": next((map_ for one in members if (map_ := _extent(one, b)) is not None), None),
            "gates": [gate for one in members for gate in outlines_of(one, b)],
            "obstacles": [
                self._placed(packing, shapes, middle) | ({"phase": i} if phases else {})
                for i, one in enumerate(members) for shapes in self._shapes(one.obstacles, b, duration)
            ],
            "flights": [flight.packed(packing, names.index(flight.solver)) for flight in flights],
            "search": None if search is None else search.packed(packing),
            "times": None if times is None else packing.put(times, steps=True), "free": problem.time is not None,
        }  # fmt: skip
        self.labels.append({"label": label, "results": {flight.solver: flight.result for flight in flights}})
        self.parts.append(packing.sealed(content))

    def ordered(self, places: Sequence[int]) -> None:
        """Put the layouts in another order: first the one at the first of these places."""
        self.labels, self.parts = [self.labels[i] for i in places], [self.parts[i] for i in places]

    def _placed(self, packing: Packing, shapes: Shapes, middle: np.ndarray) -> dict[str, Any]:
        """Obstacles in the layout's part; many of them, as of a map, in a part that layouts of equal ones share."""
        if len(shapes.center) < SHARED_FROM:
            return shapes.packed(packing, middle)
        shared = Packing()
        text = shared.sealed(shapes.packed(shared, 0.5 * (shapes.center.min(axis=0) + shapes.center.max(axis=0))))
        places = list(self.maps)
        key = sha256(text.encode()).digest()
        self.maps.setdefault(key, text)
        return {"shared": places.index(key) if key in places else len(places)}

    def _shapes(self, obstacles: Sequence[Obstacles], b: int, duration: float) -> list[Any]:
        drawn = []
        for core in (core.inscribed for core in obstacles):  # those of a body are the obstacles of each of its balls
            shapes = shapes_of(core, b, duration)
            if shapes is None:
                note = f"not drawn: {type(core).__name__}"
                self.notes += [] if note in self.notes else [note]
            elif len(shapes.center):
                drawn.append(shapes)
            if (unknown := unknown_of(core, b)) is not None:
                drawn.append(unknown)
        return drawn

    def head(self) -> str:
        """What holds for all layouts, compressed."""
        colours = solver_colours(self.solvers)
        text = {
            "title": self.title, "about": self.about, "dimension": self.dimension, "dt": number(self.dt),
            "body": self.look.body, "radius": number(self.radius), "mission": self.mission, "version": VERSION,
            "solvers": [{"name": name, "colour": colours[name]} for name in self.solvers],
            "constraints": list(self.constraints), "layouts": self.labels, "notes": self.notes,
            "shape": None if self.shape is None else self.shape.packed(),
        }  # fmt: skip
        return Packing().sealed(text)


def _extent(problem: Problem, b: int) -> list[list[float | None]] | None:
    """Lower and upper corner of the maps of a problem, m; None without one."""
    maps = (obstacles.map for obstacles in problem.obstacles if obstacles.map is not None)
    fields = [(map_.field, int(map_.which[b])) for map_ in maps]
    if not fields:
        return None
    low, high = [field.origin[g] for field, g in fields], [field.upper[g] for field, g in fields]
    return [_numbers(np.min(low, axis=0)), _numbers(np.max(high, axis=0))]


def _numbers(values: np.ndarray) -> list[float | None]:
    return [number(value) for value in values]


def outlines_of(problem: Problem, b: int) -> list[list[list[float | None]]]:
    """Closed lines, each a list of corners (d,), m, of the gates of problem b in their order."""
    if not (gates := outlines(problem, b)):
        return []
    start = problem.x0[b, problem.position].detach().cpu().double().numpy()
    centers = [corners.mean(axis=0) for corners, _ in gates]
    ends = centers[-1:] if problem.goal is None else [problem.goal.position[b].detach().cpu().double().numpy()]
    ways = np.array([*centers[1:], *ends]) - [start, *centers[:-1]]
    rows = zip(gates, centers, ways, strict=True)
    closed = [_ring(center, radius, way) if radius > 0 else corners for (corners, radius), center, way in rows]
    return [[_numbers(corner) for corner in outline] for outline in closed]


def _ring(center: np.ndarray, radius: float, along: np.ndarray) -> np.ndarray:
    """Corners (V, d) of a circle; in space across the direction `along`."""
    angle = np.linspace(0.0, 2.0 * np.pi, RING_CORNERS, endpoint=False)
    if len(center) == 2:
        return center + radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    size = np.linalg.norm(along)
    normal = along / size if size > 0 else np.array([1.0, 0.0, 0.0])
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    return center + radius * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(normal, side))


@dataclass(frozen=True)
class Line:
    """A path or a trajectory of a search: corners (K, d), m, and what is said about it."""

    points: np.ndarray
    kind: str  # "path", "caught", "tracked", "relaxed" or "refined"
    group: int  # its homotopy class
    fate: str
    text: str


@dataclass(frozen=True)
class SearchPart:
    """A search for ways around obstacles, as the page shows it on demand.

    Args:
        passes: what each pass of the solver did, in words.
        rounds: a name and its lines for each comparison of candidates, in their order.
        guides: balls (K, d + 1), centre and radius, and the sampled trajectory (K', d), of each outer iteration with
            guidance on.
    """

    passes: list[str] = field(default_factory=list)
    rounds: list[tuple[str, Sequence[Line]]] = field(default_factory=list)
    guides: list[tuple[str, np.ndarray, np.ndarray]] = field(default_factory=list)

    def packed(self, packing: Packing) -> dict[str, Any]:
        rounds = [{"name": name, "lines": [_line(packing, line) for line in lines]} for name, lines in self.rounds]
        guides = [
            {"name": name, "balls": packing.put(balls), "sample": packing.put(sample, steps=True)}
            for name, balls, sample in self.guides
        ]
        return {"passes": self.passes, "rounds": rounds, "guides": guides}


def _line(packing: Packing, line: Line) -> dict[str, Any]:
    entry = {"kind": line.kind, "group": line.group, "fate": line.fate, "text": line.text}
    return entry | {"points": packing.put(line.points, steps=True)}
