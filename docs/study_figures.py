"""python docs/study_figures.py: the pictures of docs/studies.md, as the commands on that page write them.

A Chromium draws the page of a study; where there is none, that picture is left as it is, and a line says so.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from benchmarks.lib.studies import torchgco
from benchmarks.picture import take
from torchgco.experiments.reports.report import main as report

FIGURES = Path(__file__).resolve().parent / "figures"
SHOWN, SWEPT = 6, 16  # layouts of the study and of each study of the sweep
WIDTH, COLOURS = 1000, 128  # pixels, and colours that a picture is reduced to: it takes a fifth of the bytes
PAGE = (1000, 620)


def draw(output: Path, shown: int = SHOWN, swept: int = SWEPT) -> None:
    """Fly the studies, and write study-layouts.png, study-page.png and study-sweep.png."""
    with tempfile.TemporaryDirectory() as folder:
        run, sweep = Path(folder) / "run", Path(folder) / "sweep"
        torchgco(f"study.layouts={shown}", "study.view=true", f"hydra.run.dir={run}")
        reduce(run / "figures" / "layouts.png", output / "study-layouts.png")
        try:
            take(run / "view.html", "layout=2", Path(folder) / "page.png", PAGE)
            reduce(Path(folder) / "page.png", output / "study-page.png")
        except FileNotFoundError as error:
            print(f"study-page.png is left as it is: {error}", file=sys.stderr)
        obstacles = "scenario.num_obstacles=10,30,60"
        torchgco("-m", obstacles, f"study.layouts={swept}", "study.figures=false", f"hydra.sweep.dir={sweep}")
        report([str(sweep), "--format", "csv"])
        (drawn,) = (sweep / "report" / "figures").glob("rates-*.png")
        reduce(drawn, output / "study-sweep.png")


def reduce(picture: Path, output: Path) -> None:
    """Write a smaller copy of a picture."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(picture) as whole:
        size = (WIDTH, round(WIDTH * whole.height / whole.width))
        small = whole.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    small.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(output, optimize=True)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python docs/study_figures.py", description="Draw the pictures of studies.md."
    )
    parser.add_argument("--output", type=Path, default=FIGURES)
    parser.add_argument("--layouts", type=int, nargs=2, default=(SHOWN, SWEPT), help="of the study, of the sweep's")
    options = parser.parse_args(words)
    draw(options.output, *options.layouts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
