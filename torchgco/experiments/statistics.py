"""Rates with their intervals, and paired comparisons, counted from a table of trials.

A trial is one solver on one layout, a row of `trials.parquet`. Nothing is left out of a count silently: a trial
whose start was invalid is a failure, an outcome that isn't defined is subtracted from a denominator that
is given with the rate, and a violation that isn't a number counts as infinite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from math import nan

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from torchgco.errors import InputError
from torchgco.status import Status

OUTCOMES = ("feasible", "reached", "success")
TASK = ["scenario", "model"]
PAIR = [*TASK, "layout", "seed"]
EFFORT = ["iterations", "outer_iterations", "guided", "seconds"]
COLUMNS = [*PAIR, "solver", "status", *OUTCOMES, "violation", "cost", *EFFORT]
NUMBERS = [*EFFORT, "violation", "cost", "best_cost", "clearance", "clearance_knots", "goal_distance"]
INVALID = Status.INVALID_START.name
VIOLATION_TOLERANCE = 1e-3  # metres for lengths, inputs in their units
CONFIDENCE = 0.95


@dataclass(frozen=True)
class PairedResult:
    """Two solvers on the same trials, counted by which of them attained the outcome.

    n              trials in which both solvers flew and the outcome is defined for both
    both, only_a, only_b, neither
                   how many of the n trials were attained by both, by one only, by neither
    difference     rate of a minus rate of b over the n trials, nan where n is 0
    p_value        exact McNemar, two-sided: a fair coin for the trials that only one of the two attained
    undefined      trials that both flew, left out because the outcome isn't defined
    unmatched      trials that only one of the two flew
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


def task_columns(table: pd.DataFrame) -> list[str]:
    """The columns that distinguish tasks: scenario, model, and the variables swept in a merged table.

    The latter are named by their keys in the configuration, with a dot, which no column of a study has.
    """
    return [*TASK, *(str(name) for name in table.columns if "." in str(name))]


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """One row per (scenario, model, solver), in order of appearance; in a merged table also per swept variable.

    n                   trials; seed: their seeds, as text; invalid: those of invalid start, all failures
    <outcome>_count, _n, _rate, _low, _high
                        for feasible, reached and success: attained, defined, their ratio, its 95 % interval
    violation_ok        share of all n whose violation is at most 1e-3
    violation_median    over all n, one that isn't a number counting as infinite
    cost_median_reached over the trials that reached the goal
    cost_median         over the cost_n trials whose cost is finite
    iterations_mean, outer_iterations_median, guided_mean, seconds_mean
                        over the trials with a valid start; nan if one of them lacks the number

    Raises InputError if `trials` is empty or lacks a column.
    """
    check_trials(trials)
    names = [*task_columns(trials), "solver"]
    groups = trials.groupby(names, sort=False, dropna=False)
    return pd.DataFrame([_summary(group, names) for _, group in groups])


def _summary(group: pd.DataFrame, names: list[str]) -> dict[str, object]:
    valid = group[group["status"] != INVALID]
    violation = np.nan_to_num(_numbers(group["violation"]), nan=np.inf, posinf=np.inf)
    cost = _numbers(group["cost"])
    reached = outcome_of(group, "reached").to_numpy(dtype=bool, na_value=False)
    row: dict[str, object] = {name: group[name].iloc[0] for name in names}
    row |= {
        "n": len(group),
        "seed": " ".join(str(seed) for seed in group["seed"].unique()),
        "invalid": len(group) - len(valid),
    }
    for name in OUTCOMES:
        row |= _rate(name, outcome_of(group, name))
    return row | {
        "violation_ok": float(np.mean(violation <= VIOLATION_TOLERANCE)),
        "violation_median": float(np.median(violation)),
        "cost_median_reached": _median(cost[reached]),
        "cost_median": _median(cost[np.isfinite(cost)]),
        "cost_n": int(np.isfinite(cost).sum()),
        "iterations_mean": _mean(_numbers(valid["iterations"])),
        "outer_iterations_median": _median(_numbers(valid["outer_iterations"])),
        "guided_mean": _mean(_numbers(valid["guided"])),
        "seconds_mean": _mean(_numbers(valid["seconds"])),
    }


def outcome_of(group: pd.DataFrame, name: str) -> pd.Series:
    """Outcome `name` of one solver's trials as nullable booleans; an invalid start counts as a failure.

    Where no valid trial of the group defines the outcome (a success without any best cost), it stays
    undefined for the invalid ones too: a rate of 0 would be read as a measurement.
    """
    values = _truth(group[name])
    invalid = group["status"] == INVALID
    if name == "success" and values[~invalid].isna().all():
        return values.mask(invalid)
    return values.mask(invalid, False)


