"""What a page shows: layouts, each with its obstacles and the trajectories flown through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

import numpy as np

from torchgco.base.version import VERSION
from torchgco.judging.worst import kind_of
from torchgco.obstacles.base import Obstacles
from torchgco.plotting.gates import outlines
from torchgco.plotting.style import solver_colours
from torchgco.problem.problem import Problem
from torchgco.view.flights import ShownFlight
from torchgco.view.packing import Packing, number
from torchgco.view.shapes import Shapes, shapes_of, unknown_of
from torchgco.view.vehicles import Look, Shape, shape_of

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
        shape, position = shape_of(problem), problem.position
        radius = max((float(obstacles.vehicle_radius.max()) for obstacles in problem.obstacles), default=radius)
        names = [kind_of(constraint) for constraint in problem.constraints]
        size = {"radius": radius if shape is None else shape.reach, "shape": shape}
        return cls(dimension=position.stop - position.start, constraints=names, **size, **given)  # type: ignore[arg-type]

    def add(
        self,
        label: str,
        problem: Problem,
        b: int,
        flights: Sequence[ShownFlight],
        search: SearchPart | None = None,
        times: np.ndarray | None = None,
    ) -> None:
        """Add a layout: problem b of a batch, and its trajectories in the order of the solvers, where there are any.

        Args:
            times: (N+1,) of the knots, s; None: multiples of `dt`.
        """
        packing, position = Packing(), problem.position
        start = problem.x0[b, position].detach().cpu().double().numpy()
        goal = None if problem.goal is None else problem.goal.position[b].cpu().double().numpy()
        middle = start if goal is None else 0.5 * (start + goal)
        names = list(self.solvers)
        content: dict[str, Any] = {
            "start": _numbers(start), "goal": None if goal is None else _numbers(goal),
            "goal_radius": None if problem.goal is None else number(problem.goal.radius[b]),
            "map": _extent(problem, b), "gates": outlines_of(problem, b),
            "obstacles": [self._placed(packing, shape, middle) for shape in self._shapes(problem.obstacles, b)],
            "flights": [flight.packed(packing, names.index(flight.solver)) for flight in flights],
            "search": None if search is None else search.packed(packing),
            "times": None if times is None else packing.put(times, steps=True),
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

    def _shapes(self, obstacles: Sequence[Obstacles], b: int) -> list[Any]:
        drawn = []
        for core in (core.inscribed for core in obstacles):  # those of a body are the obstacles of each of its balls
            shapes = shapes_of(core, b)
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
