"""Success: the one outcome that depends on other rows, through the best cost known of a layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from torchgco.experiments.results.folder import COLUMNS
from torchgco.judging.judge import near_best
from torchgco.scenarios import Layouts


def judged(rows: pd.DataFrame, best: pd.Series, rivals: pd.Series, layout: Sequence[str]) -> pd.DataFrame:
    """The rows with `best_cost`, `best_from` ("file" or "study") and `success`.

    Args:
        rows: with columns cost and reached.
        best: best cost of the layout's file, by row; NaN where there is none.
        rivals: by row, whether several solvers flew the layout; then the cheapest that reached replaces a missing
            `best`.
        layout: columns that name a layout.

    Where no best cost is known (a single solver, none in the file) success is NA.
    """
    reached = rows["reached"].astype(bool)
    cheapest = rows.assign(_cost=rows["cost"].where(reached)).groupby(list(layout), dropna=False)["_cost"]
    filled = best.where(best.notna() | ~rivals, cheapest.transform("min")).astype(float)
    source = pd.Series(None, index=rows.index, dtype=object).mask(rivals, "study").mask(best.notna(), "file")
    success = (reached & near_best(rows["cost"], filled)).astype("boolean")
    return rows.assign(best_cost=filled, success=success.where(source.notna(), pd.NA), best_from=source)


def with_success(rows: pd.DataFrame, layouts: Layouts | None, solvers: int) -> pd.DataFrame:
    """The rows of a study in its columns, with `best_cost` and `success`.

    The best cost is that of the layouts' file, else the best of the study where at least two solvers flew.
    """
    best = pd.Series(np.nan, index=rows.index)
    if layouts is not None and layouts.best_cost is not None:
        best = rows["layout"].map(dict(zip(layouts.ids.tolist(), layouts.best_cost, strict=True))).astype(float)
    rivals = pd.Series(solvers > 1, index=rows.index)
    more = [name for name in rows.columns if name not in COLUMNS]
    return judged(rows, best, rivals, ["layout"]).reindex(columns=[*COLUMNS, *more])
