"""Solved trajectories as rows of parquet files, in which an array of a row is a list, of lists where it has more axes.

Any reader of parquet knows these, and rows of different lengths stand in one column.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from torchgco.base.errors import InputError, first_line
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
