"""Fleets: the scene with all vehicles, one colour each, and how far the nearest two are from each other over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from torchgco.base.errors import InputError
from torchgco.plotting.bodies import ABOVE, SIDE
from torchgco.plotting.problems import TALLEST_SCENE, WIDTH, Course, SceneMap
from torchgco.plotting.style import INK, PALETTE, SMALL, NotebookFigure, tidy
from torchgco.plotting.trajectory import LIMIT
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
    b = 0 if b is None else b
    if not isinstance(b, int) or isinstance(b, bool) or not 0 <= b < members[0].B:
        raise InputError("b", f"the place of a fleet, 0 to {members[0].B - 1}", b)
    t = float(members[0].dynamics.dt) * np.arange(members[0].N + 1)
    courses = []
    for v, (member, x, u) in enumerate(zip(members, X, U, strict=True)):
        path = x[b][:, member.position]
        courses.append(Course(b, x[b], u[b], t, (path,), _colour(v, len(members)), f"vehicle {v}", True, True))
    planes = (ABOVE, SIDE) if courses[0].paths[0].shape[1] == 3 else (ABOVE,)
    drawn = SceneMap.of(members[0], courses, planes)
    high = drawn.height(WIDTH)
    figure = NotebookFigure(figsize=(WIDTH, min(high, TALLEST_SCENE * len(planes)) + LOWER), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(high, LOWER))[:, 0]
    drawn.draw(upper)
    for ax, plane in zip(upper.axes, planes, strict=True):
        ax.set_title("")
        for member, course in zip(members, courses, strict=True):
            look: dict[str, Any] = {"linestyle": "none", "markeredgecolor": course.colour, "zorder": 6}
            ax.plot(*course.paths[0][:1, plane].T, marker="s", markersize=5, markerfacecolor="white", **look)
            if member.goal is not None:
                ends = member.goal.position[b].cpu().numpy()[list(plane)]
                ax.plot(*ends, marker="*", markersize=8, markerfacecolor=course.colour, **look)
    _distances(lower.subplots(), t, [course.paths[0] for course in courses], distances)
    return figure


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
