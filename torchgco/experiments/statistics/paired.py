"""Two solvers compared on the trials that both flew: who attained an outcome, and at which cost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from math import nan
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest, quantile_test

from torchgco.base.errors import InputError
from torchgco.experiments.statistics.statistics import (
    CONFIDENCE,
    OUTCOMES,
    PAIR,
    TASK,
    attained,
    check_trials,
    grouped,
    numbers_of,
    task_columns,
)


@dataclass(frozen=True)
class PairedResult:
    """Two solvers on the same trials, counted by which of them attained the outcome.

    Args:
        n: trials in which both solvers flew and the outcome is defined for both.
        both, only_a, only_b, neither: how many of the n trials were attained by both, by one only, by neither.
        difference: rate of a minus rate of b over the n trials, nan where n is 0.
        p_value: exact McNemar, two-sided: a fair coin for the trials that only one of the two attained.
        undefined: trials that both flew, left out because the outcome isn't defined.
        unmatched: trials that only one of the two flew.
        cost_n: trials that both reached, with finite positive costs.
        cost_ratio: median over them of the cost of a divided by that of b; nan where cost_n is 0.
        cost_low, cost_high: 95 % interval of this median from order statistics, which assumes no distribution; nan
            below 6 trials, which can't give one.
    """

    solver_a: str
    solver_b: str
    outcome: str
    n: int
    both: int
    only_a: int
    only_b: int
    neither: int
    difference: float
    p_value: float
    undefined: int
    unmatched: int
    cost_n: int
    cost_ratio: float
    cost_low: float
    cost_high: float


def compare(trials: pd.DataFrame) -> pd.DataFrame:
    """For each task the solver that comes first, the one under study, against every other.

    Trials are matched by scenario, model, swept variables, layout, seed, and the layout's digest where the table has
    it. Where the first solver flew in several variants ("gco [...]"), each of them is compared with all that follow.

    Returns:
        A row per task (scenario, model, swept variables), pair of solvers and outcome: the columns of the task, and
        the fields of PairedResult. No rows for a task that one solver flew.

    Raises:
        InputError: a column that is missing, or a solver that has two rows for one trial.
    """
    check_trials(trials)
    flights, columns = _Flights(trials), task_columns(trials)
    return pd.DataFrame(list(flights.rows()), columns=[*columns, *PairedResult.__dataclass_fields__])


def trial_numbers(trials: pd.DataFrame) -> np.ndarray:
    """One number (rows,) per trial, the same for all solvers: of a layout and seed of a task."""
    digest = ["layout_digest"] if "layout_digest" in trials.columns else []
    trial = [*task_columns(trials), *PAIR[len(TASK) :], *digest]
    return trials.groupby(trial, sort=False, dropna=False, observed=True).ngroup().to_numpy()


def check_single(trials: pd.DataFrame, trial: np.ndarray, solver: str, rows: np.ndarray) -> None:
    """Raise InputError where a solver has two of `rows` for one trial; `trial`: see `trial_numbers`."""
    ordered = rows[np.argsort(trial[rows], kind="stable")]
    repeated = ordered[1:][np.diff(trial[ordered]) == 0]
    if len(repeated):
        row = trials[PAIR].iloc[repeated.min()]
        first = ", ".join(f"{name} {value}" for name, value in row.items())
        raise InputError("trials", f"one row of {solver} for {first}", "two")


def _bare(solver: str) -> str:
    """A solver's name without the label that a merge gave it."""
    return solver.split(" [")[0]


class _Flights:
    """A table of trials as arrays, in which two solvers' rows of the same trial are found."""

    def __init__(self, trials: pd.DataFrame) -> None:
        self.trials = trials
        self.trial = trial_numbers(trials)
        self.solver, names = pd.factorize(trials["solver"])
        self.names = [str(name) for name in names]
        self.hits = attained(trials, grouped(trials, [*task_columns(trials), "solver"]))
        self.cost = numbers_of(trials["cost"])

    def rows(self) -> Iterator[dict[str, object]]:
        """The rows of `compare`."""
        names = task_columns(self.trials)
        keys = self.trials[names]
        for task in grouped(self.trials, names):
            key = keys.iloc[task[0]].to_dict()
            flown = [self.names[code] for code in pd.unique(self.solver[task])]
            for a, b in combinations(flown, 2):
                for result in self.compared(task, a, b) if _bare(a) == _bare(flown[0]) else ():
                    yield key | asdict(result)

    def match(self, rows: np.ndarray, a: str, b: str) -> tuple[np.ndarray, np.ndarray, int]:
        """Positions of two solvers' rows of the trials that both flew, among `rows`, and how many only one flew."""
        rows_a, rows_b = (rows[self.solver[rows] == self.names.index(name)] for name in (a, b))
        for name, positions in ((a, rows_a), (b, rows_b)):
            check_single(self.trials, self.trial, name, positions)
        _, in_a, in_b = np.intersect1d(self.trial[rows_a], self.trial[rows_b], assume_unique=True, return_indices=True)
        return rows_a[in_a], rows_b[in_b], len(rows_a) + len(rows_b) - 2 * len(in_a)

    def compared(self, rows: np.ndarray, a: str, b: str) -> Iterator[PairedResult]:
        """Two solvers' rows among `rows`, compared by each outcome."""
        rows_a, rows_b, unmatched = self.match(rows, a, b)
        arrived = (self.hits["reached"][rows_a] == 1) & (self.hits["reached"][rows_b] == 1)
        costs = _ratio(self.cost[rows_a[arrived]], self.cost[rows_b[arrived]])
        for outcome in OUTCOMES:
            counts = _counts(self.hits[outcome][rows_a], self.hits[outcome][rows_b])
            yield PairedResult(a, b, outcome, **counts, unmatched=unmatched, **costs)


def _counts(hit_a: np.ndarray, hit_b: np.ndarray) -> dict[str, Any]:
    """The counts of PairedResult from the outcomes (rows,) of two solvers, NaN where undefined."""
    total = len(hit_a)
    defined = ~np.isnan(hit_a) & ~np.isnan(hit_b)
    hit_a, hit_b = hit_a[defined] == 1, hit_b[defined] == 1
    only_a, only_b = int((hit_a & ~hit_b).sum()), int((hit_b & ~hit_a).sum())
    n, discordant = len(hit_a), only_a + only_b
    return {
        "n": n,
        "both": int((hit_a & hit_b).sum()),
        "only_a": only_a,
        "only_b": only_b,
        "neither": int((~hit_a & ~hit_b).sum()),
        "difference": (only_a - only_b) / n if n else nan,
        "p_value": float(binomtest(only_a, discordant).pvalue) if discordant else 1.0,
        "undefined": total - n,
    }


def _ratio(a: np.ndarray, b: np.ndarray) -> dict[str, Any]:
    """Median of a / b with its interval, as the fields of PairedResult."""
    known = (a > 0) & (b > 0) & np.isfinite(a) & np.isfinite(b)
    ratio = a[known] / b[known]
    if not len(ratio):
        return {"cost_n": 0, "cost_ratio": nan, "cost_low": nan, "cost_high": nan}
    low, high = quantile_test(ratio, p=0.5).confidence_interval(confidence_level=CONFIDENCE)
    return {"cost_n": len(ratio), "cost_ratio": float(np.median(ratio)), "cost_low": low, "cost_high": high}
