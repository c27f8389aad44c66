"""python -m benchmarks.causes.shortfalls: why `gco` misses the best known solution in the worlds.

`gco` flies the public layouts of each world. Every layout where it isn't a success is solved again alone, and its
search is watched; then candidates along 24 paths are all refined to their end. Where the good ones among them were
dropped is the cause. With --write, table, list and pictures go to benchmarks/results/shortfalls.md and shortfalls.png.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isnan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.causes.picture import Example, picture, table
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import WORLDS, Family
from benchmarks.lib.page import filed, markdown, origin, put
from torchgco import compose, judge, presets
from torchgco.judging.judge import near_best
from torchgco.plotting.bodies import Box, bodies
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_paths
from torchgco.scenarios import Layouts
from torchgco.search import PathProposals, Refine
from torchgco.search.proposals import Round
from torchgco.solution import Comparison, Fate, SearchRecord

PAGE = RESULTS / "shortfalls.md"
COSTLY = next(row for row in presets.gco(3).passes.steps if isinstance(row, PathProposals) and row.when == "costly")
PATHS = COSTLY.num_paths  # of each of the two searches where the best candidate is costly
CAUSES = {
    "no solution known": "neither `gco` nor any other search has found a way",
    "another local solution": "moving obstacles: waiting, or passing on another side, costs less",
    "not reached": "moving obstacles: no attempt arrives",
    "not among the paths": f"no candidate along {PATHS} paths of each search ends within 5 % of the best known cost",
    "no path sought": "a candidate does, but the first solve was never caught, so that `gco` sought no path",
    "a later path": "a candidate does, but its path comes after those that `gco` sought",
    "dropped as tracked": "its path was sought, but cheaper tracked candidates were relaxed in its place",
    "dropped as relaxed": "it was relaxed, but then didn't arrive, or more expensive than those taken",
    "lost in the solve": "it was compared or chosen, and the solve ended elsewhere",
}
FATES = ("dropped as tracked", "dropped as relaxed", "lost in the solve")  # of a sought candidate
HEAD = (
    "world", "layout", "cost / best known", "cheapest of all candidates / best known", "first path within 5 %",
    "paths sought", "cause",
)  # fmt: skip


@dataclass
class Search:
    """One comparison of candidates, one per path; a search for more paths extends the list of paths."""

    count: int  # paths sought, those of the same homotopy class included
    relaxed: Sequence[int] = ()
    compared: Sequence[int] = ()  # of those taken, the ones that arrive
    chosen: int | None = None  # None: no proposal

    @classmethod
    def of(cls, record: Comparison) -> Search:
        """The comparison of a single problem's candidates, from the record of a solve."""
        (fate,) = record.fate.tolist()
        assert len(fate) == record.paths.shape[1]  # one start and one pace
        relaxed, compared, chosen = (
            [path for path, one in enumerate(fate) if one >= least]
            for least in (Fate.UNSOUND, Fate.FAILED, Fate.PROPOSED)
        )
        return cls(len(fate), relaxed, compared, chosen[0] if chosen else None)


def cause(best: float, reached: bool, costs: Sequence[float], searches: Sequence[Search]) -> str:
    """The cause for one layout on which `gco` isn't a success; of several good candidates the one that got farthest.

    Args:
        best: the best known cost, NaN where no solution is known.
        reached: whether the result of `gco` does.
        costs: of a refined candidate along each path, infinite where it has no good end; none: no paths can be sought.
        searches: those that `gco` made.
    """
    if isnan(best) and not reached:
        return "no solution known"
    if not costs:
        return "another local solution" if reached else "not reached"
    good = within(best, costs)
    if not good:
        return "not among the paths"
    if not searches:
        return "no path sought"
    sought = [path for path in good if path < _sought(searches)]
    return max((_fate(path, searches) for path in sought), key=FATES.index, default="a later path")


