"""python -m benchmarks.families.floors: drawn floor plans and real maps, `gco` against a grid path that is pursued.

Floor plans and tracks of `scenario=floors` are drawn under two seeds: one on which settings were chosen, and one on
which nothing was. Each is solved alone, by one solver after the other, in one thread. `path_pursuit` is what anyone
would try first (`torchgco/baselines/pursuit.py`): a planner that costs more isn't worth having. With `--maps DIR` the
real maps that lie there are flown, too, between starts and goals as an owner would set them. With --write the tables go
into benchmarks/results/floors.md, with --picture a figure of the first plans into a file.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch

import torchgco
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.page import crossed, filed, markdown, measured, put, share, shown
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.style import save
from torchgco.plotting.ways import ways_along
from torchgco.scenarios import MapFile, Task
from torchgco.solvers.contracts import Solver

PEER = "path_pursuit"
DEARER = 1.05  # of the peer's cost: what counts as dearer
SOLVERS = ("gco", PEER)
HEAD = (
    "plans", "solver", "n", "reached", f"cost / `{PEER}`, median where both reached [95 %]",
    f"over {DEARER:g}", f"time / `{PEER}`, median [95 %]", "s, median", "s, all", "not reached",
)  # fmt: skip
MAP_HEAD = (
    "map",
    "vehicle's radius, m",
    "stages",
    "solver",
    "status",
    "reached",
    "cost",
    "from the goal, m",
    "s",
)


@dataclass(frozen=True)
class Owned:
    """A real map with a start and a goal as its owner would set them, m."""

    file: str
    start: tuple[float, float]
    goal: tuple[float, float]
    radius: float
    source: str
    resolution: float | None = None
    outside: Literal["free", "occupied"] | None = None


NAVIGATION = "ros-navigation/navigation2 a3a9704, Apache-2.0"
MAPS = (
    Owned("berlin.yaml", (8.168, -7.246), (-3.282, -8.946), 0.25, "f1tenth/f1tenth_gym 4fdb9c7, MIT"),
    Owned("turtlebot3.yaml", (-2.0, -0.5), (2.0, 0.5), 0.17, "ROBOTIS-GIT/turtlebot3 da785b7, Apache-2.0"),
    Owned("depot.yaml", (25.275, 3.475), (3.425, 9.725), 0.25, NAVIGATION),
    Owned("100by100_20.yaml", (84.425, 91.375), (17.975, 22.425), 0.3, NAVIGATION),
    Owned("kr_maze1.png", (16.85, 4.65), (1.35, 1.85), 0.25, "KumarRobotics/kr_param_map 2594f9c, BSD-3-Clause", 0.1),
)  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/floors.md")
    parser.add_argument("--layouts", type=int, default=48, help="under each seed")
    parser.add_argument("--seeds", nargs=2, type=int, default=[61, 62], help="chosen on, reported on")
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), metavar="NAME", help="presets")
    parser.add_argument(
        "--maps", type=Path, metavar="DIR", help="a folder with real maps; those that are missing are left out"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="a figure of the first plans of the second seed")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    solvers = list(dict.fromkeys([*asked.solvers, PEER]))
    rows = []
    for seed, what in zip(asked.seeds, ("chosen on", "reported on"), strict=True):
        flights = pd.DataFrame(flown_plans(seed, asked.layouts, solvers))
        rows += [row_of(f"seed {seed}, {what}", flights, name) for name in solvers]
        print(markdown(HEAD, rows[-len(solvers) :]), flush=True)
    if asked.write:
        how = f"{asked.layouts} plans of each seed, each solved alone"
        put(RESULTS / "floors.md", "plans", f"{measured(how)}\n\n{markdown(HEAD, rows)}")
    if asked.maps is not None:
        flown = [row for one in MAPS if (asked.maps / one.file).is_file() for row in map_rows(asked.maps, one, solvers)]
        print(markdown(MAP_HEAD, flown), flush=True)
        if asked.write:
            how = "each solved alone"
            put(RESULTS / "floors.md", "maps", f"{measured(how)}\n\n{short(markdown(MAP_HEAD, flown))}\n\n{sources()}")
    if asked.picture is not None:
        draw(asked.picture, asked.seeds[1], solvers)
    return 0


def flown_plans(seed: int, count: int, solvers: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The flights of the first plans of a seed."""
    setup = torchgco.compose(["scenario=floors", f"seed={seed}", "device.threads=1"])
    for number in range(count):
        task = setup.task(setup.scenario.draw([number], seed))
        compiled(task, solvers)
        yield from ({"plan": number} | flown(name, task) for name in solvers)
        print(f"seed {seed}: {number + 1} of {count}", file=sys.stderr)


