"""Layouts as maps with the trajectories flown through them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from torchgco.errors import InputError
from torchgco.plotting.scene import Arrays, Scene, map_box, scene_of
from torchgco.plotting.style import INK, SMALL, TEXT, legend, panels, solver_colours, tidy

STONE, EDGE = "#CFC8BA", "#A39B8B"
# Greys, away from all solvers' colours.
HEIGHTS = LinearSegmentedColormap.from_list("heights", ["#E4DFD4", "#5E564A"])
SHEER = 0.6  # opacity of spheres in 3-D: a gap below others shows through
GHOSTS = 4  # later positions at which a moving obstacle is drawn
PANEL = 3.1  # width in inches
INFEASIBLE, SHORT = "infeasible", "feasible, short of the goal"


def layout_grid(layouts: Arrays, trajectories: Arrays, trials: pd.DataFrame, columns: int = 4, rows: int = 3) -> Figure:
    """Maps of the first columns x rows layouts with each solver's trajectories; in 3-D seen from above.

    layouts       arrays of a layout file: centers (L, M, d) and radii (L, M) in metres, and, where present,
                  velocities (L, M, d), boxes, start and goal ((n,) or (L, n)), vehicle_radius, goal_radius, dt,
                  layout (L,) ids
    trajectories  states X (L, N+1, n) by solver, positions first, nan where there is none
    trials        with columns layout, solver, feasible, reached

    Spheres are filled at their own radius and outlined at the inflated radius, as the vehicle is drawn as a point;
    boxes likewise. In 3-D the shade shows the height. Moving spheres fade along their motion. A trajectory that didn't
    reach the goal is dashed and ends in a cross if it isn't feasible, in a ring if it only stopped short.

    Raises InputError where the trajectories don't fit the layouts, or one has no row in `trials`.
    """
    flown = len(layouts["radii"])
    paths = {solver: np.asarray(states, dtype=float) for solver, states in trajectories.items()}
    for solver, states in paths.items():
        if states.ndim != 3 or len(states) != flown:
            raise InputError(f"trajectories.{solver}", f"shape ({flown}, N+1, n)", states.shape)
    scene = scene_of(layouts, max((states.shape[1] - 1 for states in paths.values()), default=0))
    count = min(flown, columns * rows)
    ends = _ends(scene.ids[:count], list(paths), trials)
    box = map_box(scene, [states[i, :, :2] for states in paths.values() for i in range(count)], count)
    aspect = float(np.clip((box[1, 1] - box[0, 1]) / (box[1, 0] - box[0, 0]), 0.25, 2.0))
    figure, axes = panels(count, columns, (PANEL, PANEL * aspect + 0.3), share=True)
    colours = solver_colours(paths)
    heights = _scale(scene, count)
    for i, ax in enumerate(axes):
        _boxes(ax, scene, i, heights)
        _obstacles(ax, scene, i, heights)
        _targets(ax, scene, i)
        for solver, states in paths.items():
            _path(ax, states[i, :, :2], scene.start[i], colours[solver], ends[solver, i])
        ax.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
        tidy(ax, f"layout {scene.ids[i]}", grid=None)
    figure.supxlabel("x [m]", fontsize=TEXT, color=INK)
    figure.supylabel("y [m]", fontsize=TEXT, color=INK)
    if heights is not None:
        shades = ScalarMappable(heights, HEIGHTS)
        bar = figure.colorbar(shades, ax=axes, alpha=SHEER, shrink=0.7, aspect=30, pad=0.01)
        bar.set_label("height of obstacles [m]", fontsize=TEXT, color=INK)
        bar.ax.tick_params(labelsize=SMALL)
    legend(figure, _handles(scene, colours, set(ends.values())))
    return figure


def _ends(ids: np.ndarray, solvers: list[str], trials: pd.DataFrame) -> dict[tuple[str, int], str]:
    """How each solver's trajectory on each shown layout ended: "" at the goal, else INFEASIBLE or SHORT."""
    table = trials.drop_duplicates(["solver", "layout"]).set_index(["solver", "layout"])
    verdicts = table[["feasible", "reached"]].astype("boolean").fillna(False)
    found = {}
    for solver in solvers:
        for i, layout in enumerate(ids):
            if (solver, layout) not in verdicts.index:
                raise InputError("trials", f"a row of {solver} for layout {layout}", "none")
            row = verdicts.loc[(solver, layout)]
            found[solver, i] = "" if row["reached"] else SHORT if row["feasible"] else INFEASIBLE
    return found


