"""Comparison of studies that were flown in different ways."""

from pathlib import Path

import numpy as np
import pandas as pd

HOW = "seconds|batch_size|threads|deadline"  # columns that describe how a trial was flown


def results(folder: Path) -> dict[str, list[pd.DataFrame]]:
    """Trials, and controls or logs of missions, of the studies below a folder, by the names of their folders."""
    found = {}
    for path in sorted(folder.rglob("trials.parquet")):
        log = path.parent / "mission.parquet"
        if log.is_file():
            flown = pd.read_parquet(log)
        else:
            with np.load(path.parent / "solutions.npz") as held:
                flown = pd.DataFrame(held["U"].reshape(len(held["U"]), -1))
        tables = pd.read_parquet(path), flown
        found[path.parent.name] = [table.loc[:, ~table.columns.astype(str).str.contains(HOW)] for table in tables]
    return found


def same(one: Path, other: Path, studies: int = 1) -> None:
    """Assert that the same studies lie below two folders, with equal bits."""
    left, right = results(one), results(other)
    assert len(left) == studies and left.keys() == right.keys()
    for name, tables in left.items():
        for table, other_table in zip(tables, right[name], strict=True):
            pd.testing.assert_frame_equal(table, other_table, check_exact=True)
