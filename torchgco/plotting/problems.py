"""A problem and its solution: the scene with the trajectories, and states and controls over time with their limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from torchgco.base.errors import InputError
from torchgco.base.shapes import check_shape
from torchgco.constraints import Separation
from torchgco.constraints.bounds import bounds_of
from torchgco.dynamics.names import controls_of, states_of
from torchgco.judging.contact import contacts
from torchgco.obstacles.base import ADMITTED
from torchgco.plotting.bodies import ABOVE, SIDE, Plane
from torchgco.plotting.gates import Outline, draw_gates, outlines
from torchgco.plotting.layouts import (
    ROCK,
    draw_obstacles,
    draw_others,
    draw_targets,
    marked,
    marker,
    moving_corners,
    moving_handles,
)
from torchgco.plotting.maps import draw_map, map_handles
from torchgco.plotting.scene import World, flown, leaving, passes, view, world_of
from torchgco.plotting.style import EDGE, INK, PALETTE, SMALL, TEXT, NotebookFigure, legend_columns, tidy
from torchgco.plotting.trajectory import LIMIT
from torchgco.plotting.ways import Way, ways_along
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.times import times
from torchgco.solution import Solution

WIDTH = 9.0  # inches
PANELS_ACROSS = 4  # of histories
PANEL = 1.45  # inches, the height of a history
TALLEST_SCENE, TALLEST_MAP = 4.2, 7.5  # inches, the height of a scene, and of one with a map, which has fine parts
SHOWN_PROBLEMS = 6  # problems that are shown where none are named
LIMIT_SPANS = 1.0  # spans of the data within which a limit is shown


@dataclass(frozen=True, eq=False)
class Course:
    """The trajectory of one problem."""

    b: int
    X: np.ndarray  # (N+1, n)
    U: np.ndarray  # (N, m)
    t: np.ndarray  # (N+1,)
    colour: str
    label: str
    keeps: bool  # whether its constraints hold
    touches: bool  # whether contact is looked for
    way: Way  # between the knots, too


@dataclass(frozen=True, eq=False)
class Leg:
    """Trajectories of a problem: all there is, or one phase of several."""

    problem: Problem
    courses: list[Course]
    unit: str  # of t

    @classmethod
    def of(cls, problem: Problem, solution: Solution, b: int | Sequence[int] | None) -> Leg:
        problem = current_problem(problem)
        return cls(problem, *courses_of(problem, solution, b))

    def after(self, begins: np.ndarray, labels: Sequence[str]) -> Leg:
        """The same, of problems that begin at times (B,), with other labels (B,)."""
        moved = []
        for course in self.courses:
            begin, label = begins[course.b], labels[course.b]
            way = replace(course.way, t=course.way.t + begin)
            moved.append(replace(course, t=course.t + begin, label=label, way=way))
        return replace(self, courses=moved)

    @property
    def planes(self) -> tuple[Plane, ...]:
        position = self.problem.dynamics.position
        return {2: (ABOVE,), 3: (ABOVE, SIDE)}.get(0 if position is None else position.stop - position.start, ())


def solution_figure(problem: Problem, solution: Solution, b: int | Sequence[int] | None = None) -> Figure:
    """The figure of `torchgco.plot`; see there."""
    return figure_of([Leg.of(problem, solution, b)])


def legs_of(
    problems: Sequence[Problem], solutions: Sequence[Solution], begins: np.ndarray, costs: np.ndarray, b: Any
) -> list[Leg]:
    """Phases, one after the other.

    Args:
        problems, solutions: of each phase.
        begins: when each begins, (B, P+1), s.
        costs: of all phases together, (B,).
    """
    statuses = solutions[0].statuses
    told = enumerate(zip(statuses, costs, strict=True))
    labels = [f"problem {i}: {status.name}, cost {cost:.6g}" for i, (status, cost) in told]
    pairs = enumerate(zip(problems, solutions, strict=True))
    return [Leg.of(*pair, b).after(begins[:, i], labels) for i, pair in pairs]


def figure_of(legs: Sequence[Leg]) -> Figure:
    """Scenes, in which all legs are drawn, and the histories of all."""
    courses, panels = legs[0].courses, _panels(legs)
    scenes = _scenes(legs)
    rows = ceil(len(panels) / PANELS_ACROSS)
    high = max((scene[0].height(WIDTH / len(scenes)) for scene in scenes), default=0.0)
    figure = NotebookFigure(figsize=(WIDTH, high + PANEL * rows), layout="constrained")
    lower: Figure | SubFigure = figure
    lines: list[Artist] = [Line2D([], [], color=course.colour, label=course.label) for course in courses]
    lines.append(Line2D([], [], color=LIMIT, linestyle="--", linewidth=0.9, label="bound, where it is near"))
    if len(legs) > 1:
        lines.append(Line2D([], [], color=INK, linestyle=":", linewidth=0.9, label="the next phase begins"))
    if scenes:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(high, PANEL * rows))[:, 0]
        drawn = set[str]()
        for panel, scene in zip(upper.subfigures(1, len(scenes), squeeze=False)[0], scenes, strict=True):
            axes = scene[0].axes(panel)
            drawn = drawn.union(*(of_leg.draw_into(axes) for of_leg in scene))
        lines += _handles([of_leg for scene in scenes for of_leg in scene], drawn)
    _histories(lower, panels, legs)
    across = legend_columns(lines, WIDTH)
    figure.set_figheight(high + PANEL * rows + 0.1 + 0.23 * ceil(len(lines) / across))
    look: dict[str, Any] = {"fontsize": TEXT, "frameon": False, "ncols": across}
    figure.legend(handles=lines, loc="outside upper left", **look)
    return figure


def _scenes(legs: Sequence[Leg]) -> list[list[SceneMap]]:
    """A scene for all courses, or one for each where their obstacles differ, with a map per leg; none where a leg has
    no position, or one of another dimension."""
    planes = legs[0].planes
    if not planes or any(leg.planes != planes for leg in legs):
        return []
    places = range(len(legs[0].courses))
    shared = all(is_shared(leg.problem, leg.courses) for leg in legs)
    scenes = []
    for group in [places] if shared else [[i] for i in places]:
        maps = [SceneMap.of(leg.problem, [leg.courses[i] for i in group], planes) for leg in legs]
        scenes.append(in_one_box(maps))
    return scenes


def in_one_box(maps: Sequence[SceneMap]) -> list[SceneMap]:
    """The same scenes, all with the extent of all."""
    corners = np.stack([one.box for one in maps])
    box = np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    return [replace(one, box=box) for one in maps]


def _places(b: Any, B: int) -> list[int]:
    """The places of the problems to show."""
    places = list(range(min(B, SHOWN_PROBLEMS))) if b is None else [b] if isinstance(b, int) else b
    whole = isinstance(places, Sequence) and all(isinstance(i, int) and not isinstance(i, bool) for i in places)
    if not whole or not places or any(not 0 <= i < B for i in places):
        raise InputError("b", f"the place of a problem, 0 to {B - 1}, or a list of some", b)
    return list(dict.fromkeys(places))


def courses_of(problem: Problem, solution: Solution, b: int | Sequence[int] | None) -> tuple[list[Course], str]:
    """The trajectories, each up to its own last knot, and the unit of t: s, or knots of a model without time step.

    Raises:
        InputError: a place that isn't there, or a solution of other problems.
    """
    check_shape(solution.X, (problem.B, problem.N + 1, problem.n), "problem: solution.X")
    check_shape(solution.U, (problem.B, problem.N, problem.m), "problem: solution.U")
    places = _places(b, problem.B)
    try:
        t, unit = times(problem) if solution.times is None else solution.times, "t [s]"
    except InputError:
        t, unit = torch.arange(problem.N + 1, device=problem.x0.device), "knot"
    some, found = problem.take(torch.tensor(places, device=problem.x0.device)), solution.take(places)
    shown, touching = [], _touching(some, found)
    ways = ways_along(some, found.X, found.U, found.times, _positions(problem))
    for i, b in enumerate(places):
        last = int(problem.stages[b])
        X, U = (array[b].detach().cpu().double().numpy() for array in (solution.X, solution.U))
        label = f"problem {b}: {solution.statuses[b].name}, cost {float(solution.cost[b]):.6g}"
        moments = (t if t.dim() == 1 else t[b]).cpu().double().numpy()
        X, U, moments = X[: last + 1], U[:last], moments[: last + 1]
        keeps = bool(solution.violation[b] <= ADMITTED)
        way = ways[i].until(moments)
        shown.append(Course(b, X, U, moments, PALETTE[i % len(PALETTE)], label, keeps, touching[i], way))
    return shown, unit


def _touching(problem: Problem, solution: Solution) -> list[bool]:
    """Where contact is looked for: a straight line may touch what the path between the knots doesn't."""
    try:
        frame = solution.to_frame(problem)
    except InputError:  # obstacles of a kind that can't be judged
        return [True] * problem.B
    return (~(frame["clearance"] >= 0)).tolist() if "clearance" in frame else [False] * problem.B


