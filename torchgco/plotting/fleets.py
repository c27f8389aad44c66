"""Fleets: the scene with all vehicles, one colour each, and how far the nearest two are from each other over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from torchgco.base.errors import InputError
from torchgco.plotting.animated import Film, film_of
from torchgco.plotting.animation import PALE, frames_of, write_gif
from torchgco.plotting.bodies import ABOVE, SIDE
from torchgco.plotting.problems import TALLEST_SCENE, WIDTH, Course, Leg, SceneMap
from torchgco.plotting.style import INK, PALETTE, SMALL, NotebookFigure, tidy
from torchgco.plotting.trajectory import LIMIT
from torchgco.plotting.ways import ways_along
from torchgco.problem.problem import Problem

LOWER = 1.6  # inches, the height of the distances over time


def fleet_figure(
    members: Sequence[Problem], X: Sequence[np.ndarray], U: Sequence[np.ndarray], distances: np.ndarray, b: Any
) -> Figure:
    """The figure of `torchgco.plot` for fleet b.

    Args:
        members: a problem per vehicle, of B fleets.
        X, U: (B, N+1, n) and (B, N, m) of each.
        distances: (V, V), m, that pairs keep; 0 of those that keep none.
    """
    drawn = _scene(members, X, U, _place(members, b))
    courses, planes, high = drawn.courses, drawn.planes, drawn.height(WIDTH)
    figure = NotebookFigure(figsize=(WIDTH, min(high, TALLEST_SCENE * len(planes)) + LOWER), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(high, LOWER))[:, 0]
    drawn.draw(upper)
    _ends(upper.axes, members, drawn)
    _distances(
        lower.subplots(), courses[0].t, [course.way.paths[0][:: course.way.pieces] for course in courses], distances
    )
    return figure


def fleet_film(
    members: Sequence[Problem], X: Sequence[np.ndarray], U: Sequence[np.ndarray], distances: np.ndarray, b: Any
) -> Film:
    """The film of `torchgco.animate` for fleet b, of discs half as wide as what the vehicles keep."""
    drawn = _scene(members, X, U, _place(members, b))
    film = film_of([Leg(members[0], drawn.courses, "s")], b, (0.5 * distances.max(axis=1)).tolist())
    _ends(film.figure.axes, members, drawn)
    return film


def _place(members: Sequence[Problem], b: Any) -> int:
    b = 0 if b is None else b
    if not isinstance(b, int) or isinstance(b, bool) or not 0 <= b < members[0].B:
        raise InputError("b", f"the place of a fleet, 0 to {members[0].B - 1}", b)
    return b


def fleet_animation(
    members: Sequence[Problem], X: Sequence[np.ndarray], U: Sequence[np.ndarray], distances: np.ndarray, path: Path
) -> Path:
    """Write a GIF of the first fleet, 5 pictures per second, in real time where 100 suffice: discs half as wide as what
    the vehicles keep, with their ways so far, and where all of these lead."""
    drawn = _scene(members, X, U, 0)
    t, radii = drawn.courses[0].t, 0.5 * distances.max(axis=1)
    pale = replace(drawn, courses=[replace(course, colour=PALE) for course in drawn.courses])
    figure = Figure(figsize=(WIDTH, drawn.height(WIDTH) + 0.4), layout="constrained")
    pale.draw(figure)
    _ends(figure.axes, members, drawn)

    def show(k: int) -> str:
        for ax, plane in zip(figure.axes, drawn.planes, strict=True):
            for course, radius in zip(drawn.courses, radii, strict=True):
                way = course.way.paths[0][: k * course.way.pieces + 1, plane]
                ax.plot(*way.T, color=course.colour, linewidth=1.2, zorder=7)
                x, y = way[-1].tolist()
                ax.add_patch(Circle((x, y), radius, facecolor=course.colour, edgecolor="white", zorder=8))
        return f"{t[k]:.1f} s"

    return write_gif(
        figure.axes, show, frames_of(len(t), float(t[1])), path, [course.colour for course in drawn.courses]
    )


def _scene(members: Sequence[Problem], X: Sequence[np.ndarray], U: Sequence[np.ndarray], b: int) -> SceneMap:
    """The obstacles of the first vehicle, and all ways."""
    t = float(members[0].dynamics.dt) * np.arange(members[0].N + 1)
    courses = []
    for v, (member, x, u) in enumerate(zip(members, X, U, strict=True)):
        place, colour, label = member.position, _colour(v, len(members)), f"vehicle {v}"
        columns, like = list(range(place.start, place.stop)), member.x0
        X_b, U_b = (torch.as_tensor(array[b : b + 1]).to(like) for array in (x, u))
        (way,) = ways_along(member.take(torch.tensor([b], device=like.device)), X_b, U_b, None, [columns])
        courses.append(Course(b, x[b], u[b], t, colour, label, True, True, way.until(t)))
    planes = (ABOVE, SIDE) if courses[0].way.paths[0].shape[1] == 3 else (ABOVE,)
    return SceneMap.of(members[0], courses, planes)


def _ends(axes: Sequence[Axes], members: Sequence[Problem], drawn: SceneMap) -> None:
    """Starts as squares and goals as stars, in the colours of the vehicles."""
    for ax, plane in zip(axes, drawn.planes, strict=True):
        ax.set_title("")
        for member, course in zip(members, drawn.courses, strict=True):
            look: dict[str, Any] = {"linestyle": "none", "markeredgecolor": course.colour, "zorder": 6}
            ax.plot(*course.way.paths[0][:1, plane].T, marker="s", markersize=5, markerfacecolor="white", **look)
            if member.goal is not None:
                ends = member.goal.position[course.b].cpu().numpy()[list(plane)]
                ax.plot(*ends, marker="*", markersize=8, markerfacecolor=course.colour, **look)
                near: dict[str, Any] = {"fill": False, "edgecolor": course.colour, "linestyle": "--", "linewidth": 0.8}
                ax.add_patch(Circle((ends[0], ends[1]), float(member.goal.radius[course.b]), **near))


def _colour(v: int, count: int) -> str:
    """A colour of its own for each vehicle."""
    return PALETTE[v] if count <= len(PALETTE) else to_hex(matplotlib.colormaps["turbo"]((v + 0.5) / count))


def _distances(ax: Any, t: np.ndarray, paths: Sequence[np.ndarray], distances: np.ndarray) -> None:
    """At each knot the smallest distance of each vehicle from those that it keeps one from, and what they keep."""
    for v, path in enumerate(paths):
        gaps = [np.linalg.norm(path - paths[w], axis=1) for w in range(len(paths)) if distances[v, w] > 0]
        if gaps:
            ax.plot(t, np.min(gaps, axis=0), color=_colour(v, len(paths)), linewidth=1.0)
    for keep in np.unique(distances[distances > 0]):
        ax.axhline(keep, color=LIMIT, linestyle="--", linewidth=0.9)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("t [s]", fontsize=SMALL)
    tidy(ax, "distance from the nearest other vehicle [m]")
    ax.title.set_color(INK)
