"""Rows that are kept in a CSV file as they are measured: a run that was stopped goes on behind them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd


def rows_of(file: Path, columns: Sequence[str]) -> pd.DataFrame:
    """The kept rows; none where there is no file."""
    return pd.read_csv(file) if file.is_file() else pd.DataFrame(columns=pd.Index(columns))


def append(file: Path, columns: Sequence[str], row: dict[str, Any]) -> None:
    """Add a row to the file, which is complete again when this returns."""
    pd.DataFrame([row], columns=list(columns)).to_csv(file, mode="a", header=not file.is_file(), index=False)
