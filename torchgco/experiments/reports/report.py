"""Reports on studies: tables, `summary.csv`, `paired.csv` and figures. `torchgco-report` is the command.

`torchgco-report DIR [DIR ...]` merges every `trials.parquet` below the folders, and the shards of studies that still
run, and reports on all of them together.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torchgco.base.errors import InputError
from torchgco.experiments.ending import ended, say
from torchgco.experiments.flying.progress import draw
from torchgco.experiments.reports.report_figures import Drawings, drawings
from torchgco.experiments.reports.verify import verify
from torchgco.experiments.reports.verify_text import confirmed_frame, confirmed_text, difference_texts
from torchgco.experiments.results.files import write
from torchgco.experiments.results.kinds import Part, parts_of, write_tables
from torchgco.experiments.results.merge import REPEATED, UNFINISHED, merge
from torchgco.experiments.results.records import MANIFEST, TRIALS
from torchgco.experiments.results.runs import is_merged, read_trials
from torchgco.experiments.statistics.formats import format_report
from torchgco.experiments.statistics.statistics import plain
from torchgco.experiments.statistics.tables import FORMATS, format_frame
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.style import save
from torchgco.scenarios.layouts import Layouts

Arrays = Mapping[str, np.ndarray]
# X (L, N+1, n) by solver, or a function that makes them from the arrays in layouts.npz and in solutions.npz.
Trajectories = Arrays | Callable[[Arrays, Arrays], Arrays]


def write_report(
    folder: str | os.PathLike[str],
    trajectories: Trajectories | None = None,
    form: str = "table",
    figures: bool = True,
) -> str:
    """Write `summary.csv`, `paired.csv` and `figures/*.png` next to the `trials.parquet` in a folder; return the table.

    trajectories  states for the picture of the layouts, which needs `layouts.npz` too: X (L, N+1, n) by
                  solver, in the order of that file; or a function of (layouts, solutions), the arrays of the two
                  files, that returns this (`solutions` is empty without `solutions.npz`). None: no such
                  picture.
    form          one of `tables.FORMATS`
    figures       False: tables alone

    Raises InputError if the table is missing, unreadable or empty, and where the trajectories don't fit the
    layouts.
    """
    folder = Path(folder)
    return _written(folder, read_trials(folder / TRIALS), trajectories, form, figures)


def _written(
    folder: Path, trials: pd.DataFrame, trajectories: Trajectories | None, form: str, figures: bool = True
) -> str:
    parts = parts_of(trials)
    write_tables(folder, parts)
    held = _figures(parts) if figures else {}
    if figures and trajectories is not None:
        layouts = Layouts.load(folder / "layouts.npz").arrays()
        states = trajectories(layouts, _solutions(folder / "solutions.npz")) if callable(trajectories) else trajectories
        held["layouts"] = lambda: layout_grid(layouts, states, trials)
    draw({name: partial(_draw, folder, name, figure) for name, figure in held.items()})
    return format_report(parts, form)


def _figures(parts: Sequence[Part]) -> Drawings:
    held: Drawings = {}
    for part in parts:
        held |= drawings(part)
    return held


def _draw(folder: Path, name: str, figure: Callable[[], Figure]) -> None:
    write(folder / "figures" / f"{name}.png", lambda file: save(figure(), file))


def _solutions(path: Path) -> Arrays:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as held:
        return dict(held)


class _Parser(argparse.ArgumentParser):
    """Without the usage before an error: one line for every mistake."""

    def error(self, message: str) -> NoReturn:
        raise InputError("command line", "DIR and the options of --help", message)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchgco-report", description="One report on many studies.")
    parser.add_argument("folders", nargs="*", metavar="DIR", type=Path, help="a study, or a folder of studies")
    parser.add_argument("--output", metavar="DIR", type=Path, help="default: 'report' in the first DIR")
    parser.add_argument("--format", choices=FORMATS, default="table", help="of the tables on stdout; default: table")
    parser.add_argument("--verify", action="store_true", help="confirm all rows and tables from the stored controls")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-report`. Returns the exit code: 1 where rows can't be confirmed, and as `ended`."""

    def work() -> int:
        options = _parser().parse_args(arguments)
        if not options.folders:
            raise InputError("DIR", "a study, or a folder of studies", "none")
        return _verify(options) if options.verify else _report(options)

    return ended("torchgco-report", work)


def _report(options: argparse.Namespace) -> int:
    output = options.output or options.folders[0] / "report"
    merged = merge(options.folders)
    if output.exists() and not output.is_dir():
        raise InputError("--output", "a folder", f"{output}, which is a file")
    is_study = (output / TRIALS).exists() and not is_merged(output / TRIALS)
    if is_study or (output / MANIFEST).exists():
        raise InputError("--output", "a folder without the results of a study, which are kept", output)
    text = [str(name) for name in merged.columns if isinstance(merged[name].dtype, pd.CategoricalDtype)]
    # Numbers hardly repeat: a dictionary of them would be given up after the time it takes.
    write(output / TRIALS, lambda file: plain(merged).to_parquet(file, index=False, use_dictionary=text))
    trials = merged.copy(deep=False)
    trials.attrs = {}  # pandas copies them for every table that it makes from this one
    say(_written(output, trials, None, options.format))
    repeated = merged.attrs[REPEATED]
    notes = [f"{repeated} rows left out: another run has the same flight, and each counts once"] if repeated else []
    for note in [*notes, f"written to {output}"]:
        if options.format == "table":
            say(f"\n{note}")
        else:
            print(note, file=sys.stderr)
    for note in merged.attrs[UNFINISHED]:
        print(f"unfinished: {note}", file=sys.stderr)
    return 0


def _verify(options: argparse.Namespace) -> int:
    """Print what was confirmed; returns 1 where anything differs."""
    studies, unfinished = verify(options.folders)
    for folder in unfinished:
        print(f"unfinished, not verified: {folder}", file=sys.stderr)
    if options.format == "table":
        say(confirmed_text(studies))
    else:
        say(format_frame(confirmed_frame(studies), options.format))
        print("".join(f"{line}\n" for line in difference_texts(studies)), end="", file=sys.stderr)
    return 1 if any(study.differs for study in studies) else 0
