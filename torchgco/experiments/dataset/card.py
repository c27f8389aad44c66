"""README.md of a data set: what it holds, of which commit and configuration, in which columns and units."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from torchgco.dynamics.names import controls_of, states_of
from torchgco.experiments.config.build import Setup
from torchgco.experiments.dataset.rows import MAP, MULTIPLIERS, cells, files_of
from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.tables import format_frame
from torchgco.problem.problem import Problem

CARD = "README.md"
COUNTED = ["status", "feasible", "reached"]
MEANING = {
    "scenario": "family, or file", "seed": "of layouts and draws", "model": "see the configuration",
    "solver": "likewise", "device": "that computed", "dtype": "of the solve; numbers here are double",
    "version": "of torchgco", "kernels": "native: C", "gates_passed": "in their order",
    "violation_between": "within stages, of rows kept at knots alone", "box_amplitudes": "m, of sines",
    "box_rates": "rad/s", "box_phases": "rad", "goal_required": "whether the goal is a constraint",
    "map_origin": "m", "map_resolution": "m, a cell", "map_unknown": "what unknown cells count as",
    "map_points": "m", "map_radius": "m, of points",
    "layout": "number of the layout, under the seed", "status": "how the solve ended",
    "feasible": "violation at most 1e-3, and clear between the knots, too", "reached": "feasible, and at the goal",
    "clear_95": "the paper's notion of feasible", "cost": "of all stages and the end", "violation": "m for lengths",
    "clearance": "m, to contact, between the knots, too", "clearance_knots": "m, at the knots",
    "goal_distance": "m, of the last position", "duration": "s", "dynamics_residual": "of X to a step of the model",
    "clearance_full": "m, to the full radii", "bound_violation": "in the units of the bounds",
    "kkt_residual": "0 at a stationary point", "step_error": "share of a state's range, by the step's length",
    "step_cost": "share of the cost, by the step's length", "iterations": "of all solves made for the layout",
    "seconds": "s, of a batch divided by its layouts", "threads": "that solved it", "batch_size": "solved together",
    "layout_digest": "equal for equal layouts, as in studies", "U": "controls, held over each stage",
    "X": "states at the knots", "K": "feedback: u = U + K (x - X)", "times": "s, of the knots",
    "centers": "m, of spheres; NaN: none", "radii": "m", "velocities": "m/s", "start": "state", "goal": "state",
    "vehicle_radius": "m", "goal_radius": "m", "dt": "s, a stage", "stages": "N", "best_cost": "the least known",
    "box_centers": "m; NaN: none", "box_half_sizes": "m", "box_rotations": "rad, or quaternions w x y z",
    "box_radii": "m, of rounding", "gate_centers": "m; NaN: none", "gate_radii": "m", "map_occupied": "cells",
    "free_time": "least and most length of a stage by dt, cost of a second", "outer_iterations": "of the solver",
    "guided": "outer iterations with guidance", "control_lower": "least controls", "control_upper": "most controls",
}  # fmt: skip


def write_card(folder: Path, setup: Setup, problem: Problem, count: int, made: Mapping[str, Any], license: str) -> None:
    """Write the card of a data set of `count` layouts, from the files that are there.

    Args:
        problem: of one of its layouts.
        made: version and commit, as `provenance.source` tells them, and the command.
        license: an identifier, such as CC-BY-4.0.
    """
    files = files_of(folder)
    tables = [pq.ParquetFile(path).read(columns=COUNTED).to_pandas() for path in files]
    rows = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COUNTED)
    names = {key: setup.configuration[group].get("name") for key, group in (("solver", "solver"), ("device", "device"))}
    scenario, model = setup.scenario.name, setup.vehicle.name
    changed = ", with changes" if made.get("changed") else ""
    about = {
        "rows": f"{len(rows)} of {count} layouts", "scenario": scenario, "model": model, **names, "seed": setup.seed,
        "made by": f"`{made['command']}`", "torchgco": f"{made['version']}, commit {made['commit'] or '-'}{changed}",
        "license": license, "configuration": "dataset.json, in full",
    }  # fmt: skip
    counts = rows.groupby("status")[["feasible", "reached"]].agg(["size", "sum"]) if len(rows) else pd.DataFrame()
    counts = pd.DataFrame(
        [
            (status, row["feasible", "size"], row["feasible", "sum"], row["reached", "sum"])
            for status, row in counts.iterrows()
        ],
        columns=["status", "rows", "feasible", "reached"],
    )
    parts = [
        f"---\nlicense: {json.dumps(license)}\n---\n# {scenario} ({model}), solved by {names['solver']}",
        "\n".join(f"- {name}: {value}" for name, value in about.items()),
        "## Counts", format_frame(counts, "markdown"), "## Columns",
        format_frame(_columns(next(iter(files), None), problem), "markdown"),
        f'`torchgco.read_dataset(folder, columns=["X", "U"], layouts=range(512))` reads them in their shapes.'
        f"{f' All layouts share {MAP}.' if (folder / MAP).is_file() else ''}",
    ]  # fmt: skip
    write(folder / CARD, lambda file: file.write(("\n\n".join(parts) + "\n").encode()))


def _columns(path: Path | None, problem: Problem) -> pd.DataFrame:
    """A row per column of a file: its type, the shape of its first cell, and what it is."""
    heads = ["column", "type", "shape of the first", "meaning"]
    if path is None:
        return pd.DataFrame(columns=heads)
    table = next(pq.ParquetFile(path).iter_batches(1))
    columns = [pa.chunked_array([column]) for column in table.columns]
    lists = [pa.types.is_list(column.type) for column in columns]
    shapes = [str(cells(column)[0].shape) if whole else "" for column, whole in zip(columns, lists, strict=True)]
    kinds = ["double" if whole else str(column.type) for column, whole in zip(columns, lists, strict=True)]
    meanings = [_meaning(name, problem) for name in table.schema.names]
    return pd.DataFrame(zip(table.schema.names, kinds, shapes, meanings, strict=True), columns=heads)


def _meaning(name: str, problem: Problem) -> str:
    if name.startswith(MULTIPLIERS):
        constraint = problem.constraints[int(name.rpartition("_")[2])]
        knots = np.arange(problem.N + 1)[constraint.knots]
        return f"of {type(constraint).__name__}, knots {knots[0]} to {knots[-1]} by rows"
    units = {"X": states_of, "U": controls_of}.get(name, lambda _: [])(problem.dynamics)
    labels = ", ".join(quantity.label for quantity in units)
    return MEANING.get(name, "a metric of the configuration") + (f": {labels}" if labels else "")
