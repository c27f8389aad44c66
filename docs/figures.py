"""python docs/figures.py: the figures of docs/algorithm.md, from one solve of `gco` on a public layout.

The solver runs unchanged; arguments and results of the functions named in WATCHED are recorded and drawn.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from torchgco import compose
from torchgco.plotting.style import INK, PALETTE, save, tidy
from torchgco.scenarios import Layouts

ROOT = Path(__file__).resolve().parents[1]
FAMILY, LAYOUT = "planar_trap", 0
STONE, EDGE, PALE = "#CFC8BA", "#A39B8B", "#C8C8C8"
SIZE, DPI = (4.6, 3.7), 110

# All that these figures use of the package's internals: module:attributes of the function of each step.
WATCHED = {
    "caught": "torchgco.search.restarts:StopWhenCaught.update",  # (guidance, problem, X, ...) -> Advice
    "graph": "torchgco.roadmap.native:NativeSearch.graph",  # -> Graph
    "classes": "torchgco.roadmap.homotopy:_wind_alike",  # (paths, scene) -> which paths share a class
    "tracked": "torchgco.search.paths:PathProposals.track",  # -> Candidates
    "relaxed": "torchgco.search.paths:PathProposals.relax",  # -> Candidates, which of them are sound
    "refined": "torchgco.search.candidates:Candidates.refined",  # (self, inner, sound, ...) -> Candidates, _, best, _
}
Calls = dict[str, list[tuple[tuple[Any, ...], Any]]]


@contextmanager
def watching() -> Iterator[Calls]:
    """Arguments and results of the functions in WATCHED, call by call."""
    calls: Calls = {name: [] for name in WATCHED}
    originals = []
    for name, place in WATCHED.items():
        module, path = place.split(":")
        holder: Any = importlib.import_module(module)
        *holders, attribute = path.split(".")
        for part in holders:
            holder = getattr(holder, part)
        originals.append((holder, attribute, getattr(holder, attribute)))
        setattr(holder, attribute, _noting(originals[-1][2], calls[name]))
    try:
        yield calls
    finally:
        for holder, attribute, original in originals:
            setattr(holder, attribute, original)


def _noting(function: Any, notes: list[tuple[tuple[Any, ...], Any]]) -> Any:
    @wraps(function)
    def noting(*words: Any, **named: Any) -> Any:
        result = function(*words, **named)
        notes.append((words, result))
        return result

    return noting


def solve(layout: int) -> tuple[Calls, Layouts, np.ndarray]:
    """Solve one layout by `gco`: the recorded calls, the layout, and the positions (N+1, 2) of the result, m."""
    data = ROOT / "benchmarks" / "data" / f"{FAMILY}.npz"
    setup = compose(["scenario=layouts", f"scenario.path={data}", "model=planar", "device.threads=1"])
    layouts = setup.layouts().take([layout])
    task = setup.task(layouts)
    with watching() as calls:
        ids = torch.as_tensor(layouts.ids)
        solution = setup.solver.solve(task.problem, task.U0, seed=setup.seed, ids=ids)
    return calls, layouts, solution.X[0, :, :2].numpy()


def draw(calls: Calls, layouts: Layouts, final: np.ndarray) -> dict[str, Figure]:
    """A figure per step."""
    figures = {}
    caught = next(words[2] for words, advice in calls["caught"] if bool(advice.stop.any()))
    (paths, _), alike = calls["classes"][0]
    label = alike[0].to(torch.int8).argmax(-1).numpy()  # per path: the first path of its class
    classes = list(dict.fromkeys(label.tolist()))
    colour = {number: PALETTE[i % len(PALETTE)] for i, number in enumerate(classes)}

    figures["1-caught"], ax = _scene(layouts, "1  The first inner solves end caught")
    ax.plot(*_xy(caught[0]), color=PALETTE[1])

    figures["2-paths"], ax = _scene(layouts, f"2  Roadmap, {paths.shape[1]} paths, {len(classes)} homotopy classes")
    _, graph = calls["graph"][0]
    ax.add_collection(LineCollection(_edges(graph), colors=PALE, linewidths=0.3))
    for path, number in reversed(list(zip(paths[0], label, strict=True))):
        ax.plot(*path.T.numpy(), color=colour[number], linewidth=1.6)

    tracked = calls["tracked"][0][1]
    live = tracked.live.nonzero().flatten().tolist()
    figures["3-tracked"], ax = _scene(layouts, f"3  {len(live)} candidates track the first path of each class")
    for row in live:
        ax.plot(*_xy(tracked.X[row]), color=colour[label[row // (tracked.count // len(label))]], linewidth=0.6)

    relaxed, sound = calls["relaxed"][0][1]
    figures["4-relaxed"], ax = _scene(layouts, f"4  Relaxed: {int(sound.sum())} are sound, darker is cheaper")
    for row in (relaxed.live & ~sound).nonzero().flatten().tolist():
        ax.plot(*_xy(relaxed.X[row]), color=PALE, linewidth=0.6)
    _shaded(ax, relaxed, sound.nonzero().flatten().tolist(), 0.8)

    (before, _, kept, _), (refined, _, best, _) = calls["refined"][0]
    rows = [row for row in kept.nonzero().flatten().tolist() if not torch.equal(before.U[row], refined.U[row])]
    figures["5-refined"], ax = _scene(layouts, f"5  Refined: {len(rows)} end feasible, darker is cheaper")
    _shaded(ax, refined, rows, 1.2)

    figures["6-final"], ax = _scene(layouts, "6  Result, over the proposal")
    ax.plot(*_xy(refined.X[int(best[0])]), color=PALE, linewidth=3)
    ax.plot(*final.T, color=PALETTE[0])
    return figures


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


def _shaded(ax: Axes, candidates: Any, rows: Sequence[int], width: float) -> None:
    """Draw trajectories in shades by the rank of their cost, the cheapest last."""
    problem = candidates.of(torch.tensor(rows))
    X, U = candidates.X[list(rows)], candidates.U[list(rows)]
    for rank, i in enumerate(problem.cost.total(X, U).argsort(descending=True).tolist()):
        shade = colormaps["viridis_r"]((rank + 1) / len(rows))
        ax.plot(*_xy(X[i]), color=shade, linewidth=width)


def _xy(X: torch.Tensor) -> np.ndarray:
    return X[:, :2].T.numpy()


def _edges(graph: Any) -> list[np.ndarray]:
    """Segments of the graph's edges."""
    points, free = graph.points[0].numpy(), torch.isfinite(graph.lengths[0]).nonzero().tolist()
    return [points[[a, int(graph.ends[0, a, k])]] for a, k in free]


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python docs/figures.py", description="Draw the figures of algorithm.md.")
    parser.add_argument("--layout", type=int, default=LAYOUT, help=f"of the 32 of {FAMILY}")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "figures")
    asked = parser.parse_args(words)
    for name, figure in draw(*solve(asked.layout)).items():
        save(figure, asked.output / f"{name}.png", DPI)
    return 0


if __name__ == "__main__":
    sys.exit(main())
