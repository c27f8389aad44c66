"""python -m benchmarks.families.quality: how often the goal is reached, and how well, on the public families.

Every family and solver is a separate study below outputs/quality, so that a run that was stopped resumes where it
was. The table is printed. With --write, and where all families flew, it is put into its page with date and commit: the
table of `gco` alone into benchmarks/README.md, drawn layouts and several solvers into
results/ladder.md, unless --page names another page.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks.lib import ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import EVERY, FAMILIES, Family
from benchmarks.lib.page import chosen, crossed, filed, interval, machine, markdown, origin, put, share, shown
from benchmarks.lib.studies import flown
from torchgco.experiments.results.folder import with_success
from torchgco.experiments.statistics.statistics import summarise
from torchgco.scenarios import Layouts

PAGES = {
    "quality": "README.md",
    "ladder": "results/ladder.md",
    "drawn": "results/ladder.md",
}  # below benchmarks/; a table is between the marks of its name
HEAD = (
    "family", "solver", "n", "feasible", "reached", "success", "median cost", "median iterations",
    "median seconds",
)  # fmt: skip

SHOWN = "family", "n", "reached", "success", "median cost", "median seconds"  # of one solver
SHORT = ("Success", "Median seconds")  # of several solvers


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    trials = pd.concat([fly(EVERY[name], asked) for name in asked.families], ignore_index=True)
    text = table(trials)
    print(text)
    if len(asked.solvers) > 1:
        parts = (crossed(text, "family", "solver", cell) for cell in ("success", "median seconds"))
        text = filed("ladder", text, *(f"{title}:\n\n{part}" for title, part in zip(SHORT, parts, strict=True)))
    else:
        text = chosen(text, SHOWN)
    if set(asked.families) == set(FAMILIES) and asked.write:
        name, which = page_of(asked), f"`{asked.solvers[0]}`, " if len(asked.solvers) == 1 else ""
        head = f"{source(asked, 'family')}, {which}{machine()}."
        put(ROOT / "benchmarks" / PAGES[name], name, f"{head}\n\n{text}")
    return 0


def page_of(asked: Namespace) -> str:
    """The name of the page that a run's table belongs to."""
    if asked.page is not None:
        return asked.page
    return "drawn" if asked.fresh else "quality" if asked.solvers == ["gco"] else "ladder"


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "README.md or a page of results")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--solvers", nargs="+", default=["gco"], metavar="NAME", help="configs; default: gco")
    parser.add_argument(
        "--fresh", type=int, default=0, metavar="N", help="N drawn layouts per family, not the public 32"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", choices=list(PAGES), metavar="NAME", help=", ".join(PAGES) + "; default: by content")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "quality")
    parser.add_argument("overrides", nargs="*", help="of the configuration, for all studies")
    return parser


def fly(family: Family, asked: Namespace) -> pd.DataFrame:
    """The trials of every solver, with the family's name as scenario."""
    return pd.concat([study(family, solver, asked) for solver in asked.solvers], ignore_index=True)


def study(family: Family, solver: str, asked: Namespace) -> pd.DataFrame:
    """The trials of one solver, with the family's name as scenario, and success by the best costs known now."""
    folder = asked.outputs / f"{family.name}-{asked.fresh}-{asked.seed}-{solver}"
    trials = flown(
        folder, *family.overrides(asked.fresh, asked.seed), f"solver={solver}", "study.baselines=[]",
        "study.shard_size=32", *asked.overrides,
    ).assign(scenario=family.name)  # fmt: skip
    best = family.file(asked.fresh, asked.seed)
    return succeeded(trials, Layouts.load(best)) if best.exists() else trials


def succeeded(trials: pd.DataFrame, layouts: Layouts) -> pd.DataFrame:
    """The trials with `success` from the best cost known now, which may be lower than when they flew.

    Of drawn layouts only the first have a best cost, those that the oracle has solved.
    """
    return with_success(trials, layouts, 1)


def table(trials: pd.DataFrame) -> str:
    """Markdown: a row per family and solver, rates with 95 % Wilson intervals in percent."""
    return markdown(HEAD, [
        [
            row["scenario"], f"`{row['solver']}`", row["n"],
            *(_rate(row, name) for name in ("feasible", "reached", "success")),
            shown(row["cost_median_reached"], ",.0f"),
            shown(row["iterations_median"], ".0f"), shown(row["seconds_median"], ".2f"),
        ]
        for row in summarise(trials).to_dict(orient="records")
    ])  # fmt: skip


def _rate(row: dict[str, float], name: str) -> str:
    count, n = int(row[f"{name}_count"]), int(row[f"{name}_n"])
    return share(count, n) if n == 0 or n != row["n"] else f"{count} {interval(count, n)}"


def source(asked: Namespace, group: str) -> str:
    """How a run flew, as the beginning of the line above its table; `group` is what layouts are drawn for."""
    layouts = f"{asked.fresh} drawn layouts per {group}" if asked.fresh else "the public layouts"
    return f"{origin('Flown')}, {layouts}, seed {asked.seed}"


if __name__ == "__main__":
    sys.exit(main())
