"""Rates with their intervals, costs and effort, counted from a table of trials.

A trial is one solver on one layout, a row of `trials.parquet`. Nothing is left out of a count silently: a trial
whose start was invalid is a failure, an outcome that isn't defined is subtracted from a denominator that
is given with the rate, and a violation that isn't a number counts as infinite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from torchgco.base.errors import InputError
from torchgco.base.status import Status

OUTCOMES = ("feasible", "reached", "success")
PAPER_OUTCOME = "clear_95"  # the paper's notion of feasible
TASK = ["scenario", "model"]
PAIR = [*TASK, "layout", "seed"]
EFFORT = ["iterations", "outer_iterations", "guided", "seconds"]
MAKESPAN = "makespan"  # of fleets
MACHINERY = ("threads", "device", "kernels")  # columns that say on what a trial was solved
NEEDED_COLUMNS = [*PAIR, "solver", "status", *OUTCOMES, PAPER_OUTCOME, "violation", "cost", *EFFORT]
NUMBER_COLUMNS = [*EFFORT, "violation", "cost", "best_cost", "clearance", "clearance_knots", "goal_distance"]
TEXTS = ("string", "categorical", "bytes")  # kinds of columns without numbers, as pandas calls them
INVALID = Status.INVALID_START.name
OPTION = "solver."  # prefix of the columns that are options of a solver
STATUS = "status_"  # prefix of the columns that count statuses
CONFIDENCE = 0.95


def task_columns(table: pd.DataFrame) -> list[str]:
    """The columns that distinguish tasks: scenario, model, and swept variables of these.

    The latter are named by their keys in the configuration, with a dot, which no other column has.
    """
    return [*TASK, *(name for name in swept_columns(table) if not name.startswith(OPTION))]


def group_columns(table: pd.DataFrame) -> list[str]:
    """The columns that distinguish rows of a summary: those of tasks, the solver, and its swept options."""
    return [*task_columns(table), "solver", *(name for name in swept_columns(table) if name.startswith(OPTION))]


def swept_columns(table: pd.DataFrame) -> list[str]:
    """The columns that are keys of the configuration."""
    return [str(name) for name in table.columns if "." in str(name)]


def are_missions(trials: pd.DataFrame) -> pd.Series:
    """Which rows (rows,) are missions: those with an outcome of their own."""
    return trials["outcome"].notna() if "outcome" in trials.columns else pd.Series(False, index=trials.index)


def grouped(table: pd.DataFrame, names: Sequence[str]) -> list[np.ndarray]:
    """Positions of the rows with the same values in some columns, NA being a value, in order of appearance.

    Positions and not tables: on large tables the many small copies would take most of a report's time.
    """
    groups = table.groupby(list(names), sort=False, dropna=False, observed=True)
    code = groups.ngroup().to_numpy()
    order = np.argsort(code, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(code[order])) + 1)


def plain(table: pd.DataFrame) -> pd.DataFrame:
    """The table with text in place of categories."""
    coded = {str(name): column.cat for name, column in table.items() if isinstance(column.dtype, pd.CategoricalDtype)}
    # `astype` takes twenty times as long.
    text = {name: cat.categories.array.take(cat.codes.to_numpy(), allow_fill=True) for name, cat in coded.items()}
    return table.assign(**text)


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """One row per (scenario, model, solver) and swept variable, in order of appearance.

    Columns:
        n: trials.
        seed: their seeds, as text.
        invalid: those of invalid start, all failures.
        <outcome>_count, _n, _rate, _low, _high: for feasible, reached, success and clear_95: attained, defined, their
            ratio, its 95 % interval.
        violation_median: over all n, one that isn't a number counting as infinite.
        cost_median_reached: over the trials that reached the goal.
        cost_median: over the cost_n trials whose cost is finite.
        cost_ratio_median, _p90: cost divided by the best known cost, over the cost_ratio_n trials that reached the goal
            and have a positive best cost.
        <effort>_median, _p90: iterations, outer_iterations and guided over the trials with a valid start; nan if one of
            them lacks the number.
        seconds_median, _p90: over the seconds_n trials with a valid start of which the time is known.
        makespan_median, _p90: of fleets that reached their goals.
        status_<NAME>: trials that ended with this status; missions: with this outcome.
        threads, device, kernels: what they were solved on, as text.

    _p90 is the 90 % quantile, interpolated linearly.

    Raises:
        InputError: `trials` is empty or lacks a column.
    """
    check_trials(trials)
    names = group_columns(trials)
    groups = grouped(trials, names)
    values = _Values.of(trials, groups)
    keys = trials[names].iloc[[rows[0] for rows in groups]].reset_index(drop=True)
    return pd.concat([plain(keys), pd.DataFrame([values.summary(rows) for rows in groups])], axis=1)


@dataclass(frozen=True)
class _Values:
    """The columns of a table as arrays of numbers."""

    texts: dict[str, np.ndarray]
    invalid: np.ndarray
    hits: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    status: np.ndarray  # index into `statuses`
    statuses: list[str]

    @classmethod
    def of(cls, trials: pd.DataFrame, groups: Sequence[np.ndarray]) -> _Values:
        numbers = {name: numbers_of(trials[name]) for name in ("violation", "cost", *EFFORT)}
        numbers["violation"] = np.nan_to_num(numbers["violation"], nan=np.inf, posinf=np.inf)
        best = numbers_of(trials["best_cost"]) if "best_cost" in trials.columns else np.full(len(trials), nan)
        numbers |= {MAKESPAN: numbers_of(trials[MAKESPAN])} if MAKESPAN in trials.columns else {}
        numbers["cost_ratio"] = numbers["cost"] / np.where(best > 0, best, nan)
        status, statuses = pd.factorize(trials["status"])
        hits = attained(trials, groups)
        invalid = (trials["status"] == INVALID).to_numpy(dtype=bool)
        texts = {name: trials[name].to_numpy() for name in ("seed", *MACHINERY) if name in trials.columns}
        return cls(texts, invalid, hits, numbers, status, [str(name) for name in statuses])

    def summary(self, rows: np.ndarray) -> dict[str, object]:
        selected = {name: values[rows] for name, values in self.numbers.items()}
        valid, reached, cost = ~self.invalid[rows], self.hits["reached"][rows] == 1, selected["cost"]
        ratio = selected["cost_ratio"][reached & np.isfinite(selected["cost_ratio"])]
        row: dict[str, object] = {
            "n": len(rows),
            "seed": self.text("seed", rows),
            "invalid": len(rows) - int(valid.sum()),
        }
        for name in self.hits:
            row |= rate_columns(name, self.hits[name][rows])
        row |= {
            "violation_median": float(np.median(selected["violation"])),
            "cost_median_reached": _quantiles("", cost[reached])["_median"],
            "cost_median": _quantiles("", cost[np.isfinite(cost)])["_median"],
            "cost_n": int(np.isfinite(cost).sum()),
            "cost_ratio_n": len(ratio),
            **_quantiles("cost_ratio", ratio),
        }
        for name in (name for name in EFFORT if name != "seconds"):
            row |= _quantiles(name, selected[name][valid])
        timed = selected["seconds"][valid & ~np.isnan(selected["seconds"])]  # others' solvers don't say all times
        row |= {**_quantiles("seconds", timed), "seconds_n": len(timed)}
        if MAKESPAN in selected:
            row |= _quantiles(MAKESPAN, selected[MAKESPAN][reached])
        counts = np.bincount(self.status[rows], minlength=len(self.statuses)).tolist()
        row |= {f"{STATUS}{name}": count for name, count in zip(self.statuses, counts, strict=True)}
        return row | {name: self.text(name, rows) for name in MACHINERY if name in self.texts}

    def text(self, name: str, rows: np.ndarray) -> str:
        """The values of a column in some rows, each once."""
        return " ".join(str(value) for value in pd.unique(self.texts[name][rows]))


def attained(trials: pd.DataFrame, groups: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Each outcome (rows,): 1 attained, 0 not, NaN where undefined; an invalid start counts as a failure.

    Args:
        groups: positions of the rows of each solver on each task, see `grouped`.

    Where no valid trial of a group defines success (there is no best cost), it stays undefined for the invalid ones
    too: a rate of 0 would be read as a measurement.
    """
    invalid = (trials["status"] == INVALID).to_numpy(dtype=bool)
    hits = {}
    for name in (*OUTCOMES, PAPER_OUTCOME):
        values = _truth(trials[name]).to_numpy(dtype=float, na_value=nan)
        hits[name] = np.where(invalid, 0.0, values)
    if invalid.any():
        for rows in groups:
            if np.isnan(hits["success"][rows][~invalid[rows]]).all():
                hits["success"][rows] = nan
    return hits


