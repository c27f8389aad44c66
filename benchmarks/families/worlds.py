"""python -m benchmarks.families.worlds: woods, mazes and crossing spheres, by `gco` and its peers.

Every world and solver is a separate study below outputs/worlds, so that a run that was stopped resumes where it was.
The peers take up to minutes per problem among so many obstacles: their rows on the public layouts are read from the
file that `worlds_peers` keeps. With --write the table goes into benchmarks/results/worlds.md, with date and
commit.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.families.quality import source, study, succeeded
from benchmarks.families.worlds_peers import COLUMNS, FILE, NAMES
from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import WORLDS
from benchmarks.lib.kept import rows_of
from benchmarks.lib.page import chosen, crossed, filed, machine, markdown, put, share, shown
from torchgco.experiments.statistics.statistics import summarise
from torchgco.scenarios import Layouts

SOLVERS = ("gco", "al_ilqr")
HEAD = (
    "world", "solver", "n", "reached", "reached, of solved layouts", "success", "cost / best known, median",
    "seconds per problem, median",
)  # fmt: skip

OWN = ("world", "success", *HEAD[-2:])  # of `gco`


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    rows = []
    for name in asked.worlds:
        trials = pd.concat([study(WORLDS[name], solver, asked) for solver in SOLVERS], ignore_index=True)
        if not asked.fresh:
            trials = with_peers(name, trials, rows_of(asked.peers, COLUMNS))
        new = table(trials, solved(name, trials, asked))
        print(markdown(HEAD, new), flush=True)
        rows += new
    if asked.write and set(asked.worlds) == set(WORLDS):
        head = f"{source(asked, 'world')}, two processes, {machine()}."
        if not asked.fresh:
            head += _peers_source(rows_of(asked.peers, COLUMNS))
        name, file = ("drawn", "worlds-drawn") if asked.fresh else ("worlds", "worlds")
        put(RESULTS / "worlds.md", name, f"{head}\n\n{short(file, markdown(HEAD, rows))}")
    return 0


def short(name: str, table: str) -> str:
    """The table as a file; in the page the rows of `gco`, and how many layouts each solver reaches."""
    reached = crossed(table, "world", "solver", "reached")
    return filed(name, table, *([] if "drawn" in name else [chosen(table, OWN, solver=("`gco`",))]), reached)


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "results/worlds.md")
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS), metavar="NAME")
    parser.add_argument("--peers", type=Path, default=FILE, metavar="FILE", help="rows of worlds_peers")
    parser.add_argument("--fresh", type=int, default=0, metavar="N", help="N drawn layouts per world, not the 32")
    parser.add_argument("--seed", type=int, default=0, help="of the drawn layouts")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "worlds")
    parser.set_defaults(overrides=[])
    return parser


def with_peers(name: str, trials: pd.DataFrame, peers: pd.DataFrame) -> pd.DataFrame:
    """The trials of a world, and behind them those of its peers on the same layouts, solver by solver.

    Rows of other worlds, and of layouts that have changed, are left out.

    Args:
        name: of the world.
        trials: of a study.
        peers: rows of `worlds_peers`.
    """
    same = ["layout", "layout_digest"]
    flown = peers[peers["world"] == name].merge(trials[[*same, "model", "seed"]].drop_duplicates(), on=same)
    if flown.empty:
        return trials
    flown = flown.assign(place=flown["solver"].map(NAMES.index)).sort_values(["place", "layout"], kind="stable")
    flown = flown.assign(scenario=name, feasible=pd.NA, outer_iterations=float("nan"), guided=float("nan"))
    judged = succeeded(flown, Layouts.load(WORLDS[name].file()))
    return pd.concat([trials, judged], ignore_index=True)


def solved(name: str, trials: pd.DataFrame, asked: Namespace) -> set[int]:
    """The layouts that any solver is known to solve: here, or when the best costs were sought."""
    known = set(trials.loc[trials["reached"], "layout"].tolist())
    path = WORLDS[name].file(asked.fresh, asked.seed)
    if path.is_file() and (best := Layouts.load(path).best_cost) is not None:
        known |= {i for i, cost in enumerate(best) if cost == cost}
    return known


def table(trials: pd.DataFrame, known: set[int]) -> list[list[Any]]:
    """A row per solver; `known` are the layouts that somebody solves."""
    rows = []
    for row in summarise(trials).to_dict(orient="records"):
        own = trials[(trials["solver"] == row["solver"]) & trials["layout"].isin(known)]
        rows.append([
            row["scenario"], f"`{row['solver']}`", row["n"], share(row["reached_count"], row["n"]),
            share(own["reached"].sum(), len(own)), share(row["success_count"], row["success_n"]),
            shown(row["cost_ratio_median"], ".3f"), shown(row["seconds_median"], ".2g"),
        ])  # fmt: skip
    return rows


def _peers_source(peers: pd.DataFrame) -> str:
    if peers.empty:
        return ""
    limit, version, date, commit = (
        ", ".join(peers[name].astype(str).unique()) for name in ("limit", "version", "date", "commit")
    )
    return f" FATROP, IPOPT and acados: {version}, flown on {date} at commit {commit}, at most {limit} s per problem."


if __name__ == "__main__":
    sys.exit(main())
