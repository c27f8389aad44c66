"""python -m benchmarks.oracle: the best cost known on every public layout, and whether a way is known at all.

Minutes a layout, offline. It flies the solvers of SEARCH, each with several seeds, and takes the cheapest sound path of
any: at the goal, within 1 mm of every constraint, clear of the obstacles between the knots. The peers' costs come from
data/reference.csv. The result is written as `best_cost` into the files of benchmarks/data, where the judge of `success`
reads it and nothing else; a cost that stands there is only ever lowered, and NaN means that no way is known.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from benchmarks.families import DATA, FAMILIES, Family
from torchgco import compose, judge
from torchgco.scenarios import Layouts

# Solver configs with overrides. The last refines each of the ten best of sixteen ways: different homotopy classes.
SEARCH = {
    "gco": ["solver=gco"],
    "gco_max": ["solver=gco_max"],
    "ways": [
        "solver=gco_max", "solver.attempts=10", "solver.guidance.detours=10", "solver.guidance.detour.ways=16",
        "solver.guidance.detour.roadmap.spread=256",
    ],
}  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.oracle", description="Seek the best known costs.")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES), metavar="NAME")
    parser.add_argument("--search", nargs="+", default=list(SEARCH), choices=list(SEARCH), metavar="NAME")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="SEED")
    parser.add_argument("--first", type=int, help="so many layouts of each family only")
    asked = parser.parse_args(words)
    for name in asked.families:
        family = FAMILIES[name]
        keep(family, reference(family), "reference.csv")
        for search in asked.search:
            for seed in asked.seeds:
                keep(family, flown(family, SEARCH[search], seed, asked.first), f"{search}, seed {seed}")
    return 0


def reference(family: Family) -> np.ndarray:
    """The cheapest arrival of FATROP and IPOPT on every layout (L,), NaN where neither arrives."""
    table = pd.read_csv(DATA / "reference.csv")
    layouts = Layouts.load(family.path)
    there = (table.family == family.name) & (table.feasible == 1) & (table.goal_distance < layouts.goal_radius)
    costs = table[there].groupby("layout").cost.min()
    return costs.reindex(range(layouts.count)).to_numpy()


def flown(family: Family, overrides: list[str], seed: int, first: int | None) -> np.ndarray:
    """Costs (L,) of one solver's sound paths, NaN where it has none."""
    setup = compose([*family.overrides(seed=seed), *overrides, "device.threads=1"])
    layouts = setup.layouts(first)
    task = setup.task(layouts)
    ids = torch.as_tensor(layouts.ids)
    U = setup.solver.solve(task.problem, task.U0, seed=seed, ids=ids).U
    verdict = judge(task.problem, U, task.goal, task.goal_radius)
    costs = np.full(Layouts.load(family.path).count, np.nan)
    costs[layouts.ids] = torch.where(verdict.sound, verdict.cost, torch.nan).numpy()
    return costs


def keep(family: Family, costs: np.ndarray, source: str) -> None:
    """Lower the file's best costs to these, and say what that did."""
    layouts = Layouts.load(family.path)
    old = layouts.best_cost if layouts.best_cost is not None else np.full(layouts.count, np.nan)
    best = np.fmin(old, costs)
    lowered = int((costs < old).sum() + (np.isnan(old) & ~np.isnan(costs)).sum())
    if lowered:
        replace(layouts, best_cost=best).save(family.path)
    ways, median = int((~np.isnan(best)).sum()), np.nanmedian(best) if not np.isnan(best).all() else np.nan
    print(
        f"{family.name}: {source} lowers {lowered} of {layouts.count}; ways on {ways}, median {median:,.1f}", flush=True
    )


if __name__ == "__main__":
    sys.exit(main())