def wilson(count: int, n: int) -> tuple[float, float]:
    """95 % Wilson interval of the rate count / n; nan where n is 0."""
    if n == 0:
        return nan, nan
    interval = binomtest(count, n).proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def paired(trials: pd.DataFrame, solver_a: str, solver_b: str, outcome: str = "reached") -> PairedResult:
    """Compare two solvers on the trials both flew, matched by scenario, model, swept variables, layout and seed.

    A layout is the same where its digest is, too, if the table has a column `layout_digest`.

    Raises InputError for a column that is missing, a solver that isn't in `trials`, an unknown outcome, and a
    solver that has two rows for one trial.
    """
    check_trials(trials)
    if outcome not in OUTCOMES:
        raise InputError("outcome", f"one of {', '.join(OUTCOMES)}", outcome)
    a, b = (_by_trial(trials, solver, outcome) for solver in (solver_a, solver_b))
    rows = a.merge(b, on=_pair(trials), how="outer", suffixes=("_a", "_b"), indicator="flown_by")
    shared = rows[rows["flown_by"] == "both"]
    defined = shared.dropna(subset=["hit_a", "hit_b"])
    hit_a, hit_b = (defined[name].to_numpy(dtype=bool) for name in ("hit_a", "hit_b"))
    only_a, only_b = int((hit_a & ~hit_b).sum()), int((hit_b & ~hit_a).sum())
    n, discordant = len(defined), only_a + only_b
    return PairedResult(
        solver_a=solver_a,
        solver_b=solver_b,
        outcome=outcome,
        n=n,
        both=int((hit_a & hit_b).sum()),
        only_a=only_a,
        only_b=only_b,
        neither=int((~hit_a & ~hit_b).sum()),
        difference=(only_a - only_b) / n if n else nan,
        p_value=float(binomtest(only_a, discordant).pvalue) if discordant else 1.0,
        undefined=len(shared) - n,
        unmatched=len(rows) - len(shared),
    )


def paired_table(trials: pd.DataFrame, solver: str) -> pd.DataFrame:
    """`solver` against every other solver: a row per task (scenario, model, swept variables), other solver and outcome.

    Columns: those of the task and the fields of PairedResult, `solver` being a. Tasks that `solver` didn't fly
    and tasks that nobody else flew give no row. Raises InputError as `paired` does.
    """
    check_trials(trials)
    if solver not in set(trials["solver"]):
        raise InputError("solver", f"one of {', '.join(trials['solver'].unique())}", solver)
    rows = list(_pairs(trials, solver))
    names = [*task_columns(trials), *PairedResult.__dataclass_fields__]
    return pd.DataFrame(rows, columns=names)


def _pairs(trials: pd.DataFrame, solver: str) -> Iterator[dict[str, object]]:
    names = task_columns(trials)
    for values, task in trials.groupby(names, sort=False, dropna=False):
        solvers = list(task["solver"].unique())
        others = [other for other in solvers if other != solver] if solver in solvers else []
        for other in others:
            for name in OUTCOMES:
                yield dict(zip(names, values, strict=True)) | asdict(paired(task, solver, other, name))


def _pair(trials: pd.DataFrame) -> list[str]:
    """Columns that identify a trial for any solver."""
    digest = ["layout_digest"] if "layout_digest" in trials.columns else []
    return [*task_columns(trials), *PAIR[len(TASK) :], *digest]


def _by_trial(trials: pd.DataFrame, solver: str, outcome: str) -> pd.DataFrame:
    """The columns that identify a trial, and `hit`, one solver's outcome there."""
    group = trials[trials["solver"] == solver]
    if group.empty:
        raise InputError("solver", f"one of {', '.join(trials['solver'].unique())}", solver)
    pair = _pair(trials)
    repeated = group.loc[group.duplicated(pair), PAIR]
    if len(repeated):
        first = ", ".join(f"{name} {value}" for name, value in repeated.iloc[0].items())
        raise InputError("trials", f"one row of {solver} for {first}", "two")
    tasks = group.groupby(task_columns(trials), sort=False, dropna=False)
    return group[pair].assign(hit=pd.concat([outcome_of(task, outcome) for _, task in tasks]))


def check_trials(trials: pd.DataFrame, place: object = "a table") -> None:
    """Raise InputError if a table, read from `place`, is empty, lacks a column or has text for numbers."""
    missing = [name for name in COLUMNS if name not in trials.columns]
    if missing:
        raise InputError("trials", "the columns of a study", f"{place} without {', '.join(missing)}")
    if trials.empty:
        raise InputError("trials", "at least one row", f"{place} with none")
    for names, convert, kind in ((NUMBERS, _numbers, "numbers"), (OUTCOMES, _truth, "true or false")):
        for name in trials.columns.intersection(list(names)):
            try:
                convert(trials[name])
            except (TypeError, ValueError):
                raise InputError("trials", f"{kind} in column {name}", f"{place} with others") from None


def _rate(name: str, values: pd.Series) -> dict[str, object]:
    n, count = int(values.notna().sum()), int(values.sum())
    low, high = wilson(count, n)
    parts = {"count": count, "n": n, "rate": count / n if n else nan, "low": low, "high": high}
    return {f"{name}_{part}": value for part, value in parts.items()}


def _numbers(column: pd.Series) -> np.ndarray:
    return column.to_numpy(dtype=float, na_value=nan)


def _truth(column: pd.Series) -> pd.Series:
    return column.astype("boolean")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else nan


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else nan