def _scale(scene: Scene, count: int) -> Normalize | None:
    """From heights to shades; None in the plane, and where all heights are the same."""
    heights = scene.shown_heights(count)
    return Normalize(heights.min(), heights.max()) if len(heights) and heights.min() < heights.max() else None


def _obstacles(ax: Axes, scene: Scene, i: int, scale: Normalize | None) -> None:
    index = np.flatnonzero(np.isfinite(scene.radii[i]))
    shades = [STONE] * len(index)
    if scale is not None and scene.heights is not None:
        # The highest is drawn last, over the others.
        index = index[np.argsort(scene.heights[i, index], kind="stable")]
        shades = list(HEIGHTS(scale(scene.heights[i, index])))
    centers, radii, drift = scene.centers[i, index], scene.radii[i, index], scene.drift[i, index]
    moving = np.flatnonzero(drift.any(axis=1))
    tints = [shades[j] for j in moving]
    for ghost in range(GHOSTS, 0, -1):
        share = ghost / GHOSTS
        places = centers[moving] + share * drift[moving]
        _discs(ax, places, radii[moving], facecolor=tints, alpha=0.6 - 0.45 * share)
    for j in moving:
        way = np.stack([centers[j], centers[j] + drift[j]], axis=1)
        ax.plot(*way, color=EDGE, linewidth=0.9, linestyle=":")
    opaque = 1.0 if scale is None else SHEER
    _discs(ax, centers, radii, facecolor=shades, alpha=opaque)
    _discs(ax, centers, radii + scene.margin, facecolor="none", edgecolor=EDGE, linewidth=0.5, alpha=opaque)


def _boxes(ax: Axes, scene: Scene, i: int, scale: Normalize | None) -> None:
    """Seen from above: filled as they are, outlined at the vehicle's radius from their sides."""
    opaque = 1.0 if scale is None else SHEER
    for box in sorted(scene.boxes[i], key=lambda box: np.nan_to_num(box.height)):
        shade = STONE if scale is None else HEIGHTS(scale(box.height))
        ax.add_patch(Polygon(box.corners, facecolor=shade, alpha=opaque))
        ax.add_patch(Polygon(box.grown(scene.margin), fill=False, edgecolor=EDGE, linewidth=0.5, alpha=opaque))


def _discs(ax: Axes, centers: np.ndarray, radii: np.ndarray, **look: Any) -> None:
    circles = [Circle((x, y), radius) for (x, y), radius in zip(centers, radii, strict=True)]
    ax.add_collection(PatchCollection(circles, **look))


def _targets(ax: Axes, scene: Scene, i: int) -> None:
    ax.plot(*scene.start[i], color=INK, marker="s", markersize=5, linestyle="none")
    ax.plot(*scene.goal[i], color=INK, marker="*", markersize=9, linestyle="none")
    if np.isfinite(scene.goal_radius):
        ax.add_patch(Circle(tuple(scene.goal[i]), scene.goal_radius, fill=False, color=INK, linestyle="--"))


def _path(ax: Axes, path: np.ndarray, start: np.ndarray, colour: str, end: str) -> None:
    ax.plot(*path.T, color=colour, linewidth=1.6, linestyle="--" if end else "-")
    if end:
        finite = path[np.isfinite(path).all(axis=1)]
        # A solver that returned nothing has its marker at the start.
        ax.plot(*(finite[-1] if len(finite) else start), color=colour, **_marker(end))


def _marker(end: str) -> dict[str, Any]:
    """The marker of a path that failed, the same on the map and in the legend."""
    shape = {"marker": "o", "markerfacecolor": "white"}
    if end == INFEASIBLE:
        shape = {"marker": "X", "markeredgecolor": "white"}
    return {"markersize": 7, "linestyle": "none", **shape}


def _handles(scene: Scene, colours: dict[str, str], ends: set[str]) -> list[Line2D]:
    handles = [Line2D([], [], color=colour, label=solver) for solver, colour in colours.items()]
    handles.append(Line2D([], [], color=INK, marker="s", markersize=5, linestyle="none", label="start"))
    disc = " and its radius" if np.isfinite(scene.goal_radius) else ""
    handles.append(Line2D([], [], color=INK, marker="*", markersize=9, linestyle="none", label=f"goal{disc}"))
    for end in (INFEASIBLE, SHORT):
        if end in ends:
            handles.append(Line2D([], [], color=INK, label=f"dashed: {end}", **_marker(end)))
    return handles
