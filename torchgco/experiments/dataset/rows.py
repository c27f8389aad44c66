"""A data set: solved trajectories as rows of parquet files, whose cells may be lists, and its README.

Any reader of parquet knows these, and rows of different lengths stand in one column.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from torchgco.base.errors import InputError, first_line
from torchgco.dynamics.names import controls_of, states_of
from torchgco.experiments.config.build import Setup
from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.tables import format_frame
from torchgco.problem.problem import Problem
from torchgco.scenarios.layouts import BOXES, GATES, IDS, SINES, SPHERES

if TYPE_CHECKING:
    from torchgco.experiments.flying.flight import Solved

FILE = re.compile(r"layouts-(\d+)-(\d+)\.parquet")  # the first and last layout of a file
ABOUT, MAP = "dataset.json", "map.npz"  # what a data set was made of; the map that all layouts share
OF_LAYOUT = (*SPHERES, *BOXES, *SINES, *GATES, "start", "goal", "best_cost")  # arrays with a row for each layout
MULTIPLIERS = "multipliers"  # before the number of a constraint


def nested(values: np.ndarray) -> pa.Array:
    """An array (B, ...) as B lists of lists of numbers, or B numbers."""
    column = pa.array(np.ascontiguousarray(values).reshape(-1))
    for axis in range(values.ndim - 1, 0, -1):
        ends = np.arange(np.prod(values.shape[:axis], dtype=int) + 1) * values.shape[axis]
        column = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), column)
    return column


def cells(column: pa.ChunkedArray) -> list[np.ndarray]:
    """What `nested` was made of, array by array."""
    level = column.combine_chunks()
    first, shapes = np.arange(len(level)), []
    while pa.types.is_list(level.type):
        lengths = np.append(level.value_lengths().to_numpy(zero_copy_only=False).astype(int), 0)
        shapes.append(lengths[np.minimum(first, len(lengths) - 1)])
        first = np.concatenate(([0], np.cumsum(lengths)))[first]
        level = level.flatten()
    values, sizes = level.to_numpy(zero_copy_only=False), np.prod(shapes, axis=0, dtype=int)
    parts = np.split(values, np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, np.transpose(shapes).tolist(), strict=True)]


def rows_of(solved: Solved, left_out: Sequence[str]) -> pa.Table:
    """The rows of layouts that were solved together, without some columns."""
    found, layouts = solved.solution.detach(), solved.task.layouts
    lost = ~np.isfinite(solved.U).all(axis=(1, 2))
    arrays = {"X": _double(found.X), "U": solved.U, "K": _double(found.K)}
    arrays["X"][lost] = np.nan
    arrays |= {} if solved.times is None else {"times": solved.times}
    lam = () if found.multipliers.blank or MULTIPLIERS in left_out else found.multipliers.lam
    arrays |= {f"{MULTIPLIERS}_{i}": _double(rows) for i, rows in enumerate(lam) if rows.shape[-1]}
    table = pa.Table.from_pandas(solved.rows, preserve_index=False).replace_schema_metadata(None)
    own = {*arrays, *OF_LAYOUT}  # others are the same for all layouts
    own |= {"map_occupied"} if layouts.map is not None and layouts.map.batch is not None else set()
    own |= {"stages"} if isinstance(layouts.stages, np.ndarray) else set()
    for name, value in {**arrays, **layouts.arrays()}.items():
        if name not in (*left_out, IDS):
            of_each = value if name in own else np.repeat(value[None], layouts.count, axis=0)
            table = table.append_column(name, nested(of_each))
    return table


def _double(values: Any) -> np.ndarray:
    return values.to("cpu").double().numpy().copy()


def files_of(folder: Path) -> dict[Path, range]:
    """The files of a data set with the layouts that each holds, in their order."""
    named = ((path, FILE.fullmatch(path.name)) for path in sorted(folder.glob("layouts-*.parquet")))
    return {path: range(int(match[1]), int(match[2]) + 1) for path, match in named if match}


def read_dataset(
    folder: str | os.PathLike[str], columns: Sequence[str] | None = None, layouts: Sequence[int] | None = None
) -> pd.DataFrame:
    """Rows of a data set that `torchgco-dataset` wrote, one per layout, with arrays in their shapes as cells.

        rows = torchgco.read_dataset("data", columns=["X", "U", "reached"], layouts=range(512))
        X = np.stack(rows.loc[rows["reached"], "X"])  # (B, N+1, n)

    Cells of one column may differ in shape: trajectories are as long as each layout's stages, and obstacles as many as
    the layout of the same file with the most, rows of NaN where a layout has fewer.

    Args:
        columns: which; None: all, with `layout` in any case. README.md in the folder says what each is.
        layouts: which, by number, in any order; rows have their own. None: all. Only files with some of them are read:
            a large data set is read in parts.

    Raises:
        InputError: no data set there, a damaged file, a column or layouts that it doesn't have.
    """
    files, asked = files_of(Path(folder)), None if layouts is None else np.asarray(layouts)
    if asked is not None and asked.size and asked.dtype.kind not in "iu":  # a mask would be read as layouts 0 and 1
        raise InputError("layouts", "whole numbers of layouts", f"numbers of type {asked.dtype}")
    if not files:
        raise InputError("folder", "a data set, with files such as layouts-000000000-000000511.parquet", folder)
    names = None if columns is None else list(dict.fromkeys(["layout", *columns]))
    parts = []
    for path, held in files.items():
        if asked is None or bool(((asked >= held.start) & (asked < held.stop)).any()):
            table = _read(path, names)
            whole = {name: cells(table[name]) if pa.types.is_list(table[name].type) else table[name].to_pandas()
                     for name in table.column_names}  # fmt: skip
            rows = pd.DataFrame(whole)
            parts.append(rows if asked is None else rows[rows["layout"].isin(asked)])
    table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame({"layout": []})
    if asked is not None and len(missing := np.setdiff1d(asked, table["layout"])):
        raise InputError("layouts", f"numbers of layouts in {folder}", missing[0])
    return table


def _read(path: Path, names: Sequence[str] | None) -> pa.Table:
    try:
        known = pq.read_schema(path).names
        if unknown := [name for name in names or () if name not in known]:
            raise InputError("columns", f"among {', '.join(known)}", unknown[0])
        return pq.ParquetFile(path).read(columns=names)
    except InputError:
        raise
    except Exception as error:  # damaged bytes make the reader raise nearly anything
        raise InputError("folder", "whole files", f"{path} ({first_line(error)})") from None


CARD = "README.md"
COUNTED = ["status", "feasible", "reached"]
MEANING = {
    "scenario": "family, or file", "seed": "of layouts and draws", "model": "see the configuration",
    "solver": "likewise", "device": "that computed", "dtype": "of the solve; numbers here are double",
    "version": "of torchgco", "kernels": "native: C; cuda: C on a GPU, too", "gates_passed": "in their order",
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
