"""python -m benchmarks.families.oracle: the best known cost of every layout.

Minutes per layout, offline. It flies the solvers of SEARCH and takes the cheapest trajectory that reaches: at the goal,
violations of at most 1 mm, clear of the obstacles between the knots. The peers' costs on the public layouts
come from data/reference.csv. The result is written as `best_cost` into the files of benchmarks/data; only the judge of
`success` reads it. A cost in a file is only ever lowered; NaN means that none that reaches is known.
With `--fresh N` the layouts are the first N drawn under `--seed`, kept with their costs in benchmarks/data/drawn.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from benchmarks.lib.command import parser_of
from benchmarks.lib.families import DATA, EVERY, FAMILIES, Family
from torchgco import compose, judge
from torchgco.base.errors import InputError
from torchgco.judging.judge import near_best
from torchgco.scenarios import Layouts

# Solver configurations with overrides. `paths` refines 32 candidates along up to 24 paths, `early` at another pace; the
# rows are those that gco_max has more than gco.
PATHS = (
    "solver=gco_max", "solver.passes.many.refine.top=32", "solver.passes.many.num_paths=24",
    "solver.passes.many.roadmaps.0.num_halton=256", "solver.passes.many_closer.refine.top=32",
)  # fmt: skip
SEARCH = {
    "gco": ["solver=gco"],
    "gco_max": ["solver=gco_max"],
    "paths": [*PATHS],
    "early": [*PATHS, "solver.passes.many.follow.0.arrive=0.6", "solver.passes.many_closer.follow.0.arrive=0.6"],
    "multistart": ["solver=multistart"],
    "gco_paper": ["solver=gco_paper"],
    "fatrop": ["solver=fatrop"],
    "ipopt": ["solver=ipopt"],
}
PEERS = ("fatrop", "ipopt")  # need the extra `peers`; reference.csv has their results on the public layouts


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    for name in asked.families:
        family = EVERY[name]
        path = held(family, asked.fresh, asked.seed)
        if not asked.fresh and name in FAMILIES:
            keep(path, reference(family), "reference.csv")
        for search in asked.search or [name for name in SEARCH if asked.fresh or name not in PEERS]:
            for draw in asked.draws:
                overrides = [*family.overrides(asked.fresh, asked.seed), *SEARCH[search]]
                keep(path, flown(path, overrides, draw, asked.first), f"{search}, draws {draw}")
    return 0


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--search", nargs="+", choices=list(SEARCH), metavar="NAME", help="some of the searches only")
    parser.add_argument("--draws", type=int, nargs="+", default=[0], metavar="SEED", help="seeds of the solvers' draws")
    parser.add_argument("--fresh", type=int, default=0, metavar="N", help="N drawn layouts per family, not the 32")
    parser.add_argument("--seed", type=int, default=0, help="of the drawn layouts")
    parser.add_argument("--first", type=int, help="only this many layouts per family")
    return parser


def held(family: Family, fresh: int = 0, seed: int = 0) -> Path:
    """The file of the layouts; a missing file of drawn layouts is written.

    Raises:
        InputError: the file holds other layouts, or another number of layouts.
    """
    path = family.file(fresh, seed)
    if fresh:
        drawn = compose(family.overrides(fresh, seed)).layouts()
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            drawn.save(path)
        elif replace(Layouts.load(path), best_cost=None) != replace(drawn, name=path.stem):
            raise InputError("fresh", f"the layouts that {path} holds", f"{fresh} of seed {seed}")
    return path


def reference(family: Family) -> np.ndarray:
    """The least cost (L,) of FATROP and IPOPT on every public layout that they reach, NaN where neither arrives."""
    table = pd.read_csv(DATA / "reference.csv")
    layouts = Layouts.load(family.file())
    there = (table.family == family.name) & (table.feasible == 1) & (table.goal_distance < layouts.goal_radius)
    costs = table[there].groupby("layout").cost.min()
    return costs.reindex(range(layouts.count)).to_numpy()


def flown(path: Path, overrides: list[str], draw: int, first: int | None) -> np.ndarray:
    """Costs (L,) of one solver's trajectories that reach, NaN where it has none."""
    setup = compose([*overrides, "device.threads=1"])
    layouts = setup.layouts(first)
    task = setup.task(layouts)
    U = setup.solver.solve(task.problem, task.U0, seed=draw, ids=torch.as_tensor(layouts.ids)).U
    verdict = judge(task.problem, U, task.goal, task.goal_radius)
    costs = np.full(Layouts.load(path).count, np.nan)
    costs[layouts.ids] = torch.where(verdict.reached, verdict.cost, torch.nan).numpy()
    return costs


def keep(path: Path, costs: np.ndarray, source: str) -> None:
    """Lower the best costs in the file to these, and print the changes."""
    layouts = Layouts.load(path)
    old = layouts.best_cost if layouts.best_cost is not None else np.full(layouts.count, np.nan)
    best = np.fmin(old, costs)
    lowered = (costs < old) | (np.isnan(old) & ~np.isnan(costs))
    if lowered.any():
        replace(layouts, best_cost=best).save(path)
    known, median = int((~np.isnan(best)).sum()), np.nanmedian(best) if not np.isnan(best).all() else np.nan
    missed = int((~near_best(old, costs)).sum())
    print(
        f"{path.stem}: {source} lowers {lowered.sum()} of {layouts.count}, {missed} by over 5 %; "
        f"paths on {known}, median {median:,.1f}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