def within(best: float, costs: Sequence[float]) -> list[int]:
    """Numbers of the paths whose candidates end within 5 % of the best known cost."""
    return [path for path, cost in enumerate(costs) if near_best(cost, best)]


def _sought(searches: Sequence[Search]) -> int:
    return max((search.count for search in searches), default=0)


def _fate(path: int, searches: Sequence[Search]) -> str:
    """Where the candidates along a path were dropped, in the last searches for it that made a proposal."""
    own = [search for search in searches if path < search.count]
    own = [search for search in own if search.chosen is not None] or own
    last = [search for search in own if search.count == own[-1].count]  # the same paths, followed in two ways
    if any(path in search.compared for search in last):
        return FATES[2]
    return FATES[1] if any(path in search.relaxed for search in last) else FATES[0]


def refined(problem: Problem, count: int = PATHS) -> tuple[list[float], dict[int, Tensor]]:
    """Costs of the cheaper candidate, followed loosely or closer, along each of `count` paths of each search.

    All are refined to the end; the cost is infinite where neither has a good end. Also returns the states (N+1, n) of
    the others by the number of their path.
    """
    every = replace(COSTLY, when="caught", num_paths=count, relax_top=None, refine=Refine(top=2 * count), max_gap=None)
    record = SearchRecord(passes=[(1, "PathProposals", [])])
    Round(problem, every.at_once, record=record).improve(every)
    unit, constant = float(problem.cost_unit), float(problem.cost_scale.constant)
    costs, ends = [inf] * (2 * count), {}
    for one in record.comparisons:
        for path in one.cost[0].isfinite().nonzero().flatten().tolist():
            cost = unit * float(one.cost[0, path]) + constant
            if cost < costs[path]:
                costs[path], ends[path] = cost, one.refined[0, path]
    return costs, ends


def fly(family: Family, first: int | None, seed: int) -> tuple[pd.DataFrame, dict[str, Example]]:
    """One row per layout, with its cause where it isn't a success, and one example per cause."""
    setup = compose([*family.overrides(seed=seed), "solver=gco", "device.threads=1"])
    layouts = setup.layouts(first)
    task = setup.task(layouts)
    verdict = judge(task.problem, setup.solver.solve(task.problem, task.U0, seed=seed).U, task.goal, task.goal_radius)
    assert layouts.best_cost is not None
    best = torch.as_tensor(layouts.best_cost)
    short = ~torch.where(best.isnan(), verdict.reached, verdict.success(best.nan_to_num(0.0)))
    rows, examples = [], {}
    for i in range(task.problem.B):
        row: dict[str, Any] = {"family": family.name, "layout": i, "cause": None}
        if short[i]:
            cost = float(verdict.cost[i]) if verdict.reached[i] else inf
            found, example = study(setup.solver, task, layouts, i, seed, cost)
            row |= found
            examples.setdefault(row["cause"], example)
            print(*_cells(row), sep=" | ", flush=True)
        rows.append(row)
    return pd.DataFrame(rows), examples


def study(
    solver: Any, task: Any, layouts: Layouts, i: int, seed: int, cost: float, count: int = PATHS
) -> tuple[dict[str, Any], Example]:
    """The cause for layout i, on which `gco` isn't a success, with the figures that led to it.

    Args:
        solver, task, layouts, i, seed: the solver, the layouts and their problems, the number of one, the draws.
        cost: of the result of `gco`, infinite where it doesn't reach.
        count: paths whose candidates are refined.
    """
    assert layouts.best_cost is not None
    best, part = float(layouts.best_cost[i]), task.problem.take(torch.tensor([i]))
    recording = replace(solver, local=replace(solver.local, record=True))
    solution = recording.solve(part, task.U0[i : i + 1], seed=seed, ids=torch.tensor([i]))
    assert solution.search is not None
    searches = [Search.of(one) for one in solution.search.comparisons]
    costs, ends = refined(part, count) if has_paths(part) else ([], {})
    name = cause(best, cost < inf, costs, searches)
    good, cheapest, at = within(best, costs), min(costs, default=inf), part.position
    found = {
        "cause": name,
        "ratio": cost / best,
        "cheapest": cheapest / best,
        "path": good[0] + 1 if good else None,
        "sought": _sought(searches) if costs else None,
    }
    plan = ends[costs.index(cheapest)][:, at] if ends else None
    return found, _example(layouts, i, solution.X[0, :, at], plan, part)