def _positions(problem: Problem) -> list[list[int]]:
    """The states of the position, and of those of other vehicles that keep a distance from it."""
    position = problem.dynamics.position
    if position is None:
        return []
    positions = [list(range(position.start, position.stop))]
    for constraint in problem.constraints:
        if isinstance(constraint, Separation):
            positions += [states for states in constraint.positions.tolist() if states not in positions]
    return positions


def is_shared(problem: Problem, courses: list[Course]) -> bool:
    """Whether one scene serves all: they have the same obstacles and goals."""
    rows = torch.tensor([course.b for course in courses], device=problem.x0.device)
    cores = [obstacles.inscribed for obstacles in problem.obstacles]  # all problems have the same body
    parts = [getattr(core.take(rows), name) for core in cores for name in core.batched]
    parts += [] if problem.goal is None else [problem.goal.position[rows]]
    tensors = [tensor for tensor in parts if isinstance(tensor, torch.Tensor)]
    return all(torch.equal(tensor.nan_to_num(), tensor[:1].expand_as(tensor).nan_to_num()) for tensor in tensors)


@dataclass(frozen=True, eq=False)
class SceneMap:
    """A scene with the trajectories in it."""

    world: World
    courses: list[Course]
    planes: tuple[Plane, ...]
    box: np.ndarray  # (2, d): lower and upper corner, m
    gates: list[Outline]

    @classmethod
    def of(cls, problem: Problem, courses: list[Course], planes: tuple[Plane, ...]) -> SceneMap:
        world = world_of(problem, courses[0].b)
        kept, others = ([flown(p) for c in courses for p in c.way.paths if c.keeps == which] for which in (True, False))
        gates, inside = outlines(problem, courses[0].b), [view(scene, [0], kept, others) for scene in world.scenes]
        for course in courses:
            for scene in world.scenes:
                inside += moving_corners(scene, 0, course.way.paths[0], course.way.clock)
            if world.body is not None and course.keeps:
                inside.append(world.body.extent(flown(course.X)))
        inside += [corners + sign * radius for corners, radius in gates for sign in (-1.0, 1.0)]
        points = np.concatenate(inside)
        box = np.stack([points.min(axis=0), points.max(axis=0)])
        return cls(world, courses, planes, box, gates)

    @property
    def shares(self) -> list[float]:
        """The heights of the planes, in widths."""
        span = self.box[1] - self.box[0]
        return [float(span[plane[1]] / span[0]) for plane in self.planes]

    def height(self, wide: float) -> float:
        """Inches, for a width in inches."""
        tallest = TALLEST_SCENE if all(scene.map is None for scene in self.world.scenes) else TALLEST_MAP
        return min(tallest, wide * sum(self.shares)) + 0.45 * len(self.planes)

    def draw(self, figure: Figure | SubFigure) -> set[str]:
        """Draw each plane into axes of its own; returns the kinds of what is drawn, for the legend."""
        return self.draw_into(self.axes(figure))

    def axes(self, figure: Figure | SubFigure) -> Sequence[Axes]:
        """Axes for each plane."""
        ratios = {"height_ratios": self.shares}
        return figure.subplots(len(self.planes), 1, squeeze=False, gridspec_kw=ratios)[:, 0]  # type: ignore[no-any-return]

    def draw_into(self, axes: Sequence[Axes]) -> set[str]:
        """`draw` into axes that are there."""
        return set().union(*(self._plane(ax, plane) for ax, plane in zip(axes, self.planes, strict=True)))

    def _plane(self, ax: Axes, plane: Plane) -> set[str]:
        ax.set(xlim=self.box[:, plane[0]], ylim=self.box[:, plane[1]], aspect="equal")
        lead = flown(self.courses[0].way.paths[0])
        drawn = self._obstacles(ax, plane, lead)
        for course in self.courses:
            drawn |= self._course(ax, plane, course)
        draw_targets(ax, self.world.first, 0, plane)
        draw_gates(ax, self.gates, plane)
        for course in self.courses[1:]:
            start: dict[str, Any] = {"marker": "s", "markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.5}
            ax.plot(*course.way.paths[0][:1, plane].T, color=INK, zorder=2.5, linestyle="none", **start)
        ax.set(xlim=self.box[:, plane[0]], ylim=self.box[:, plane[1]])
        ax.set(xlabel="x [m]" if plane == self.planes[-1] else "", ylabel=f"{'xyz'[plane[1]]} [m]")
        words = {ABOVE: "from above", SIDE: "from the side"}
        told = f"{words[plane]}, obstacles cut where problem {self.courses[0].b} flies" if len(self.planes) > 1 else ""
        tidy(ax, told, grid=None)
        return drawn

    def _obstacles(self, ax: Axes, plane: Plane, lead: np.ndarray) -> set[str]:
        drawn = set[str]()
        for scene in self.world.scenes:
            ways = {course.colour: course.way for course in self.courses}
            leads = {colour: passes(scene, 0, way.paths[0], way.clock) for colour, way in ways.items()}
            drawn |= draw_obstacles(ax, scene, 0, leads, plane)
            if scene.map is not None:
                drawn |= draw_map(ax, scene.map, lead if len(lead) else scene.start, plane, scene.margin, (ROCK, EDGE))
        return drawn | draw_others(ax, self.world.others, lead, plane)

    def _course(self, ax: Axes, plane: Plane, course: Course) -> set[str]:
        """Draw a trajectory, where it touches something, and where it leaves the picture."""
        drawn = set[str]()
        look: dict[str, Any] = {"color": course.colour, "zorder": 3}
        for path in course.way.paths:
            shown = flown(path)[:, plane]
            ax.plot(*shown.T, linewidth=1.2, marker=".", markersize=3, markevery=course.way.pieces, **look)
            if (away := leaving(self.box[:, plane], shown)) is not None:
                ax.plot(*away[0][:, None], color=course.colour, zorder=6, clip_on=False, **marker("away", away[1]))
                drawn.add("away")
        if self.world.body is not None:
            self.world.body.draw(ax, flown(course.X), plane, course.colour)
            drawn.add("body")
        way, path = course.way, flown(course.way.paths[0])
        marks = {"passed": way.crossings}
        if course.touches and len(path) > 0:
            marks["contact"] = contacts(self.world.obstacles, path, float(way.clock[1]), way.X[: len(path)])
        for kind, places in marks.items():
            if len(places):
                ax.plot(*places[:, plane].T, color=course.colour, zorder=4, **marker(kind))
                drawn.add(kind)
        return drawn


def _handles(maps: Sequence[SceneMap], drawn: set[str]) -> list[Artist]:
    """Entries of the legend of all maps."""
    shapes: dict[str, Artist] = {
        "own": Patch(facecolor=ROCK, label="obstacle"),
        "grown": Patch(facecolor="none", edgecolor=EDGE, label="plus the vehicle's radius"),
        "body": Patch(facecolor="none", edgecolor=INK, label="the vehicle's body, at some knots"),
        "others": Patch(facecolor=ROCK, label="obstacle, plus the vehicle's radius"),
    }
    of_maps = [handle for map_ in maps for scene in map_.world.scenes for handle in map_handles(scene.map)]
    moving = moving_handles("the trajectory of its colour", INK) if "moving" in drawn else []
    known = {handle.get_label(): handle for handle in reversed(of_maps)}
    points = marked(drawn, maps[0].world.first)
    return [*points, *(shape for kind, shape in shapes.items() if kind in drawn), *moving, *known.values()]


@dataclass(frozen=True, eq=False)
class Component:
    """A state or control of a leg."""

    leg: Leg
    state: bool
    j: int

    def series(self, course: Course) -> np.ndarray:
        return (course.X if self.state else course.U)[:, self.j]


def _panels(legs: Sequence[Leg]) -> dict[tuple[bool, str], list[Component]]:
    """What each panel of the histories shows: states, then controls, of legs with the same name of it."""
    panels: dict[tuple[bool, str], list[Component]] = {}
    for state, named in ((True, states_of), (False, controls_of)):
        for leg in legs:
            for j, quantity in enumerate(named(leg.problem.dynamics)):
                panels.setdefault((state, quantity.label), []).append(Component(leg, state, j))
    return panels


def _histories(
    figure: Figure | SubFigure, panels: dict[tuple[bool, str], list[Component]], legs: Sequence[Leg]
) -> None:
    """A panel for each state and control."""
    count = len(panels)
    rows = ceil(count / PANELS_ACROSS)
    axes = list(figure.subplots(rows, min(PANELS_ACROSS, count), squeeze=False, sharex=True).flat)
    for i, (ax, ((state, label), components)) in enumerate(zip(axes, panels.items(), strict=False)):
        look: dict[str, Any] = {} if state else {"drawstyle": "steps-post"}
        for component in components:
            for course in component.leg.courses:
                values = component.series(course)
                held = values if state else np.append(values, values[-1:])  # the last one for a stage, too
                ax.plot(course.t[: len(held)], held, color=course.colour, linewidth=1.2, **look)
        for leg in legs[1:]:
            for course in leg.courses:
                colour = INK if len(leg.courses) == 1 else course.colour
                ax.axvline(course.t[0], color=colour, linestyle=":", linewidth=0.9, zorder=1)
        _limits(ax, components)
        tidy(ax, label)
        ax.title.set_fontsize(TEXT)
        ax.tick_params(labelsize=SMALL - 1)
        if i + PANELS_ACROSS >= count:
            ax.set_xlabel(legs[0].unit, fontsize=SMALL)
            ax.tick_params(labelbottom=True)
    for ax in axes[count:]:
        ax.remove()


def _limits(ax: Axes, components: Sequence[Component]) -> None:
    """Dashed lines at the bounds of a component, of those that are near its values: far ones would flatten these."""
    values = [one.series(course) for one in components for course in one.leg.courses]
    finite = np.concatenate([series[np.isfinite(series)] for series in values])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1e-9))
    ends, near = [low, high], (low - LIMIT_SPANS * span, high + LIMIT_SPANS * span)
    for component in components:
        ends += _bounds_near(ax, component, near)
    edge = 0.06 * max(max(ends) - min(ends), span)
    if finite.size:
        ax.set_ylim(min(ends) - edge, max(ends) + edge)


def _bounds_near(ax: Axes, component: Component, near: tuple[float, float]) -> list[float]:
    """Draw the bounds of a component that are between two values; how far these reach."""
    problem, state, j = component.leg.problem, component.state, component.j
    count, ends = problem.N + 1 if state else problem.N, list[float]()
    for bounds in bounds_of(problem.constraints, "x" if state else "u"):
        if j >= bounds.lower.shape[-1]:
            continue
        for bound in bounds.over(count):
            for course in component.leg.courses:
                row = bound[course.b if bound.shape[0] > 1 else 0, :, j].cpu().double().numpy()
                row = np.broadcast_to(row, (count,))[: len(course.X if state else course.U)]
                shown = np.isfinite(row) & (row >= near[0]) & (row <= near[1])
                if shown.any():
                    mark: dict[str, Any] = {"marker": "_"} if shown.sum() == 1 else {}
                    look: dict[str, Any] = {"color": LIMIT, "linestyle": "--", "linewidth": 0.9, "zorder": 1}
                    ax.plot(course.t[: len(row)], np.where(shown, row, np.nan), **look, **mark)
                    ends += [float(row[shown].min()), float(row[shown].max())]
    return ends
