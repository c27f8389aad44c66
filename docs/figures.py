"""python docs/figures.py: the figures and tables of docs/algorithm.md.

The figures show the record of one solve of `gco` on a public layout; the tables list the passes of the preset.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from torch import Tensor

from benchmarks.lib.recorded import solve
from torchgco import Problem, Solution, presets
from torchgco.plotting.style import INK, PALETTE, save, tidy
from torchgco.roadmap.cheapest import GraphSearch, library_for
from torchgco.roadmap.geometry import scene_of
from torchgco.roadmap.roadmap import HALTON_NEIGHBOURS, MARGIN, NEIGHBOURS, NODES, Roadmap, halton
from torchgco.scenarios import Layouts
from torchgco.solution import Fate

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "algorithm.md"
LAYOUT = 0
STONE, EDGE, PALE = "#CFC8BA", "#A39B8B", "#C8C8C8"
SIZE, DPI = (4.6, 3.7), 110


def draw(problem: Problem, solution: Solution, layouts: Layouts) -> dict[str, Figure]:
    """A figure per step."""
    assert solution.search is not None and solution.search.caught is not None
    figures, first = {}, solution.search.comparisons[0]
    label = first.classes[0].tolist()
    classes = list(dict.fromkeys(label))
    colour = {number: PALETTE[i % len(PALETTE)] for i, number in enumerate(classes)}
    fate, cost = first.fate[0], first.cost[0]

    figures["1-caught"], ax = _scene(layouts, "1  The first inner solves end caught")
    ax.plot(*_xy(solution.search.caught[1][0]), color=PALETTE[1])

    figures["2-paths"], ax = _scene(layouts, f"2  Roadmap, {len(label)} paths, {len(classes)} homotopy classes")
    ax.add_collection(LineCollection(_edges(problem), colors=PALE, linewidths=0.3))
    for path, number in reversed(list(zip(first.paths[0], label, strict=True))):
        ax.plot(*path.T.numpy(), color=colour[number], linewidth=1.6)

    live = (fate != Fate.ABSENT).nonzero().flatten().tolist()
    figures["3-tracked"], ax = _scene(layouts, f"3  {len(live)} candidates track the first path of each class")
    for row in live:
        ax.plot(*_xy(first.tracked[0, row]), color=colour[label[int(first.path[0, row])]], linewidth=0.6)

    sound = (fate >= Fate.RELAXED).nonzero().flatten().tolist()
    figures["4-relaxed"], ax = _scene(layouts, f"4  Relaxed: {len(sound)} are sound, darker reached the next step")
    for row in (fate == Fate.UNSOUND).nonzero().flatten().tolist():
        ax.plot(*_xy(first.relaxed[0, row]), color=PALE, linewidth=0.6)
    for row in sound:
        kept = int(fate[row]) > Fate.RELAXED
        ax.plot(*_xy(first.relaxed[0, row]), color=colormaps["viridis_r"](0.9 if kept else 0.3), linewidth=0.8)

    good = [row for row in cost.isfinite().nonzero().flatten().tolist() if row in sound]
    figures["5-refined"], ax = _scene(layouts, f"5  Refined: {len(good)} end feasible, darker is cheaper")
    for rank, row in enumerate(sorted(good, key=lambda row: -float(cost[row])), start=1):
        ax.plot(*_xy(first.refined[0, row]), color=colormaps["viridis_r"](rank / len(good)), linewidth=1.2)

    figures["6-final"], ax = _scene(layouts, "6  Result, over the proposal")
    proposal = int((fate == Fate.PROPOSED).nonzero().flatten()[0])
    ax.plot(*_xy(first.refined[0, proposal]), color=PALE, linewidth=3)
    ax.plot(*_xy(solution.X[0]), color=PALETTE[0])
    return figures


def tables() -> str:
    """The passes of `gco` as Markdown; values that differ: in the plane / in space."""
    plane, space = (presets.gco(dimension).table().reset_index().iloc[:, :4] for dimension in (2, 3))
    lines = [space.columns.tolist(), ["---"] * len(space.columns)]
    for a, b in zip(plane.values.tolist(), space.values.tolist(), strict=True):
        lines.append([x if x == y or y == "" else f"{x} / {y}" if x else y for x, y in zip(a, b, strict=True)])
    return "\n".join(f"|{'|'.join(map(str, line))}|" for line in lines)


def with_tables(text: str) -> str:
    """The page with the tables between its marks."""
    return re.sub(r"(?s)(<!-- passes -->\n).*(\n<!-- end -->)", lambda m: f"{m[1]}\n{tables()}\n{m[2]}", text)


def _scene(layouts: Layouts, title: str) -> tuple[Figure, Axes]:
    """Obstacles, filled at their own radius and outlined at the inflated radius; start and goal."""
    figure = Figure(figsize=SIZE, layout="constrained")
    ax = figure.subplots()
    centers, radii = layouts.centers[0], layouts.radii[0]
    assert layouts.start is not None and layouts.goal is not None
    assert layouts.vehicle_radius is not None and layouts.goal_radius is not None
    looks: list[tuple[float, dict[str, Any]]] = [
        (0.0, {"facecolor": STONE}),
        (layouts.vehicle_radius, {"facecolor": "none", "edgecolor": EDGE}),
    ]
    for extra, look in looks:
        circles = [Circle(tuple(at), r + extra) for at, r in zip(centers, radii, strict=True)]
        ax.add_collection(PatchCollection(circles, **look))
    start, goal = (np.broadcast_to(x, (1, x.shape[-1]))[0, :2] for x in (layouts.start, layouts.goal))
    ax.plot(*start, color=INK, marker="s", markersize=5)
    ax.plot(*goal, color=INK, marker="*", markersize=9)
    ax.add_patch(Circle(tuple(goal), layouts.goal_radius, fill=False, color=INK, linestyle="--"))
    ax.set(xlim=(-1.25, 1.4), ylim=(-0.85, 1.05), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    tidy(ax, title, grid=None)
    return figure, ax


def _xy(X: Tensor) -> np.ndarray:
    return X[:, :2].T.numpy()


def _edges(problem: Problem) -> list[np.ndarray]:
    """Segments of the edges of the roadmap."""
    scene = scene_of(problem.in_cost_units(), problem.at_rest[1])
    roadmap: Roadmap = presets.gco(problem).passes.paths.roadmap
    library = library_for(2)
    assert scene is not None and library is not None
    search = GraphSearch(library, scene.obstacles.reduced(roadmap.max_overlap), MARGIN)
    cube = halton(roadmap.num_halton, 2).to(scene.start)
    graph: Any = search.graph(scene.start, scene.goal, cube, NODES, NEIGHBOURS, HALTON_NEIGHBOURS)
    points, free = graph.points[0].numpy(), torch.isfinite(graph.lengths[0]).nonzero().tolist()
    return [points[[a, int(graph.ends[0, a, k])]] for a, k in free]


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python docs/figures.py", description="Draw the figures of algorithm.md.")
    parser.add_argument("--layout", type=int, default=LAYOUT, help="of the 32 of planar_trap")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "figures")
    asked = parser.parse_args(words)
    for name, figure in draw(*solve(asked.layout)).items():
        save(figure, asked.output / f"{name}.png", DPI)
    PAGE.write_text(with_tables(PAGE.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
