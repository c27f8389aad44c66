"""python -m benchmarks.families.maps: drawn worlds as maps of cells, against the same worlds as shapes.

Woods, mazes, walls of spheres and discs in the plane are drawn under a seed of this benchmark and flown by `gco`, world
by world, as spheres, capsules and boxes, and as occupancy grids of two resolutions. A cell is occupied where a shape
reaches into it, or with --centres where its centre lies in one; the outermost cells always are. Every flight is judged
in the world that it was planned in; how many of the maps' flights clear the shapes themselves is said too. Times are
processor time of one thread, without compiling and making grid and field. With --write the table goes into
benchmarks/results/maps.md.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch

import torchgco
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import EVERY
from benchmarks.lib.page import chosen, filed, markdown, measured, put, share, shown
from benchmarks.lib.rasters import rasterised
from torchgco import Field, Problem, Roadmap
from torchgco.maps import DistanceField
from torchgco.obstacles.base import Obstacles
from torchgco.roadmap.geometry import scene_of
from torchgco.scenarios import Task

SCALES = {"planar_random": 0.1}  # a world of 2 m with discs of 8 cm has cells a tenth as large
KINDS = ("woods20", "woods40", "mazes3", "walls", "planar_random")
HEAD = (
    "world", "cells, m", "n", "reached as shapes", "reached as cells", "of these, clear of the shapes",
    "closed as cells", "cost / as shapes, median", "time / as shapes, median", "s, median", "field, s",
)  # fmt: skip


@dataclass(frozen=True)
class Flown:
    """A solution of one problem, its verdict, and the processor time that it took, s."""

    U: torch.Tensor
    verdict: Any
    seconds: float


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/maps.md")
    parser.add_argument("--worlds", nargs="+", default=list(KINDS), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--cells", nargs="+", type=float, default=[0.1, 0.2], help="m")
    parser.add_argument("--count", type=int, default=64, help="worlds of each kind")
    parser.add_argument("--seed", type=int, default=33)
    parser.add_argument("--centres", action="store_true", help="mark cells by their centres, not where shapes reach in")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    rows = []
    for name in asked.worlds:
        flights = pd.DataFrame(flown_worlds(name, asked.cells, asked.count, asked.seed, not asked.centres))
        rows += [row_of(name, cells, held) for cells, held in flights.groupby("cells", sort=False)]
        print(markdown(HEAD, rows[-len(asked.cells) :]), flush=True)
    if asked.write:
        how = f"{asked.count} worlds of each kind, seed {asked.seed}"
        put(RESULTS / "maps.md", "maps", f"{measured(how)}\n\n{short(markdown(HEAD, rows))}")
    return 0


def short(table: str) -> str:
    """The table as a file, and these columns of it."""
    return filed("maps-cells", table, chosen(table, (*HEAD[:2], HEAD[4], *HEAD[7:9])))


def flown_worlds(name: str, sizes: Sequence[float], count: int, seed: int, touching: bool) -> Iterator[dict[str, Any]]:
    """The flights of `count` worlds of a kind, as shapes and as cells of some sizes."""
    setup = torchgco.compose([*EVERY[name].generated, f"seed={seed}", "device.threads=1"])
    for number in range(count):
        task = setup.task(setup.scenario.draw([number], seed))
        if number == 0:
            torchgco.presets.gco(task.problem).solve(task.problem, task.U0)  # compiles
        shapes = flown(task.problem, task)
        for size in sizes:
            cells = SCALES.get(name, 1.0) * size
            begun = time.process_time()
            field = DistanceField.of(rasterised(task.layouts, 0, cells, touching))
            made = time.process_time() - begun
            problem = as_map(task.problem, field)
            if number == 0:
                torchgco.presets.gco(problem).solve(problem, task.U0)
            found = flown(problem, task)
            yield {
                "cells": cells, "shapes": bool(shapes.verdict.reached), "reached": bool(found.verdict.reached),
                "clear": bool(torchgco.judge(task.problem, found.U).clearance >= 0), "closed": closed(problem),
                "cost": float(found.verdict.cost / shapes.verdict.cost), "time": found.seconds / shapes.seconds,
                "seconds": found.seconds, "made": made,
            }  # fmt: skip
            print(f"{name} {number} {cells:g}: {found.seconds:.2f} s, shapes {shapes.seconds:.2f} s", file=sys.stderr)


def flown(problem: Problem, task: Task) -> Flown:
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solution = torchgco.presets.gco(problem).solve(problem, task.U0)
    return Flown(solution.U, torchgco.judge(problem, solution.U), time.process_time() - begun)


def as_map(problem: Problem, field: DistanceField) -> Problem:
    """The same problem with a field in place of all its obstacles."""
    radius = float(problem.obstacles[0].vehicle_radius[0])
    others = [part for part in problem.constraints if not isinstance(part, Obstacles)]
    return Problem(problem.dynamics, problem.cost, [Field(field, radius), *others], problem.x0, problem.N, problem.goal)


def closed(problem: Problem) -> bool:
    """Whether no path leads through the map: cells have closed the gaps of the shapes."""
    rest = problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m))
    scene = scene_of(problem, rest)
    assert scene is not None
    return not bool(Roadmap().paths(scene)[1])


def row_of(name: str, cells: float, flights: pd.DataFrame) -> list[Any]:
    n, both = len(flights), flights[flights["shapes"] & flights["reached"]]
    reached = flights[flights["reached"]]
    return [
        name, f"{cells:g}", n, share(flights["shapes"].sum(), n), share(flights["reached"].sum(), n),
        share(reached["clear"].sum(), len(reached)), int(flights["closed"].sum()),
        shown(_median(both["cost"]), ".3f"), shown(_median(flights["time"]), ".2g"),
        shown(_median(flights["seconds"]), ".2g"), shown(_median(flights["made"]), ".2g"),
    ]  # fmt: skip


def _median(values: pd.Series) -> float:
    return float(np.median(values)) if len(values) else float("nan")


if __name__ == "__main__":
    sys.exit(main())
