"""python -m benchmarks.oracle: the best cost known on every layout, and whether a path is known at all.

Minutes per layout, offline. It flies the solvers of SEARCH, and takes the cheapest sound trajectory of any: at the
goal, within 1 mm of every constraint, clear of the obstacles between the knots. The peers' costs on the public layouts
come from data/reference.csv. The result is written as `best_cost` into the files of benchmarks/data, where the judge of
`success` reads it and nothing else; a cost that stands there is only ever lowered, and NaN means that no path is known.
With `--fresh N` the layouts are the first N drawn under `--seed`, kept with their costs in benchmarks/data/drawn.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from benchmarks.families import DATA, FAMILIES, Family
from torchgco import compose, judge
from torchgco.errors import InputError
from torchgco.judge import SUCCESS_COST
from torchgco.scenarios import Layouts

# Solver configs with overrides. `paths` refines 32 candidates along up to 24 paths, `early` at another pace.
PATHS = (
    "solver=gco_max", "solver.paths.refine_top=32", "solver.paths.num_paths=24", "solver.paths.roadmap.num_halton=256",
)  # fmt: skip
SEARCH = {
    "gco": ["solver=gco"],
    "gco_max": ["solver=gco_max"],
    "paths": [*PATHS],
    "early": [*PATHS, "solver.paths.arrive=0.6", "solver.attempts=1"],
    "multistart": ["solver=multistart"],
    "gco_paper": ["solver=gco_paper"],
    "fatrop": ["solver=fatrop"],
    "ipopt": ["solver=ipopt"],
}
PEERS = ("fatrop", "ipopt")  # need the extra `peers`; on the public layouts reference.csv has flown them


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    for name in asked.families:
        family = FAMILIES[name]
        path = held(family, asked.fresh, asked.seed)
        if not asked.fresh:
            keep(path, reference(family), "reference.csv")
        for search in asked.search or [name for name in SEARCH if asked.fresh or name not in PEERS]:
            for draw in asked.draws:
                overrides = [*family.overrides(asked.fresh, asked.seed), *SEARCH[search]]
                keep(path, flown(path, overrides, draw, asked.first), f"{search}, draws {draw}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.oracle", description="Seek the best known costs.")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES), metavar="NAME")
    parser.add_argument("--search", nargs="+", choices=list(SEARCH), metavar="NAME", help="some of the searches only")
    parser.add_argument("--draws", type=int, nargs="+", default=[0], metavar="SEED", help="seeds of the solvers' draws")
    parser.add_argument("--fresh", type=int, default=0, metavar="N", help="N drawn layouts a family, not the public 32")
    parser.add_argument("--seed", type=int, default=0, help="of the drawn layouts")
    parser.add_argument("--first", type=int, help="so many layouts of each family only")
    return parser


def held(family: Family, fresh: int = 0, seed: int = 0) -> Path:
    """The file of the layouts; drawn ones are drawn and written if it isn't there.

    Raises:
        InputError: other layouts lie there, or another number of them.
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
    """The cheapest arrival of FATROP and IPOPT on every public layout (L,), NaN where neither arrives."""
    table = pd.read_csv(DATA / "reference.csv")
    layouts = Layouts.load(family.file())
    there = (table.family == family.name) & (table.feasible == 1) & (table.goal_distance < layouts.goal_radius)
    costs = table[there].groupby("layout").cost.min()
    return costs.reindex(range(layouts.count)).to_numpy()


def flown(path: Path, overrides: list[str], draw: int, first: int | None) -> np.ndarray:
    """Costs (L,) of one solver's sound paths, NaN where it has none."""
    setup = compose([*overrides, "device.threads=1"])
    layouts = setup.layouts(first)
    task = setup.task(layouts)
    U = setup.solver.solve(task.problem, task.U0, seed=draw, ids=torch.as_tensor(layouts.ids)).U
    verdict = judge(task.problem, U, task.goal, task.goal_radius)
    costs = np.full(Layouts.load(path).count, np.nan)
    costs[layouts.ids] = torch.where(verdict.sound, verdict.cost, torch.nan).numpy()
    return costs


def keep(path: Path, costs: np.ndarray, source: str) -> None:
    """Lower the file's best costs to these, and say what that did."""
    layouts = Layouts.load(path)
    old = layouts.best_cost if layouts.best_cost is not None else np.full(layouts.count, np.nan)
    best = np.fmin(old, costs)
    lowered = (costs < old) | (np.isnan(old) & ~np.isnan(costs))
    if lowered.any():
        replace(layouts, best_cost=best).save(path)
    known, median = int((~np.isnan(best)).sum()), np.nanmedian(best) if not np.isnan(best).all() else np.nan
    missed = int((old > SUCCESS_COST * costs).sum())
    print(
        f"{path.stem}: {source} lowers {lowered.sum()} of {layouts.count}, {missed} by over 5 %; "
        f"paths on {known}, median {median:,.1f}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
