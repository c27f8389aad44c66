"""Reports on studies: tables, `summary.csv`, `paired.csv` and figures. `torchgco-report` is the command.

`torchgco-report DIR [DIR ...]` merges every `trials.parquet` below the folders, and the shards of studies that still
run, and reports on all of them together.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torchgco.errors import InputError
from torchgco.experiments.files import say, write
from torchgco.experiments.merge import OLDER, REPEATED, UNFINISHED, merge
from torchgco.experiments.paired import compare
from torchgco.experiments.power import power_table
from torchgco.experiments.records import MANIFEST, TRIALS
from torchgco.experiments.runs import is_merged, read_trials
from torchgco.experiments.statistics import TASK, plain, summarise, task_columns
from torchgco.experiments.tables import FORMATS, aligned, format_frame, format_report
from torchgco.experiments.verify import Verification, unconfirmed, verify
from torchgco.interrupts import REPORT, farewell, raised
from torchgco.plotting.distributions import clearance_histogram, violation_histogram
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.rates import rates_figure
from torchgco.plotting.style import save
from torchgco.plotting.sweeps import sweep_figure
from torchgco.scenarios.layouts import Layouts

Arrays = Mapping[str, np.ndarray]
# X (L, N+1, n) by solver, or a function that makes them from the arrays in layouts.npz and in solutions.npz.
Trajectories = Arrays | Callable[[Arrays, Arrays], Arrays]
FACETS = 6  # most tasks that have panels of their own; more are pooled over the swept variables
DIFFERENT = 10  # differing values that `--verify` prints per study


def write_report(folder: str | os.PathLike[str], trajectories: Trajectories | None = None, form: str = "table") -> str:
    """Write `summary.csv`, `paired.csv` and `figures/*.png` next to the `trials.parquet` in a folder; return the table.

    trajectories  states for the picture of the layouts, which needs `layouts.npz` too: X (L, N+1, n) by
                  solver, in the order of that file; or a function of (layouts, solutions), the arrays of the two
                  files, that returns this (`solutions` is empty without `solutions.npz`). None: no such
                  picture.
    form          one of `tables.FORMATS`

    Raises InputError if the table is missing, unreadable or empty, and where the trajectories don't fit the
    layouts.
    """
    folder = Path(folder)
    return _written(folder, read_trials(folder / TRIALS), trajectories, form)


def _written(folder: Path, trials: pd.DataFrame, trajectories: Trajectories | None, form: str) -> str:
    summary, paired = summarise(trials), compare(trials)
    for name, table in (("summary", summary), ("paired", paired)):
        if name == "summary" or len(table):
            write(folder / f"{name}.csv", lambda file, table=table: table.to_csv(file, index=False))
    figures = _figures(trials, summary)
    if trajectories is not None:
        layouts = Layouts.load(folder / "layouts.npz").arrays()
        if callable(trajectories):
            trajectories = trajectories(layouts, _solutions(folder / "solutions.npz"))
        figures["layouts"] = layout_grid(layouts, trajectories, trials)
    for name, figure in figures.items():
        write(folder / "figures" / f"{name}.png", lambda file, figure=figure: save(figure, file))
    return format_report(summary, paired, form)


def _figures(trials: pd.DataFrame, summary: pd.DataFrame) -> dict[str, Figure]:
    """Figures by name: rates against every swept variable, then rates and distributions of each task."""
    swept = task_columns(trials)[len(TASK) :]
    figures = {}
    for name in swept:
        others = [other for other in swept if other != name]
        rows, table = trials[trials[name].notna()], summary[summary[name].notna()]
        if len(table[[*TASK, *others]].drop_duplicates()) > FACETS:
            table = summarise(rows.drop(columns=others))
        figures[f"rates-{name}"] = sweep_figure(table, name)
    if len(summary[[*TASK, *swept]].drop_duplicates()) > FACETS:
        trials = trials.drop(columns=swept)
        summary = summarise(trials)
    figures["rates"] = rates_figure(summary)
    return figures | {"clearance": clearance_histogram(trials), "violation": violation_histogram(trials)}


def _solutions(path: Path) -> Arrays:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as held:
        return dict(held)


def _notes(trials: pd.DataFrame) -> list[str]:
    """What a reader of a merged table should know."""
    notes = []
    if repeated := trials.attrs.get(REPEATED, 0):
        notes.append(f"{repeated} rows left out: another run has the same flight, and each counts once")
    if older := trials.attrs.get(OLDER, []):
        notes.append(f"of an older version, distinguished by configuration and results alone: {', '.join(older)}")
    return notes


class _Parser(argparse.ArgumentParser):
    """Without the usage before an error: one line for every mistake."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message} (--help lists the options)", file=sys.stderr)
        sys.exit(2)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchgco-report", description="One report on many studies.")
    parser.add_argument("folders", nargs="*", metavar="DIR", type=Path, help="a study, or a folder of studies")
    parser.add_argument("--output", metavar="DIR", type=Path, help="default: 'report' in the first DIR")
    parser.add_argument("--format", choices=FORMATS, default="table", help="of the tables on stdout; default: table")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--verify", action="store_true", help="confirm all rows from the stored controls instead")
    other.add_argument(
        "--power", nargs=2, type=float, metavar="RATE", help="instead: layouts that tell two success rates apart"
    )
    parser.add_argument("--level", type=float, default=0.05, metavar="P", help="of --power's test; default: 0.05")
    parser.add_argument("--power-target", type=float, default=0.8, metavar="P", help="of --power; default: 0.8")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-report`. Returns the exit code: 2 for malformed input, 1 where rows can't be confirmed."""
    options = _parser().parse_args(arguments)
    try:
        if not options.folders and options.power is None:
            raise InputError("DIR", "a study, or a folder of studies", "none")
        with raised():
            if options.power is not None:
                return _power(options)
            return _verify(options.folders) if options.verify else _report(options)
    except InputError as error:
        print(f"torchgco-report: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        return farewell(error, REPORT)


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
    for note in [*_notes(merged), f"written to {output}"]:
        if options.format == "table":
            say(f"\n{note}")
        else:
            print(note, file=sys.stderr)
    for note in merged.attrs[UNFINISHED]:
        print(f"unfinished: {note}", file=sys.stderr)
    return 0


def _power(options: argparse.Namespace) -> int:
    trials = merge(options.folders) if options.folders else None
    rate_a, rate_b = options.power
    table = power_table(rate_a, rate_b, options.level, options.power_target, trials)
    if options.format not in ("csv", "json"):
        table = table.assign(
            discordant=table["discordant"].map(lambda share: "-" if np.isnan(share) else f"{share:.1%}"),
            power=table["power"].map("{:.3f}".format),
        )
    say(format_frame(table, options.format))
    return 0


def _verify(folders: Sequence[Path]) -> int:
    """Print what was confirmed; returns 1 where anything differs."""
    studies, unfinished = verify(folders)
    for folder in unfinished:
        print(f"unfinished, not verified: {folder}", file=sys.stderr)
    differing = [study for study in studies if len(study.differences)]
    for study in differing:
        say(_difference(study))
    right = [study for study in studies if study.differences.empty]
    where = f" in {len(right)} studies" if len(right) > 1 else ""
    say(f"{sum(study.rows for study in right)} rows confirmed{where}")
    columns = dict.fromkeys((study.columns, tuple(unconfirmed(study).items())) for study in right)
    for confirmed, more in columns:
        say(f"  columns: {', '.join(confirmed)}")
        for names, reason in more:
            say(f"  not confirmed: {names} ({reason})")
    return 1 if differing else 0


def _difference(study: Verification) -> str:
    rows = [[str(value) for value in row] for row in study.differences.head(DIFFERENT).to_numpy().tolist()]
    lines = [f"{study.folder}: {len(study.differences)} values differ in {study.rows} rows"]
    lines.append(aligned([list(study.differences.columns), *rows], 1))
    more = len(study.differences) - len(rows)
    return "\n".join([*lines, *([f"... and {more} more"] if more else [])])
