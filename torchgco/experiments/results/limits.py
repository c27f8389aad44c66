"""Reads files of a run, which comes from anybody: a small file can promise any size.

What a file takes when it is read is known before it is read, from its own headers; where these can lie, memory is
limited while it is read. `trust` admits any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.compute
import pyarrow.parquet

from torchgco.base.errors import InputError
from torchgco.base.files import npz_size, regular
from torchgco.base.memory import limited
from torchgco.missions.outcome import STATES
from torchgco.scenarios import Layouts, Vehicle

LARGEST_FILE = 2**30  # bytes of one file when it is read; the files of 10,000 layouts and ten solvers take a third
LOG_COLUMNS = (
    "mission", "step", "cost", "violation", "clearance", "planner_seconds", "tracker_seconds", "tracking_violation",
    "guided",
)  # fmt: skip
NUMBER_BYTES = 8  # bytes of a number in a table
FILE_LIMIT = "that a run's file may take (--trust admits more)"


def read_npz(path: Path, trust: bool = False) -> dict[str, np.ndarray]:
    """The arrays in a run's npz file.

    Raises:
        InputError: they take more than they may.
        Exception: nearly any, where the file is damaged.
    """
    with open(regular(path), "rb") as file:
        if not trust and (size := npz_size(file)) > LARGEST_FILE:
            refuse(path, f"arrays of {size / 1e9:.3g} GB")
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


def read_layouts(path: Path, trust: bool = False) -> Layouts:
    """The layouts of a run, with the distances of their map.

    Raises InputError as `Layouts.load`, or where they take more than they may.
    """
    if trust:
        return Layouts.load(path)
    try:
        with limited(LARGEST_FILE):
            return Layouts.load(path, room=LARGEST_FILE, limit=FILE_LIMIT)
    except MemoryError:  # distances take a multiple of a map's cells, and any multiple of its points
        refuse(path, "a map that takes more")


def read_table(path: Path, trust: bool = False, **options: Any) -> pd.DataFrame:
    """The table in a run's parquet file: columns of numbers, texts and truths, each of its own name.

    Raises:
        InputError: it takes more than it may.
        Exception: nearly any, where the file is damaged or has other columns.
    """
    regular(path)
    if trust:
        return _table(path, options)
    try:
        with _counted(), limited(LARGEST_FILE):
            return _table(path, options)
    except MemoryError:  # many cells, a page that is longer than its headers say, or a text in many rows
        refuse(path, "a table that takes more")


def read_log(path: Path, trust: bool = False) -> pd.DataFrame:
    """The log of a study of missions, a row per control step: numbers, but for `solver` and `source`.

    Raises:
        InputError: it takes more than it may.
        Exception: nearly any, where the file is damaged or no such log.
    """
    log = read_table(path, trust)
    for name in ("solver", "source", *LOG_COLUMNS, *(f"x{i}" for i in range(STATES))):
        if name not in log.columns:
            raise ValueError(f"no column {name}")
    for name, column in log.items():
        if name not in ("solver", "source") and not pd.api.types.is_numeric_dtype(column):
            raise ValueError(f"no numbers in column {name}")
    if not log["step"].between(0, len(log) - 1).all():
        raise ValueError("a step beyond its rows")
    return log


def check_stages(folder: Path, vehicle: Vehicle, layouts: Layouts, most: int) -> None:
    """Check that `most` trajectories of a run, which are simulated at once, take no more than they may.

    Raises:
        InputError: they do.
    """
    count, stages = min(most, layouts.count), vehicle.stages if layouts.stages is None else int(np.max(layouts.stages))
    size = count * stages * (vehicle.dynamics.n + vehicle.dynamics.m) * (layouts.vehicles or 1) * NUMBER_BYTES
    if size > LARGEST_FILE:
        refuse(folder, f"{count} trajectories of {stages} stages, {size / 1e9:.3g} GB")


def refuse(path: Path, got: str, field: str = "RUN") -> NoReturn:
    raise InputError(field, f"at most the {LARGEST_FILE / 1e9:.3g} GB {FILE_LIMIT}", f"{path} with {got}")


@contextmanager
def _counted() -> Iterator[None]:
    """In this block Arrow takes memory from the system as it needs it.

    Its own pool takes a GiB of addresses at once: before the block, as few parts of Arrow know no other pool.
    """
    usual = pyarrow.default_memory_pool()
    pyarrow.allocate_buffer(1, memory_pool=usual)
    pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    try:
        yield
    finally:
        pyarrow.set_memory_pool(usual)


def _table(path: Path, options: Mapping[str, Any]) -> pd.DataFrame:
    schema = pyarrow.parquet.read_schema(path)
    for field in schema:
        if pyarrow.types.is_nested(field.type) or schema.names.count(field.name) > 1:
            raise ValueError(f"column {field.name} of {field.type}")
    # Most tables are small: threads cost more than they save.
    return pd.read_parquet(path, use_threads=False, **options)
