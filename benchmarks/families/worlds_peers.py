"""python -m benchmarks.families.worlds_peers: FATROP, IPOPT and acados in the worlds, from rest and from a path.

They take seconds to minutes per problem, so they aren't flown with `gco`: every flight is kept as a row of
benchmarks/data/worlds/peers.csv, which `worlds` reads. Rows that are there aren't flown again, so that a
stopped run resumes. Every flight is a process of its own, which ends at a limit of processor time; building the program
and compiling it isn't counted, computing the guess is. Among moving obstacles there is no path, and nothing guided.
"""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from signal import ITIMER_PROF
from typing import Any

import torch
from torch import Tensor

from benchmarks.lib import acados
from benchmarks.lib.command import parser_of
from benchmarks.lib.comparison import timed
from benchmarks.lib.families import DATA, WORLDS, Family
from benchmarks.lib.kept import append, rows_of
from benchmarks.lib.provenance import provenance
from torchgco import Problem, compose, judge, presets
from torchgco.base.status import Status
from torchgco.baselines import CasADiSolver, GuidedCasADi
from torchgco.baselines.casadi import PreparedCasADi
from torchgco.baselines.limited import limited
from torchgco.baselines.nlp import Program
from torchgco.experiments.results.identity import layout_digests
from torchgco.obstacles import Obstacles
from torchgco.scenarios import Task

FILE = DATA / "worlds" / "peers.csv"
# By the program that they share: acados gets FATROP's.
SOLVERS = {
    "fatrop": ("fatrop", "fatrop_guided", "acados", "acados_guided"),
    "ipopt": ("ipopt", "ipopt_guided"),
}
NAMES = tuple(name for names in SOLVERS.values() for name in names)
COLUMNS: tuple[str, ...] = (
    "world", "solver", "guess", "layout", "layout_digest", "status", "reached", "cost", "violation",
    "clearance", "seconds", "limit", "iterations", "version", "date", "commit",
)  # fmt: skip
ACADOS_STATUS = {0: Status.CONVERGED.name, 2: Status.MAX_ITERATIONS.name}
LIMIT = 120  # s of processor time per problem
BLOCK = 4  # layouts of every world and solver before the next ones: a program is built once per block


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    torch.set_num_threads(1)
    origin = provenance("cpu")
    with tempfile.TemporaryDirectory() as folder:
        for begin in range(0, asked.layouts, asked.block):
            block = range(begin, min(begin + asked.block, asked.layouts))
            for name in asked.worlds:
                world = World.of(WORLDS[name], Path(folder) / name)
                for row in flights(world, asked.solvers, block, asked.limit, asked.file):
                    append(asked.file, COLUMNS, row | {"date": origin["date"], "commit": origin["commit"]})
                    print(*(row[column] for column in COLUMNS[:-2] if column in row), flush=True)
    return 0


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS), metavar="NAME")
    parser.add_argument("--solvers", nargs="+", default=list(NAMES), choices=NAMES, metavar="NAME")
    parser.add_argument("--layouts", type=int, default=32, metavar="N", help="the first N of each world")
    parser.add_argument("--limit", type=int, default=LIMIT, metavar="SECONDS", help="of processor time per problem")
    parser.add_argument("--block", type=int, default=BLOCK, metavar="N", help="layouts of all worlds before the next")
    parser.add_argument("--file", type=Path, default=FILE, help="where the rows are kept")
    return parser


@dataclass
class World:
    """The layouts of a world as problems, padded to the same number of obstacles, as `gco` flies them, too."""

    name: str
    task: Task
    digests: dict[int, str]
    folder: Path  # where acados compiles

    @classmethod
    def of(cls, family: Family, folder: Path) -> World:
        setup = compose(family.overrides())
        task = setup.task()
        return cls(family.name, task, layout_digests(task.layouts, setup.configuration["model"]["vehicle"]), folder)

    def problem(self, layout: int) -> Problem:
        return self.task.problem.take(torch.tensor([layout]))

    @property
    def moving(self) -> bool:
        return any(isinstance(c, Obstacles) and c.moving for c in self.task.problem.constraints)