def wilson(count: int, n: int) -> tuple[float, float]:
    """95 % Wilson interval of the rate count / n; nan where n is 0."""
    if n == 0:
        return nan, nan
    interval = binomtest(count, n).proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def check_trials(trials: pd.DataFrame, source: object = "a table") -> None:
    """Raise InputError if a table, read from `source`, is empty, lacks a column or has text for numbers."""
    missing = [name for name in NEEDED_COLUMNS if name not in trials.columns]
    if missing:
        raise InputError("trials", "the columns of a study", f"{source} without {', '.join(missing)}")
    if trials.empty:
        raise InputError("trials", "at least one row", f"{source} with none")
    types = pd.api.types
    for names, is_right, convert, kind in (
        (NUMBER_COLUMNS, types.is_numeric_dtype, numbers_of, "numbers"),
        ((*OUTCOMES, PAPER_OUTCOME), types.is_bool_dtype, _truth, "true or false"),
    ):
        for name in trials.columns.intersection(list(names)):
            try:
                if types.infer_dtype(trials[name], skipna=True) in TEXTS:
                    raise TypeError
                if not is_right(trials[name].dtype):
                    convert(trials[name])
            except (TypeError, ValueError):
                raise InputError("trials", f"{kind} in column {name}", f"{source} with others") from None


def numbers_of(column: pd.Series) -> np.ndarray:
    """A column as floats, NaN where it has no value."""
    return column.to_numpy(dtype=float, na_value=nan)


def rate_columns(name: str, hits: np.ndarray) -> dict[str, object]:
    """The columns of an outcome from its hits (rows,): 1 attained, 0 not, NaN where undefined."""
    n, count = int((~np.isnan(hits)).sum()), int(np.nansum(hits))
    low, high = wilson(count, n)
    parts = {"count": count, "n": n, "rate": count / n if n else nan, "low": low, "high": high}
    return {f"{name}_{suffix}": value for suffix, value in parts.items()}


def _truth(column: pd.Series) -> pd.Series:
    return column.astype("boolean")


def _quantiles(name: str, values: np.ndarray) -> dict[str, float]:
    median, p90 = np.quantile(values, [0.5, 0.9]).tolist() if values.size else (nan, nan)
    return {f"{name}_median": median, f"{name}_p90": p90}