def _example(layouts: Layouts, i: int, path: Tensor, plan: Tensor | None, problem: Problem) -> Example:
    """The layout with its obstacles inflated, a moving sphere where it is closest to the trajectory."""
    centers, radius = torch.as_tensor(layouts.centers[i]), layouts.vehicle_radius or 0.0
    if layouts.velocities is not None and len(centers) > 0:
        times = (layouts.dt or problem.dynamics.dt) * torch.arange(len(path)).view(-1, 1, 1)
        moved = centers + times * torch.as_tensor(layouts.velocities[i])  # (N+1, M, d)
        closest = (moved - path.unsqueeze(1)).norm(dim=-1).nan_to_num(inf).argmin(0)
        centers = moved[closest, torch.arange(len(centers))]
    boxes = tuple(body.outline(radius) for body in bodies(layouts.arrays(), i) if isinstance(body, Box))
    distances = torch.as_tensor(layouts.radii[i]) + radius
    assert problem.goal is not None
    return Example(layouts.name, i, centers, distances, path, plan, problem.goal.position[0], boxes)


def listed(trials: pd.DataFrame) -> str:
    """Markdown: a row per layout on which `gco` isn't a success."""
    return markdown(HEAD, map(_cells, trials[trials.cause.notna()].to_dict(orient="records")))


def _cells(row: dict[Any, Any]) -> list[Any]:
    ratio = "not reached" if not np.isfinite(row["ratio"]) else f"{row['ratio']:.3f}"
    cheapest = f"{row['cheapest']:.3f}" if np.isfinite(row["cheapest"]) else "-"
    path, sought = ("-" if pd.isna(row[name]) else f"{row[name]:.0f}" for name in ("path", "sought"))
    return [row["family"], row["layout"], ratio, cheapest, path, sought, row["cause"]]


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "results/shortfalls.md")
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS), metavar="NAME")
    parser.add_argument("--first", type=int, metavar="N", help="the first N layouts of each world; default: all")
    parser.add_argument("--seed", type=int, default=0)
    return parser


def main(words: Sequence[str] | None = None) -> int:
    parser = _parser()
    asked = parser.parse_args(words)
    if asked.write and (set(asked.worlds) != set(WORLDS) or asked.first is not None):
        parser.error("--write: only with all layouts of all worlds")
    parts, examples = [], {}
    for name in asked.worlds:
        trials, found = fly(WORLDS[name], asked.first, asked.seed)
        parts.append(trials)
        examples = {**found, **examples}
    trials = pd.concat(parts, ignore_index=True)
    shown = {name: examples[name] for name in CAUSES if name in examples}
    if asked.write:
        write(PAGE, trials, shown, asked.seed)
    else:
        print(f"{_table(trials)}\n\n{listed(trials)}")
    return 0


def _table(trials: pd.DataFrame) -> str:
    return table(trials, CAUSES, "short")


def write(page: Path, trials: pd.DataFrame, examples: dict[str, Example], seed: int) -> None:
    """Put table and list between the marks of the page, and the picture next to it."""
    head = f"{origin('`gco`')}, seed {seed}, the public layouts."
    blocks = [head, _table(trials), filed("shortfalls", listed(trials))]
    if examples:
        file = picture(examples, page.with_suffix(".png"), "cheapest candidate")
        blocks.append(f"![One layout for every cause]({file.name})")
    put(page, "shortfalls", "\n\n".join(blocks))


if __name__ == "__main__":
    sys.exit(main())
