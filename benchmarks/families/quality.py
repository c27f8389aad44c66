"""python -m benchmarks.families.quality: how often the goal is reached, and how well, on the public families.

Every family and solver is a separate study below outputs/quality, so that a run that was stopped resumes where it
was. The table is printed. With --write, and where all families flew, it is put into its page with date and commit: the
table of `gco` alone into benchmarks/README.md, drawn layouts into results/drawn.md, several solvers into
results/ladder.md, unless --page names another page.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks.lib import ROOT
from benchmarks.lib.families import EVERY, FAMILIES, Family
from benchmarks.lib.page import put_between
from benchmarks.lib.provenance import provenance
from torchgco.experiments.results.success import with_success
from torchgco.experiments.statistics.statistics import summarise
from torchgco.judging.judge import SUCCESS_VIOLATION
from torchgco.scenarios import Layouts

PAGES = {
    "quality": "README.md",
    "ladder": "results/ladder.md",
    "drawn": "results/drawn.md",
}  # below benchmarks/; a table is between the marks of its name
HEAD = (
    "family", "solver", "n", "feasible", "reached", "success", "violation <= 1e-3", "median cost", "median iterations",
    "median seconds",
)  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    trials = pd.concat([fly(EVERY[name], asked) for name in asked.families], ignore_index=True)
    text = table(trials)
    print(text)
    if set(asked.families) == set(FAMILIES) and asked.write:
        name = page(asked)
        marks = f"<!-- {name} -->", f"<!-- end {name} -->"
        put_between(ROOT / "benchmarks" / PAGES[name], *marks, f"{_source(asked)}\n\n{text}")
    return 0


def page(asked: argparse.Namespace) -> str:
    """The name of the page that a run's table belongs to."""
    if asked.page is not None:
        return asked.page
    return "drawn" if asked.fresh else "quality" if asked.solvers == ["gco"] else "ladder"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.families.quality", description="Fly the families, and count."
    )
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--solvers", nargs="+", default=["gco"], metavar="NAME", help="configs; default: gco")
    parser.add_argument(
        "--fresh", type=int, default=0, metavar="N", help="N drawn layouts per family, not the public 32"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="put the table into its page")
    parser.add_argument("--page", choices=list(PAGES), metavar="NAME", help=", ".join(PAGES) + "; default: by content")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "quality")
    parser.add_argument("overrides", nargs="*", help="of the configuration, for all studies")
    return parser


def fly(family: Family, asked: argparse.Namespace) -> pd.DataFrame:
    """The trials of every solver, with the family's name as scenario."""
    return pd.concat([study(family, solver, asked) for solver in asked.solvers], ignore_index=True)


def study(family: Family, solver: str, asked: argparse.Namespace) -> pd.DataFrame:
    """The trials of one solver, with the family's name as scenario, and success by the best costs known now."""
    folder = asked.outputs / f"{family.name}-{asked.fresh}-{asked.seed}-{solver}"
    command = [
        sys.executable, "-m", "torchgco", *family.overrides(asked.fresh, asked.seed), f"solver={solver}",
        "study.baselines=[]", "study.shard_size=32", f"hydra.run.dir={folder}", *asked.overrides,
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    trials = pd.read_parquet(folder / "trials.parquet").assign(scenario=family.name)
    best = family.file(asked.fresh, asked.seed)
    return succeeded(trials, Layouts.load(best)) if best.exists() else trials


def succeeded(trials: pd.DataFrame, layouts: Layouts) -> pd.DataFrame:
    """The trials with `success` from the best cost known now, which may be lower than when they flew.

    Of drawn layouts only the first have a best cost, those that the oracle has solved.
    """
    sound = trials["reached"] & (trials["violation"] <= SUCCESS_VIOLATION) & (trials["clearance"] >= 0)
    return with_success(trials.assign(sound=sound), layouts, 1)


def table(trials: pd.DataFrame) -> str:
    """Markdown: a row per family and solver, rates with 95 % Wilson intervals in percent."""
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    for row in summarise(trials).to_dict(orient="records"):
        rates = (_rate(row, name) for name in ("feasible", "reached", "success"))
        cells = [
            row["scenario"], f"`{row['solver']}`", row["n"], *rates,
            round(row["violation_ok"] * row["n"]), _number(row["cost_median_reached"], ",.0f"),
            _number(row["iterations_median"], ".0f"), _number(row["seconds_median"], ".2f"),
        ]  # fmt: skip
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def _rate(row: dict[str, float], name: str) -> str:
    if row[f"{name}_n"] == 0:
        return "-"
    low, high = (100 * row[f"{name}_{end}"] for end in ("low", "high"))
    of = "" if row[f"{name}_n"] == row["n"] else f" of {row[f'{name}_n']:.0f}"
    return f"{row[f'{name}_count']:.0f}{of} [{low:.0f}, {high:.0f}]"


def _number(value: float, form: str) -> str:
    return "-" if value != value else format(value, form)


def _source(asked: argparse.Namespace) -> str:
    origin, layouts = (
        provenance("cpu"),
        f"{asked.fresh} drawn layouts per family" if asked.fresh else "the public layouts",
    )
    return (
        f"Flown on {origin['date']} at commit {origin['commit']}, {layouts}, seed {asked.seed}, 95 % Wilson intervals "
        f"in percent; one thread per process, {origin['processor']}, shared and busy."
    )


if __name__ == "__main__":
    sys.exit(main())
