"""`torchgco-judge`: controls of any solver judged on the layouts of a file, and a leaderboard; see docs/referee.md."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.referee.board import Leaderboard, Scene, judged_page, leaderboard
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import MANIFEST, TRIALS
from torchgco.experiments.results.kinds import format_report, parts_of, write_tables
from torchgco.experiments.results.runs import MERGED
from torchgco.experiments.statistics.tables import OUTPUTS, aligned, csv_text, format_frame, rate

JUDGED, PAGE = "judged", "judged.html"  # default folder beside the controls, and the page in it
BOARD = "board"  # files of a leaderboard, in its folder: board.html, board.csv


def judge_files(
    layouts: Path, controls: Sequence[Path], words: Sequence[str] = (), best: Path | None = None, trust: bool = False
) -> pd.DataFrame:
    """The controls in some files as rows of a study's table, judged and certified on the layouts of a file.

    Args:
        words: as `Scene.read`; so `best` and `trust`.

    Raises:
        InputError: as `Scene.read` and `read_controls`, or solvers of the same name.
    """
    scene = Scene.read(layouts, words, best, trust)
    trials = scene.judged([solver for path in controls for solver in scene.controls(path, trust)])
    trials.attrs[MERGED] = [str(path) for path in controls]  # reports read it where its own folder is named
    return trials


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-judge`. Returns the exit code, see `ended`: 2, too, where an entry of a leaderboard is refused."""
    what = "Controls of any solver, judged on the layouts of a file; none of its code runs."
    parser = RunParser("torchgco-judge", what, "LAYOUTS CONTROLS")
    words = "LAYOUTS.npz, then files of controls, npz or CSV; also KEY=VALUE as torchgco takes them: model=planar"
    parser.add_argument("files", nargs="*", metavar="LAYOUTS CONTROLS", help=words)
    parser.add_argument("--best", metavar="FILE", type=Path, help="npz with best_cost (L,); default: the layouts' own")
    parser.add_argument("--board", metavar="FOLDER", type=Path, help="instead a leaderboard: layouts/ and entries/")
    parser.add_argument("--output", metavar="DIR", type=Path, help=f"default: {JUDGED} beside CONTROLS; FOLDER")
    parser.add_argument("--format", choices=OUTPUTS, default="table", help="of the tables on stdout; default: table")
    return parser.run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    words = [word for word in options.files if "=" in word and not Path(word).exists()]
    files = [Path(word) for word in options.files if word not in words]
    if options.board is not None:
        if files or options.best:
            raise InputError("--board", "a folder, and no files beside it", files[0] if files else options.best)
        return _board(options, words)
    if len(files) < 2:
        raise InputError(
            "LAYOUTS CONTROLS", "a file of layouts, and files of controls", " ".join(map(str, files)) or "none"
        )
    output = _folder(options.output or files[1].parent / JUDGED)
    trials = judge_files(files[0], files[1:], words, options.best, options.trust)
    parts = parts_of(trials)
    write(output / TRIALS, lambda file: trials.to_parquet(file, index=False))
    write_tables(output, parts)
    write(output / PAGE, lambda file: file.write(judged_page(trials).encode()))
    say(format_report(parts, options.format))
    _note(options, f"\nPage and tables: {output}")
    return 0


def _folder(path: Path) -> Path:
    """The folder to write to; InputError where it is a file, or holds a study, whose tables are kept."""
    if path.exists() and not path.is_dir():
        raise InputError("--output", "a folder", f"{path}, which is a file")
    if (path / MANIFEST).exists():
        raise InputError("--output", "a folder without the results of a study, which are kept", path)
    return path


def _board(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Judge a folder of entries; returns 2 where one is refused."""
    made = leaderboard(options.board, words, options.trust, lambda name: print(f"judging {name}", file=sys.stderr))
    output = _folder(options.output or options.board)
    write(output / f"{BOARD}.html", lambda file: file.write(made.html.encode()))
    write(output / f"{BOARD}.csv", lambda file: file.write(csv_text(made.table).encode()))
    say(_text(made) if options.format == "table" else format_frame(made.table, options.format))
    for what, error in made.refused.items():
        print(f"torchgco-judge: refused {what}: {error}", file=sys.stderr)
    _note(options, f"\nLeaderboard: {output / f'{BOARD}.html'}")
    return 2 if made.refused else 0


def _text(made: Leaderboard) -> str:
    """A line per layouts and entry."""
    rates = ("success", "reached", "feasible")
    lines = [[row["layouts"], row["entry"], *(rate(name)(row) for name in rates)] for _, row in made.table.iterrows()]
    return aligned([["layouts", "entry", *rates], *lines], 2)


def _note(options: argparse.Namespace, text: str) -> None:
    if options.format == "table":
        say(text)
    else:
        print(text.strip(), file=sys.stderr)
