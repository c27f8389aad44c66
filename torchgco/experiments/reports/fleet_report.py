"""Reports on finished studies of fleets: the tables of all studies, a row per vehicle, pictures and animations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from torchgco.experiments.flying.mission_flight import VEHICLES, vehicles_table
from torchgco.experiments.flying.progress import draw
from torchgco.experiments.reports.report import write_report
from torchgco.experiments.results.files import write
from torchgco.experiments.results.folder import SOLUTIONS
from torchgco.fleets.drawn import solution_of
from torchgco.fleets.solution import FleetSolution
from torchgco.plotting.fleets import fleet_animation, fleet_figure
from torchgco.plotting.style import save
from torchgco.scenarios import Layouts, Vehicle

SHOWN = 4  # fleets that get a picture and an animation, at most


def write_fleet_report(folder: Path, vehicle: Vehicle, layouts: Layouts, figures: bool = True) -> str:
    """Write vehicles.parquet, the tables and figures next to the `trials.parquet` in a folder; returns the table."""
    with np.load(folder / SOLUTIONS, allow_pickle=False) as flown:
        controls = dict(zip(flown["solver"].tolist(), flown["U"], strict=True))
    table = vehicles_table(vehicle, layouts, controls)
    write(folder / VEHICLES, lambda file: table.to_parquet(file, index=False))
    if figures:
        draw(_drawings(folder, vehicle, layouts.take(range(min(SHOWN, layouts.count))), controls))
    return write_report(folder, figures=figures)


def _drawings(
    folder: Path, vehicle: Vehicle, layouts: Layouts, controls: dict[str, np.ndarray]
) -> dict[str, Callable[[], object]]:
    """Functions that draw and write a picture and an animation of each fleet, by the solver under study."""
    to_draw, U = dict[str, Callable[[], object]](), next(iter(controls.values()))
    for place, number in enumerate(layouts.ids.tolist()):
        label, one = f"{layouts.name}-{number}", [place]
        found = solution_of(vehicle, layouts.take(one), U[one])
        to_draw[label] = partial(_picture, folder / "figures" / f"{label}.png", found)
        to_draw[f"{label}.gif"] = partial(fleet_animation, *found.arrays(), folder / "figures" / f"{label}.gif")
    return to_draw


def _picture(path: Path, found: FleetSolution) -> None:
    write(path, lambda file: save(fleet_figure(*found.arrays(), None), file, dpi=110))
