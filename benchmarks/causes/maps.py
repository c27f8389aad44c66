"""python -m benchmarks.causes.maps "WORLD:NUMBER:CELLS" ...: worlds of benchmarks.families.maps, as cells and shapes.

Each picture shows a world from above: its cells, in space those at the start's height, its shapes, and the flights that
were planned among both, or among the shapes alone where the cells close every way. With --write they go into
results/maps.png, three in a row, with costs and processor times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

import torchgco
from benchmarks.families.maps import SCALES, Flown, as_map, closed, flown
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import EVERY
from benchmarks.lib.rasters import rasterised
from torchgco import Problem
from torchgco.kernels import open_loop
from torchgco.maps import DistanceField
from torchgco.plotting import trajectory as draw
from torchgco.plotting.bodies import bodies
from torchgco.plotting.style import INK, PALETTE, tidy
from torchgco.scenarios import Task

COLUMNS = 3


def panel(ax: Axes, world: str, number: int, size: float, seed: int) -> None:
    """Draw world `number` of a kind with cells of `size`, m."""
    setup = torchgco.compose([*EVERY[world].generated, f"seed={seed}", "device.threads=1"])
    task = setup.task(setup.scenario.draw([number], seed))
    grid = rasterised(task.layouts, 0, SCALES.get(world, 1.0) * size, True)
    problem = as_map(task.problem, DistanceField.of(grid))
    shapes = _second(task.problem, task)
    ends = f"shapes {float(shapes.verdict.cost):.0f} ({shapes.seconds:.2f} s)"
    _flight(ax, task.problem, shapes.U, PALETTE[1])
    if closed(problem):
        ends += ", closed as cells"
    else:
        cells = _second(problem, task)
        _flight(ax, problem, cells.U, PALETTE[0])
        ends += f", cells {float(cells.verdict.cost):.0f} ({cells.seconds:.2f} s)"
        ends += "" if bool(cells.verdict.reached) else ", not reached"
    start = task.problem.x0[0, task.problem.position].numpy()
    _cells(ax, grid, start)
    height = None if len(start) == 2 else float(start[2])
    found = bodies(task.layouts.arrays(), 0)
    rims = [body.outline(plane=draw.ABOVE) if height is None else body.section(draw.ABOVE, height) for body in found]
    outlines = [rim for rim in rims if rim is not None]
    ax.add_collection(PolyCollection(outlines, facecolors="none", edgecolors=INK, linewidths=0.4))
    ends_at = np.stack([start[:2], task.goal[0].numpy()[:2]])
    beside = 0.5 * np.linalg.norm(ends_at[1] - ends_at[0])
    ax.set_xlim(ends_at[:, 0].min() - 0.3 * beside, ends_at[:, 0].max() + 0.3 * beside)
    ax.set_ylim(ends_at[:, 1].min() - beside, ends_at[:, 1].max() + beside)
    ax.set_aspect("equal")
    tidy(ax, f"{world} {number}, {SCALES.get(world, 1.0) * size:g} m\n{ends}", grid=None)


def _second(problem: Problem, task: Task) -> Flown:
    """A flight, and its time without compiling and tracing, which the first one has."""
    flown(problem, task)
    return flown(problem, task)


def _flight(ax: Axes, problem: Any, U: torch.Tensor, color: Any) -> None:
    ax.plot(*open_loop(problem, U)[0, :, problem.position].numpy().T[:2], color=color, lw=1.2)


def _cells(ax: Axes, grid: Any, start: np.ndarray) -> None:
    """The occupied cells, in space those at the height of a point."""
    occupied, origin = np.asarray(grid.is_occupied), np.ravel(grid.origin)
    occupied = occupied.reshape(occupied.shape[-len(start) :])
    if len(start) == 3:
        occupied = occupied[:, :, int((start[2] - origin[2]) / grid.resolution)]
    span = origin[:2] + grid.resolution * np.array(occupied.shape)
    extent = (origin[0], span[0], origin[1], span[1])
    ax.imshow(occupied.T, origin="lower", extent=extent, cmap="Greys", alpha=0.5, interpolation="nearest")


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/maps.png")
    parser.add_argument("worlds", nargs="+", metavar="WORLD:NUMBER:CELLS")
    parser.add_argument("--seed", type=int, default=33)
    parser.add_argument("--path", type=Path, help="another file for the pictures")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    columns = min(COLUMNS, len(asked.worlds))
    rows = math.ceil(len(asked.worlds) / columns)
    figure = Figure(figsize=(6.0 * columns, 5.0 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flat
    for ax in axes[len(asked.worlds) :]:
        ax.set_axis_off()
    for ax, named in zip(axes, asked.worlds, strict=False):
        world, number, size = named.split(":")
        panel(ax, world, int(number), float(size), asked.seed)
    if asked.write or asked.path:
        figure.savefig(asked.path or RESULTS / "maps.png", dpi=80)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
