"""python -m benchmarks.paper: the paper's figures from runs of our solvers, Table A4, a table of missions, and our
settings against the paper's tables, line by line.

Figures, animations and tables go to `--outputs`, Table A4 and the missions also into the page. The page of
benchmarks/results/paper is benchmarks/results/paper.md; any other folder gets a copy of it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.lib import RESULTS
from benchmarks.lib.page import machine, origin, put_between
from benchmarks.paper import flights, missions, planar_figures, quadrotor_figures, tables
from benchmarks.paper.runs import Solve, planar, quadrotor
from torchgco.plotting.style import save

FOLDER, PAGE = RESULTS / "paper", RESULTS / "paper.md"
DPI = 110
ROUNDING = 5  # of the 255 shades of a colour
DRAWS = (0, 112)  # of the two trials: 112 passes below the circles, as few do
SOLVERS = ("al_ilqr", "gco_paper", "gco")  # of Figures 6 and 7
MARKS = "<!-- table-A4 -->", "<!-- end table-A4 -->"
MISSION_MARKS = "<!-- missions -->", "<!-- end missions -->"
TABLES = "tables.csv"
PARTS = ("tables", "planar", "quadrotor", "mission")


def planar_drawings(trials: Sequence[Solve], alone: Solve) -> dict[str, Callable[[], Figure]]:
    """What to draw of the planar problem, by the names of the files."""
    return {
        "figure-03": lambda: planar_figures.caught(alone, trials[0]),
        "figure-04": lambda: planar_figures.result(trials[0]),
        "figure-05": lambda: planar_figures.evolution(trials[0]),
        "figure-A1": lambda: planar_figures.distinct(trials),
        "figure-A2": lambda: planar_figures.histories(trials),
        "figure-A3": lambda: planar_figures.evolution(trials[1]),
    }


def quadrotor_drawings(solves: Sequence[Solve]) -> dict[str, Callable[[], Figure]]:
    """What to draw of the quadrotor's first plans, by the names of the files."""
    return {
        "figure-06": lambda: quadrotor_figures.plans(solves),
        "figure-07": lambda: quadrotor_figures.costs(solves),
    }


def write_table(trials: Sequence[Solve], outputs: Path, page: Path) -> None:
    """Table A4 as a file, and between its marks in the page."""
    rows = planar_figures.table(trials, DRAWS)
    outputs.mkdir(parents=True, exist_ok=True)
    rows.to_csv(outputs / "table-A4.csv", index=False)
    put_between(page, *MARKS, f"{_head()}\n\n{planar_figures.markdown(rows)}")


def fly(outputs: Path, page: Path, duration: float) -> dict[str, Callable[[], Figure]]:
    """Fly the missions, write their table, some rows into the page, and the animations; what to draw of them."""
    flown = flights.fly(duration=duration)
    rows = missions.table(flown)
    outputs.mkdir(parents=True, exist_ok=True)
    rows.to_csv(outputs / "missions.csv", index_label="quantity")
    put_between(page, *MISSION_MARKS, f"{_head()}\n\n{missions.markdown(rows.loc[[*missions.SHOWN]])}")
    missions.animate(flown, outputs)
    return missions.figures(flown)


def page_of(outputs: Path) -> Path:
    """The page that shows the pictures of a folder; a new copy with its own links, but for that of the results."""
    if outputs.resolve() == FOLDER:
        return PAGE
    outputs.mkdir(parents=True, exist_ok=True)
    page = outputs / PAGE.name
    page.write_text(PAGE.read_text().replace(f"]({FOLDER.name}/", "]("))
    return page


def _head() -> str:
    return f"{origin('Measured')}, {machine()}."


def write_picture(figure: Figure, path: Path) -> None:
    """A PNG in colours rounded to multiples of `ROUNDING`: invisible, and two thirds as large."""
    save(figure, path, DPI)
    with Image.open(path) as picture:
        values = np.asarray(picture.convert("RGB"))
    Image.fromarray((np.round(values / ROUNDING) * ROUNDING).astype(np.uint8)).save(path, optimize=True)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description="Draw the figures of paper.md.")
    parser.add_argument("--outputs", type=Path, default=FOLDER)
    parser.add_argument("--page", type=Path, help="where the tables go; by default the page of --outputs")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS, help="by default all")
    parser.add_argument("--stages", type=int, default=1000, help="of the planar problem; the paper has 1000")
    parser.add_argument("--duration", type=float, default=15.0, help="of the missions at most, s")
    asked = parser.parse_args(words)
    page = asked.page or page_of(asked.outputs)
    drawings: dict[str, Callable[[], Figure]] = {}
    if "tables" in asked.parts:
        asked.outputs.mkdir(parents=True, exist_ok=True)
        tables.frame(tables.tables()).to_csv(asked.outputs / TABLES, index=False)
    if "planar" in asked.parts:
        trials = [planar("gco_paper", number, asked.stages) for number in DRAWS]
        drawings |= planar_drawings(trials, planar("al_ilqr", 0, asked.stages))
        write_table(trials, asked.outputs, page)
    if "quadrotor" in asked.parts:
        drawings |= quadrotor_drawings([quadrotor(name) for name in SOLVERS])
    if "mission" in asked.parts:
        drawings |= fly(asked.outputs, page, asked.duration)
    for name, make in drawings.items():
        write_picture(make(), asked.outputs / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
