"""python -m benchmarks.families.worlds: woods, mazes and crossing spheres, by `gco` and its peers.

Every world and solver is a separate study below outputs/worlds, so that a run that was stopped resumes where it was.
The peers take up to minutes per problem among so many obstacles: their rows on the public layouts are read from the
file that `worlds_peers` keeps. With --write the table goes into benchmarks/results/worlds.md, with date and
commit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks.families.quality import study, succeeded
from benchmarks.families.worlds_peers import FILE, NAMES, rows_of
from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.families import WORLDS
from benchmarks.lib.page import put_between
from benchmarks.lib.provenance import provenance
from torchgco.experiments.results.success import sound
from torchgco.experiments.statistics.statistics import summarise, wilson
from torchgco.scenarios import Layouts

PAGE = RESULTS / "worlds.md"
SOLVERS = ("gco", "al_ilqr")
HEAD = (
    "world", "solver", "n", "reached", "reached, of solved layouts", "success", "cost / best known, median",
    "seconds per problem, median",
)  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    rows = []
    for name in asked.worlds:
        trials = pd.concat([study(WORLDS[name], solver, asked) for solver in SOLVERS], ignore_index=True)
        if not asked.fresh:
            trials = with_peers(name, trials, rows_of(asked.peers))
        new = table(trials, solved(name, trials, asked))
        print("\n".join(new), flush=True)
        rows += new
    if asked.write and set(asked.worlds) == set(WORLDS):
        head = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
        mark = "drawn" if asked.fresh else "worlds"
        source = _source(asked) + ("" if asked.fresh else _peers_source(rows_of(asked.peers)))
        put_between(PAGE, f"<!-- {mark} -->", f"<!-- end {mark} -->", "\n".join([source, "", *head, *rows]))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.families.worlds", description="Fly the worlds, and count."
    )
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS), metavar="NAME")
    parser.add_argument("--peers", type=Path, default=FILE, metavar="FILE", help="rows of worlds_peers")
    parser.add_argument("--fresh", type=int, default=0, metavar="N", help="N drawn layouts per world, not the 32")
    parser.add_argument("--seed", type=int, default=0, help="of the drawn layouts")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.relative_to(ROOT)}")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "worlds")
    parser.set_defaults(overrides=[])
    return parser


def with_peers(name: str, trials: pd.DataFrame, peers: pd.DataFrame) -> pd.DataFrame:
    """The trials of a world, and behind them those of its peers on the same layouts, solver by solver.

    trials  of a study
    peers   rows of `worlds_peers`; rows of other worlds and of layouts that have changed are left out
    """
    same = ["layout", "layout_digest"]
    flown = peers[peers["world"] == name].merge(trials[[*same, "model", "seed"]].drop_duplicates(), on=same)
    if flown.empty:
        return trials
    flown = flown.assign(place=flown["solver"].map(NAMES.index)).sort_values(["place", "layout"], kind="stable")
    flown = flown.assign(scenario=name, feasible=pd.NA, outer_iterations=float("nan"), guided=float("nan"))
    judged = succeeded(flown, Layouts.load(WORLDS[name].file()))
    return pd.concat([trials, judged], ignore_index=True)


def solved(name: str, trials: pd.DataFrame, asked: argparse.Namespace) -> set[int]:
    """The layouts that any solver is known to solve: here, or when the best costs were sought."""
    known = set(trials.loc[sound(trials), "layout"].tolist())
    path = WORLDS[name].file(asked.fresh, asked.seed)
    if path.is_file() and (best := Layouts.load(path).best_cost) is not None:
        known |= {i for i, cost in enumerate(best) if cost == cost}
    return known


def table(trials: pd.DataFrame, known: set[int]) -> list[str]:
    """A row in Markdown per solver, rates with 95 % Wilson intervals in percent.

    known  layouts that somebody solves
    """
    lines = []
    for row in summarise(trials).to_dict(orient="records"):
        own = trials[(trials["solver"] == row["solver"]) & trials["layout"].isin(known)]
        cells = [
            row["scenario"], f"`{row['solver']}`", row["n"], _share(row["reached_count"], row["n"]),
            _share(int(own["reached"].sum()), len(own)), _share(row["success_count"], row["success_n"]),
            _number(row["cost_ratio_median"], ".3f"), _number(row["seconds_median"], ".2g"),
        ]  # fmt: skip
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return lines


def _share(count: int, n: int) -> str:
    if n == 0:
        return "-"
    low, high = (100 * end for end in wilson(int(count), int(n)))
    return f"{count} of {n} [{low:.0f}, {high:.0f}]"


def _number(value: float, form: str) -> str:
    return "-" if value != value else format(value, form)


def _source(asked: argparse.Namespace) -> str:
    origin = provenance("cpu")
    layouts = f"{asked.fresh} drawn layouts per world" if asked.fresh else "the public layouts"
    return (
        f"Flown on {origin['date']} at commit {origin['commit']}, {layouts}, seed {asked.seed}, 95 % Wilson intervals "
        f"in percent; one thread per process, two processes, {origin['processor']}, shared."
    )


def _peers_source(peers: pd.DataFrame) -> str:
    if peers.empty:
        return ""
    limit, version, date, commit = (
        ", ".join(peers[name].astype(str).unique()) for name in ("limit", "version", "date", "commit")
    )
    return (
        f" FATROP, IPOPT and acados: {version}, flown on {date} at commit {commit}, processor time of one thread, at "
        f"most {limit} s per problem."
    )


if __name__ == "__main__":
    sys.exit(main())
