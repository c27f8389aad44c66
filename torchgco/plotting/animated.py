"""Solutions as films: mp4, gif, or in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from torchgco.base.errors import InputError
from torchgco.plotting.animation import PALE
from torchgco.plotting.bodies import ABOVE, SIDE, Plane, silhouettes
from torchgco.plotting.layouts import ROCK
from torchgco.plotting.problems import WIDTH, Course, SceneMap, courses_of, is_shared
from torchgco.plotting.scene import World, distances
from torchgco.plotting.style import INK, TITLE
from torchgco.problem.in_time import paced
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution

FPS = 20
MAX_FRAMES = 240  # longer flights are shown faster


class Film(FuncAnimation):
    """An animation that notebooks play; `at(t)` draws an instant, s, and returns what it has drawn."""

    def __init__(self, figure: Figure, at: Callable[[float], list[Artist]], times: np.ndarray) -> None:
        self.at = at
        pause = 1000 * float(times[-1]) / (len(times) - 1)
        super().__init__(figure, at, frames=times.tolist(), interval=pause, cache_frame_data=False)

    def _repr_html_(self) -> str:
        return self.to_jshtml()

    def __del__(self) -> None:
        """A film may go unseen: matplotlib's own warns of that."""


def solution_film(problem: Problem, solution: Solution, b: int | Sequence[int]) -> Film:
    """The film of `torchgco.animate`; see there."""
    problem = current_problem(problem)
    courses, unit = courses_of(problem, solution, b)
    position = problem.dynamics.position
    planes = {2: (ABOVE,), 3: (ABOVE, SIDE)}.get(0 if position is None else position.stop - position.start)
    if planes is None:
        raise InputError("problem", "dynamics with a position in 2-D or 3-D", type(problem.dynamics).__name__)
    if not is_shared(problem, courses):
        raise InputError("b", "problems among the same obstacles", b)
    scene = SceneMap.of(paced(problem, solution.times), courses, planes)
    figure = Figure(figsize=(WIDTH, scene.height(WIDTH) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    _at_rest(scene).draw(figure)
    last = max(float(course.t[-1]) for course in courses)
    times = np.linspace(0.0, last, min(MAX_FRAMES, max(2, round(FPS * last) + 1)))
    for ax in figure.axes[1:]:
        ax.set_title(
            f"from the side, what is at rest cut where problem {courses[0].b} flies", fontsize=TITLE, loc="left"
        )
    title = figure.axes[0].set_title("Mg", fontsize=TITLE, loc="left", color=INK)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the axes stay where they are
    shown = list[Artist]()

    def show(t: float) -> list[Artist]:
        while shown:
            shown.pop().remove()
        title.set_text(f"{t:.1f} s" if unit != "knot" else f"knot {t:.1f}")
        nominal = scene.world.first.dt * float(np.interp(t, courses[0].t, np.arange(len(courses[0].t))))
        for ax, plane in zip(figure.axes, planes, strict=True):
            shown.extend(_moving(ax, scene.world, plane, nominal))
            for course in courses:
                shown.extend(_vehicle(ax, scene.world, course, plane, t))
        return shown

    return Film(figure, show, times)


def _at_rest(scene: SceneMap) -> SceneMap:
    """The scene without what moves, and with pale trajectories."""
    world = scene.world
    scenes = [
        replace(part, bodies=tuple(tuple(body for body in bodies if not body.moving) for bodies in part.bodies))
        for part in world.scenes
    ]
    others = tuple(other for other in world.others if not other.moving)
    courses = [replace(course, colour=PALE, touches=False) for course in scene.courses]
    return replace(scene, world=replace(world, scenes=tuple(scenes), others=others, body=None), courses=courses)


def _moving(ax: Axes, world: World, plane: Plane, t: float) -> list[Artist]:
    """What moves, where it is at t, s, of stages that last dt."""
    look: dict[str, Any] = {"facecolor": (*to_rgb(ROCK), 0.6), "zorder": 1.0}
    bodies = [body for scene in world.scenes for body in scene.bodies[0] if body.moving]
    drawn: list[Artist] = [ax.add_patch(Polygon(body.outline(0.0, plane, t), **look)) for body in bodies]
    box = np.transpose([ax.get_xlim(), ax.get_ylim()])
    for other in world.others:
        if other.moving:
            x, y, apart = distances(other, box, plane, 0.0, t)
            drawn.append(ax.contourf(x, y, apart, levels=[-np.inf, 0.0], colors=[ROCK], zorder=1.0))
    return drawn


def _vehicle(ax: Axes, world: World, course: Course, plane: Plane, t: float) -> list[Artist]:
    """A trajectory up to t, s, and the vehicle there: its body, or a ball of its radius."""
    past, drawn = course.t <= t, list[Artist]()
    for path in course.paths:
        now = np.array([np.interp(t, course.t, path[:, i]) for i in plane])
        way = np.concatenate((path[past][:, plane], now[None]))
        drawn += ax.plot(*way.T, color=course.colour, linewidth=1.4, zorder=7)
        if world.body is None:
            radius = world.first.margin or 0.01 * float(np.ptp(ax.get_xlim()))
            drawn.append(ax.add_patch(Circle((now[0], now[1]), radius, color=course.colour, zorder=8)))
    if world.body is not None:
        state = np.array([[np.interp(t, course.t, component) for component in course.X.T]])
        if not np.isfinite(state).all():
            return drawn
        look: dict[str, Any] = {"facecolor": (*to_rgb(course.colour), 0.4), "edgecolor": course.colour, "zorder": 8}
        drawn += [ax.add_patch(Polygon(outline, **look)) for outline in silhouettes(world.body, state, plane)]
    return drawn
