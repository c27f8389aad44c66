"""Solutions as films: mp4, gif, or in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation, writers
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from PIL import Image

from torchgco.base.errors import InputError
from torchgco.plotting.animation import PALE
from torchgco.plotting.bodies import Plane
from torchgco.plotting.layouts import ROCK
from torchgco.plotting.problems import WIDTH, Course, Leg, SceneMap, in_one_box, is_shared
from torchgco.plotting.scene import World, distances
from torchgco.plotting.style import INK, TITLE
from torchgco.problem.problem import Problem
from torchgco.solution import Solution

FPS = 20
MAX_FRAMES = 240  # longer flights are shown faster


class Film(FuncAnimation):
    """An animation that notebooks play; `at(t)` draws an instant, s, and returns what it has drawn."""

    def __init__(self, figure: Figure, at: Callable[[float], list[Artist]], times: np.ndarray) -> None:
        self.at, self.figure = at, figure
        pause = 1000 * float(times[-1]) / (len(times) - 1)
        super().__init__(figure, at, frames=times.tolist(), interval=pause, cache_frame_data=False)

    def save(self, filename: Any, writer: Any = None, *args: Any, **options: Any) -> None:
        """As of matplotlib's FuncAnimation.

        Raises:
            InputError: a film that ffmpeg would have to make, where there is none.
        """
        Image.init()
        form = Image.registered_extensions().get(Path(filename).suffix.lower())
        if writer is None and form not in Image.SAVE_ALL and not writers.is_available("ffmpeg"):
            raise InputError("filename", "a name.gif, as ffmpeg, which makes other films, isn't installed", filename)
        super().save(filename, writer, *args, **options)

    def _repr_html_(self) -> str:
        return self.to_jshtml()

    def __del__(self) -> None:
        """A film may go unseen: matplotlib's own warns of that."""


def solution_film(problem: Problem, solution: Solution, b: int | Sequence[int]) -> Film:
    """The film of `torchgco.animate`; see there."""
    return film_of([Leg.of(problem, solution, b)], b)


def film_of(legs: Sequence[Leg], b: int | Sequence[int], radii: Sequence[float] | None = None) -> Film:
    """The film of all legs, one after the other, each among its own obstacles.

    Args:
        legs: with the same trajectories.
        b: as given to `torchgco.animate`.
        radii: of balls that are drawn as the vehicles of these trajectories, m; None: bodies, or the problem's ball.

    Raises:
        InputError: see `torchgco.animate`.
    """
    scenes = _scenes_of(legs, b)
    figure = Figure(figsize=(WIDTH, scenes[0].height(WIDTH) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = scenes[0].axes(figure)
    standing = [_standing(scene, axes) for scene in scenes]
    last = max(float(course.t[-1]) for course in legs[-1].courses)
    times = np.linspace(0.0, last, min(MAX_FRAMES, max(2, round(FPS * last) + 1)))
    for ax in axes[1:]:
        ax.set_title(
            f"from the side, what is at rest cut where problem {legs[0].courses[0].b} flies", fontsize=TITLE, loc="left"
        )
    title = axes[0].set_title("Mg", fontsize=TITLE, loc="left", color=INK)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the axes stay where they are
    shown = list[Artist]()

    def show(t: float) -> list[Artist]:
        while shown:
            shown.pop().remove()
        present = _present(legs, 0, t)
        now = f"{t:.1f} s" if legs[0].unit != "knot" else f"knot {t:.1f}"
        title.set_text(now if len(legs) == 1 else f"{now}, phase {present + 1} of {len(legs)}")
        for i, artists in enumerate(standing):
            for artist in artists:
                artist.set_visible(i == present)
        longest = max((course.way for course in legs[present].courses), key=lambda way: float(way.t[-1]))
        world = scenes[present].world
        seconds = float(np.interp(t, longest.t, longest.clock))
        for ax, plane in zip(axes, scenes[0].planes, strict=True):
            shown.extend(_moving(ax, world, plane, seconds))
            for place in range(len(legs[0].courses)):
                at = _present(legs, place, t)
                for i in range(at + 1):
                    radius = None if radii is None else radii[place]
                    shown.extend(_vehicle(ax, scenes[i].world, legs[i].courses[place], plane, t, i == at, radius))
        return shown

    return Film(figure, show, times)


def _scenes_of(legs: Sequence[Leg], b: int | Sequence[int]) -> list[SceneMap]:
    """A scene for each leg, all of one extent."""
    planes = legs[0].planes
    for leg in legs:
        if not planes or leg.planes != planes:
            expected = "dynamics with a position in 2-D or 3-D" + (", of all phases the same" if len(legs) > 1 else "")
            raise InputError("problem", expected, type(leg.problem.dynamics).__name__)
        if not is_shared(leg.problem, leg.courses):
            raise InputError("b", "problems among the same obstacles", b)
    return in_one_box([SceneMap.of(leg.problem, leg.courses, planes) for leg in legs])


def _present(legs: Sequence[Leg], place: int, t: float) -> int:
    """Which leg a problem's trajectory is in at t."""
    return max([i for i, leg in enumerate(legs) if leg.courses[place].t[0] <= t], default=0)


def _standing(scene: SceneMap, axes: Sequence[Axes]) -> list[Artist]:
    """Draw what is at rest in a scene; what was drawn."""
    known = {artist for ax in axes for artist in ax.get_children()}
    _at_rest(scene).draw_into(axes)
    return [artist for ax in axes for artist in ax.get_children() if artist not in known]


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
    """What moves, where it is at t, s."""
    look: dict[str, Any] = {"facecolor": (*to_rgb(ROCK), 0.6), "zorder": 1.0}
    bodies = [body for scene in world.scenes for body in scene.bodies[0] if body.moving]
    drawn: list[Artist] = [ax.add_patch(Polygon(body.outline(0.0, plane, t), **look)) for body in bodies]
    box = np.transpose([ax.get_xlim(), ax.get_ylim()])
    for other in world.others:
        if other.moving:
            x, y, apart = distances(other, box, plane, 0.0, t)
            drawn.append(ax.contourf(x, y, apart, levels=[-np.inf, 0.0], colors=[ROCK], zorder=1.0))
    return drawn


def _vehicle(
    ax: Axes, world: World, course: Course, plane: Plane, t: float, is_there: bool, radius: float | None
) -> list[Artist]:
    """A trajectory up to t, s, and the vehicle, where it is there: a ball of this radius, its body, or its own ball."""
    past, drawn, body = course.way.t <= t, list[Artist](), world.body if radius is None else None
    for path in course.way.paths:
        now = np.array([np.interp(t, course.way.t, path[:, i]) for i in plane])
        way = np.concatenate((path[past][:, plane], now[None]))
        drawn += ax.plot(*way.T, color=course.colour, linewidth=1.4, zorder=7)
        if body is None and is_there:
            size = radius or world.first.margin or 0.01 * float(np.ptp(ax.get_xlim()))
            drawn.append(ax.add_patch(Circle((now[0], now[1]), size, color=course.colour, zorder=8)))
    if body is not None and is_there:
        state = np.array([[np.interp(t, course.way.t, component) for component in course.way.X.T]])
        if not np.isfinite(state).all():
            return drawn
        look: dict[str, Any] = {"facecolor": (*to_rgb(course.colour), 0.4), "edgecolor": course.colour, "zorder": 8}
        drawn += [ax.add_patch(Polygon(outline, **look)) for outline in body.outlines(state, plane)]
    return drawn