def flights(
    world: World, solvers: Sequence[str], layouts: Sequence[int], limit: int, file: Path
) -> Iterator[dict[str, object]]:
    """The rows that the file lacks, one after the other, without date and commit."""
    keys = ["world", "solver", "layout", "layout_digest"]
    known = {tuple(key) for key in rows_of(file, COLUMNS)[keys].itertuples(index=False)}
    for plugin, names in SOLVERS.items():
        lacking = [
            (name, layout)
            for layout in layouts
            for name in names
            if name in solvers
            and (world.name, name, layout, world.digests[layout]) not in known
            and not (name.endswith("guided") and world.moving)
            and not (name.startswith("acados") and not acados.installed())
        ]
        if not lacking:
            continue
        names = {name for name, _ in lacking}
        peers, took = timed(lambda plugin=plugin, names=names: Peers.ready(world, plugin, names))
        print(f"{world.name}: set-up of {plugin} took {took:.0f} s", flush=True)
        for name, layout in lacking:
            yield _judged(world, name, layout, peers.fly(name, layout, limit)) | {"limit": limit}


@dataclass
class Flight:
    """What one solver returned for one layout; no controls where it didn't return."""

    U: Tensor | None  # (1, N, m)
    status: str
    seconds: float  # of processor time
    iterations: int | None
    follows: bool = False  # whether the guess follows a path


def _judged(world: World, name: str, layout: int, flight: Flight) -> dict[str, object]:
    task, rows = world.task, torch.tensor([layout])
    held: dict[str, object] = {
        "world": world.name, "solver": name, "guess": "path" if flight.follows else "rest", "layout": layout,
        "layout_digest": world.digests[layout], "status": flight.status, "reached": False,
        "seconds": f"{flight.seconds:.4g}", "iterations": flight.iterations,
        "version": f"acados {acados.version()}" if name.startswith("acados") else f"CasADi {version('casadi')}",
    }  # fmt: skip
    if flight.U is not None:
        verdict = judge(world.problem(layout), flight.U, task.goal[rows], task.goal_radius)
        held["reached"] = bool(verdict.reached)
        for column in ("cost", "violation", "clearance"):
            held[column] = f"{float(getattr(verdict, column)):.9g}"
    return held


@dataclass
class Peers:
    """The solvers that share a world's program, ready to fly."""

    world: World
    prepared: PreparedCasADi | None
    guided: GuidedCasADi
    program: Program | None  # acados's

    @classmethod
    def ready(cls, world: World, plugin: str, names: set[str]) -> Peers:
        """The program of the first layout, which serves all others of its world."""
        first = world.problem(0)
        prepared = program = None
        if plugin in {name.removesuffix("_guided") for name in names}:
            solver = presets.PRESETS[plugin](first)
            assert isinstance(solver, CasADiSolver)
            prepared = solver.prepare(first)
        if any(name.startswith("acados") for name in names):
            shared = None if prepared is None or world.moving else prepared.program
            program = acados.program_of(first) if shared is None else shared
        guided = presets.fatrop_guided(first)
        if any(name.endswith("guided") for name in names):
            guided.guess(first, world.task.U0[:1])  # compiles
        return cls(world, prepared, guided, program)

    def fly(self, name: str, layout: int, limit: int) -> Flight:
        """One flight, in a process of its own; computing the guess counts."""
        problem, U = self.world.problem(layout), self.world.task.U0[layout : layout + 1]
        follows, took = False, 0.0
        if name.endswith("guided"):
            guess, took = timed(lambda: self.guided.guess(problem, U))
            U, follows = guess.U, bool(guess.found)
        try:
            flight = self._acados(problem, U, limit) if name.startswith("acados") else self._casadi(problem, U, limit)
        except TimeoutError:
            return Flight(None, Status.TIME_LIMIT.name, limit, None, follows)
        except ChildProcessError as fault:  # of the solver
            return Flight(None, str(fault), limit, None, follows)
        return replace(flight, seconds=flight.seconds + took, follows=follows)

    def _acados(self, problem: Problem, U: Tensor, limit: int) -> Flight:
        answer = acados.fly(problem, U, self.world.folder, self.program, limit)
        status = int(answer.status[0])
        ended = ACADOS_STATUS.get(status, f"acados {status}")
        return Flight(answer.U, ended, float(answer.processor[0]), int(answer.iterations[0]))

    def _casadi(self, problem: Problem, U: Tensor, limit: int) -> Flight:
        """The child shares the program that was built here."""
        assert self.prepared is not None
        prepared = self.prepared.of(problem)

        def solve() -> tuple[Any, ...]:
            solution, took = timed(lambda: prepared.solve(problem, U))
            return solution.U.numpy(), solution.statuses[0].name, took, int(solution.iterations)

        controls, *rest = limited(solve, limit, ITIMER_PROF)
        return Flight(torch.from_numpy(controls), *rest)


if __name__ == "__main__":
    sys.exit(main())
