"""python -m benchmarks.families.transition: how often the goal is reached in woods, by density and speed.

A Hydra sweep of density against horizon: the faster the vehicle must fly, the sparser the woods that it can cross.
With --write the figure and the table go into benchmarks/results.
"""

from __future__ import annotations

import math
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.page import cells_of, chosen, filed, machine, markdown, origin, put
from benchmarks.lib.studies import torchgco
from torchgco.experiments.results.merge import merge
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting.style import INK, SMALL, legend, panels, save, solver_colours, tidy
from torchgco.scenarios import Woods

DENSITIES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
STAGES = (80, 120, 160, 240)
SOLVERS = ("gco", "gco_paper", "al_ilqr")
PEERS = ("fatrop",)  # takes up to a minute per problem: fewer layouts, and only the sparser woods
PEER_DENSITIES, PEER_LAYOUTS = DENSITIES[:4], 4
DENSITY, HORIZON = "scenario.density", "scenario.stages"
# Discs of one radius r at random in the plane leave no way through, in the limit of a large region, from
# density * pi r^2 = 1.128 on (Quintanilla and Ziff, Physical Review E 76, 051115, 2007).
COVERED = 1.128


def main(words: Sequence[str] | None = None) -> int:
    parser = _parser()
    asked = parser.parse_args(words)
    if not asked.solvers and not asked.outputs.is_dir():
        parser.error(f"--outputs: expected a folder with flights, got {asked.outputs}")
    for solver in asked.solvers:
        sweep(solver, asked)
    summary = summarise(merge([asked.outputs]))
    print(table(summary))
    if asked.write:
        save(figure(summary), RESULTS / "transition.png")
        head = (
            f"{origin('Flown')}, n layouts per point, seed {asked.seed}; 95 % Wilson intervals in the figure; "
            f"{machine()}."
        )
        put(RESULTS / "transition.md", "transition", f"{head}\n\n![Rates](transition.png)\n\n{short(table(summary))}")
    return 0


def sweep(solver: str, asked: Namespace) -> None:
    """Fly one solver at all densities and speeds, in a folder of its own; what is there already isn't flown again."""
    peer = solver in PEERS
    densities, layouts = (PEER_DENSITIES, PEER_LAYOUTS) if peer else (DENSITIES, asked.layouts)
    torchgco(
        "-m", "scenario=woods", f"{DENSITY}={','.join(map(str, densities))}",
        f"{HORIZON}={','.join(map(str, STAGES))}", f"solver={solver}", "study.baselines=[]", "device.threads=1",
        f"study.layouts={layouts}", f"seed={asked.seed}", f"hydra.sweep.dir={asked.outputs / solver}",
    )  # fmt: skip


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "results")
    parser.add_argument("--layouts", type=int, default=32, metavar="N", help="per density and speed")
    parser.add_argument(
        "--solvers", nargs="*", default=[*SOLVERS, *PEERS], metavar="NAME", help="to fly; none: only table and figure"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the layouts")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "transition")
    return parser


def speed(stages: float) -> float:
    """Mean speed on the straight line, from the start to the goal within the horizon, m/s."""
    woods = Woods(stages=int(stages))
    return math.dist(woods.start, woods.goal) / (woods.stages * woods.dt)


def threshold() -> float:
    """The density (per m^2) above which a large wood is closed for the vehicle, by the mean square of the radii."""
    woods = Woods()
    low, high = (radius + woods.vehicle_radius for radius in woods.radii)
    return COVERED / (math.pi * (low * low + low * high + high * high) / 3)


def figure(summary: pd.DataFrame) -> Figure:
    """Rates of reached layouts against density: a panel per speed, a line with its interval per solver."""
    held = sorted(summary[HORIZON].unique())
    picture, axes = panels(len(held), len(held), (3.0, 2.8), share=True)
    colours = solver_colours(summary["solver"])
    for ax, stages in zip(axes, held, strict=True):
        for name, rows in summary[summary[HORIZON] == stages].groupby("solver", sort=False):
            rows = rows.sort_values(DENSITY)
            x, rate = rows[DENSITY].to_numpy(dtype=float), rows["reached_rate"].to_numpy(dtype=float)
            ax.fill_between(x, rows["reached_low"], rows["reached_high"], color=colours[name], alpha=0.15, linewidth=0)
            ax.plot(x, rate, color=colours[name], marker="o", markersize=3)
        ax.axvline(threshold(), color=INK, linestyle=":", linewidth=1)
        ax.set_ylim(-0.02, 1.02)
        ax.set_xlabel("trunks per m²")
        tidy(ax, f"{speed(stages):.1f} m/s ({stages * Woods().dt:g} s)")
    axes[0].set_ylabel("reached, 95 % interval")
    axes[0].text(threshold(), 0.02, "closed ", ha="right", fontsize=SMALL, color=INK)
    legend(picture, [Line2D([], [], color=colour, marker="o", label=name) for name, colour in colours.items()])
    return picture


def table(summary: pd.DataFrame) -> str:
    """Markdown: reached, of n, by density; a row per speed and solver."""
    rows = []
    for (stages, solver), own in summary.groupby([HORIZON, "solver"], sort=False):
        found = own.set_index(DENSITY)["reached_count"]
        counts = (found.get(density, "-") for density in DENSITIES)
        rows.append([f"{speed(stages):.1f} m/s", f"`{solver}`", own["n"].iloc[0], *counts])
    return markdown(["speed", "solver", "n", *(f"{density:g}" for density in DENSITIES)], rows)


def short(table: str) -> str:
    """The table as a file, and the rows of `gco`."""
    speed, _, _, *densities = cells_of(table)[0]
    return filed("transition", table, chosen(table, [speed, *densities], solver=("`gco`",)))


if __name__ == "__main__":
    sys.exit(main())