def compiled(task: Task, solvers: Sequence[str]) -> None:
    """Solve once by each solver, as a solve that needs a kernel for the first time compiles it."""
    for name in solvers:
        flown(name, task)


def flown(name: str, task: Task) -> dict[str, Any]:
    """A problem solved alone, its verdict, and the processor time that it took."""
    solver: Solver = torchgco.presets.PRESETS[name](task.problem)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        begun = time.process_time()
        solution = solver.solve(task.problem, task.U0)
        seconds = time.process_time() - begun
    verdict = torchgco.judge(task.problem, solution.U)
    return {
        "solver": name, "status": solution.statuses[0].name, "seconds": seconds, "stages": task.problem.N,
        "cost": float(verdict.cost), "reached": bool(verdict.reached),
        "distance": float(verdict.goal_distance), "way": ways_along(task.problem, solution.X, solution.U, None, [])[0],
    }  # fmt: skip


def row_of(plans: str, flights: pd.DataFrame, name: str) -> list[Any]:
    own, peer = (flights[flights["solver"] == one].set_index("plan") for one in (name, PEER))
    n, both = len(own), own["reached"] & peer["reached"]
    cost = (own["cost"] / peer["cost"])[both]
    times, failed = own["seconds"] / peer["seconds"], own.index[~own["reached"]].tolist()
    dearer = f"{int((cost > DEARER).sum())} of {len(cost)}"
    same = name == PEER
    return [
        plans, f"`{name}`", n, share(own["reached"].sum(), n),
        "1" if same else median(cost, ".3f"), "-" if same else dearer, "1" if same else median(times, ".2g"),
        shown(float(own["seconds"].median()), ".2g"), shown(float(own["seconds"].sum()), ".3g"),
        ", ".join(map(str, failed)) or "-",
    ]  # fmt: skip


def median(values: pd.Series, form: str) -> str:
    """The median with its 95 % interval, by order statistics: no form of the distribution is assumed."""
    from scipy.stats import binom

    held = np.sort(values.to_numpy(float))
    n = len(held)
    if n == 0:
        return "-"
    low = int(binom.ppf(0.025, n, 0.5))
    ends = held[max(0, low - 1)], held[min(n - 1, n - low)]
    return f"{np.median(held):{form}} [{ends[0]:{form}}, {ends[1]:{form}}]"


def short(table: str) -> str:
    """The table as a file, and its costs."""
    return filed("floors-maps", table, crossed(table, "map", "solver", "cost"))


def map_rows(folder: Path, owned: Owned, solvers: Sequence[str]) -> list[list[Any]]:
    """The flights on a real map, with stages by the way."""
    named: dict[str, Any] = {"resolution": owned.resolution, "outside": owned.outside}
    options = {name: value for name, value in named.items() if value is not None}
    ends: dict[str, Any] = {"start": owned.start, "goal": owned.goal}
    layouts = MapFile(folder / owned.file, vehicle_radius=owned.radius, **ends, **options).draw([0], 0)
    task = torchgco.compose(["scenario=floors", "device.threads=1"]).vehicle.task(layouts)
    compiled(task, solvers)
    rows = []
    for name in solvers:
        held = flown(name, task)
        rows.append([
            Path(owned.file).stem, owned.radius, held["stages"], f"`{name}`", held["status"], _yes(held["reached"]),
            f"{held['cost']:.0f}", f"{held['distance']:.2f}", f"{held['seconds']:.2g}",
        ])  # fmt: skip
    return rows


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def sources() -> str:
    """Where the maps come from."""
    return "Maps: " + "; ".join(f"{Path(one.file).stem} of {one.source}" for one in MAPS) + "."


def draw(file: Path, seed: int, solvers: Sequence[str], count: int = 8) -> None:
    """A figure of the first plans and what the solvers drive through them."""
    setup = torchgco.compose(["scenario=floors", f"seed={seed}", "device.threads=1"])
    layouts = setup.vehicle.at_rest(setup.scenario.draw(range(count), seed))
    flights = [
        {"layout": number} | flown(name, setup.task(layouts.take([number])))
        for number in range(count)
        for name in solvers
    ]
    ways = {name: [held["way"] for held in flights if held["solver"] == name] for name in solvers}
    trials = pd.DataFrame(flights).drop(columns="way").assign(scenario="floors", model="unicycle", feasible=True)
    save(layout_grid(layouts.arrays(), ways, trials, rows=2), file)


if __name__ == "__main__":
    sys.exit(main())
