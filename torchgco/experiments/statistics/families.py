"""Solvers compared over families of layouts: performance profiles, interquartile means, ranks, improvement.

A number of a flight (its cost, by default) is taken as a ratio to the least that is known for the layout. A flight that
didn't reach the goal is a loss and never left out: its ratio is infinite, its score 0, its rank the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import nan
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import bootstrap, friedmanchisquare, rankdata, trim_mean

from torchgco.base.errors import InputError
from torchgco.base.options import Seed, check_value
from torchgco.experiments.statistics.paired import check_single, trial_numbers
from torchgco.experiments.statistics.statistics import (
    CONFIDENCE,
    are_missions,
    attained,
    check_trials,
    grouped,
    numbers_of,
    task_columns,
)
from torchgco.experiments.statistics.tables import Columns, aligned, cells, format_frame, headers, swept_of

COLUMNS = ["statistic", "solver", "other", "at", "value", "low", "high", "p_value", "families", "layouts"]
PROFILE, MIDDLE, RANK, IMPROVEMENT, FRIEDMAN = "profile", "interquartile_mean", "mean_rank", "improvement", "friedman"
RESAMPLES = 2000  # another seed moves the ends of intervals by some 3 % of their width
BATCH_NUMBERS = 2**22  # numbers of resamples held at once: 32 MB
DIGITS = 3  # of a ratio: a solve ends where the cost could fall by 1e-4 of it, so less is no difference
# Ratios at which the profile is given, half of them up to 1.1, where good solvers differ; infinity: whether it reached.
RATIOS = np.unique(np.round(1.0 + np.concatenate(([0.0], np.geomspace(1e-3, 9.0, 48), [0.01, 0.05, 0.1, 1.0])), DIGITS))
RATIOS = np.append(RATIOS, np.inf)
SHOWN = {"within 1 %": 1.01, "within 5 %": 1.05, "within 100 %": 2.0, "reached": np.inf}  # in texts


def over_families(trials: pd.DataFrame, measure: str = "cost", seed: int = 0) -> pd.DataFrame:
    """Statistics of all solvers over the families of a table, such as `torchgco.read` returns.

    A family is a task: a scenario and model with their swept variables. Each counts as much as any other, whatever its
    number of layouts; in the interquartile mean each layout does.

    Args:
        measure: a column of numbers of which less is better: cost, seconds, iterations; of missions flight_time; a
            metric of your own. A layout's least is that of the solvers that reached, and `best_cost` where it is lower.
        seed: of the bootstrap.

    Returns:
        A row per statistic. `value` with a 95 % interval from `low` to `high`, by the percentile bootstrap over the
        layouts of each family (stratified; NaN where a family has a single layout), and `families`, `layouts`.
        profile: the share of layouts on which `solver` reached with at most `at` times the least (Dolan and More 2002,
            Mathematical Programming 91, 201-213); at infinity, the share on which it reached.
        interquartile_mean: of the scores 1 / ratio, the mean of the middle half (Agarwal et al. 2021, NeurIPS 34).
        mean_rank: among the solvers, 1 is the best, equal ones share a rank (Demsar 2006, JMLR 7, 1-30).
        improvement: the share of layouts on which `solver` is better than `other`, ties counted half: the paired form
            of the probability of improvement (Agarwal et al. 2021).
        friedman: of three solvers or more, whether their ranks differ at all: `p_value`, with Kendall's W as `value`,
            which is 0 where they don't and 1 where all layouts rank alike.
        Ratios are rounded to three digits: solvers that end in one optimum tie.

    Raises:
        InputError: a single solver, solvers that flew different layouts, missions beside trajectories, a column that
            isn't there or has no number where the goal was reached.
    """
    check_trials(trials)
    check_value(seed, Seed, "families.seed")
    names = [str(name) for name in pd.unique(trials["solver"])]
    if len(names) < 2:
        raise InputError("families", "two solvers or more", f"{names[0]} alone")
    if are_missions(trials).nunique() > 1:
        raise InputError("families", "trajectories or missions", "a table of both")
    values = _values(trials, measure)
    ratios = [_ratios(*family) for family in _families(trials, values, names, measure)]
    return _table(ratios, names, seed)


def _values(trials: pd.DataFrame, measure: str) -> np.ndarray:
    """The measure of each row, infinite where the goal wasn't reached."""
    groups = grouped(trials, [*task_columns(trials), "solver"])
    reached = attained(trials, groups)["reached"] == 1
    if measure not in trials.columns or not pd.api.types.is_numeric_dtype(trials[measure]):
        expected = "a column of numbers of which less is better, such as cost, seconds or iterations"
        raise InputError("families", expected, measure)
    values = numbers_of(trials[measure])
    if len(lacking := np.flatnonzero(reached & ~np.isfinite(values))):
        solver = trials["solver"].iloc[lacking[0]]
        expected = f"a number in {measure} of every trial that reached the goal"
        raise InputError("families", expected, f"none of {solver} in {len(lacking)} trials")
    return np.where(reached, values, np.inf)


def _families(
    trials: pd.DataFrame, values: np.ndarray, names: Sequence[str], measure: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each family the measure (L, S) by layout and solver, and the least known (L,), NaN where none is."""
    trial, solver = trial_numbers(trials), pd.Index(names).get_indexer(pd.Index(trials["solver"]))
    known = measure == "cost" and "best_cost" in trials.columns
    best = numbers_of(trials["best_cost"]) if known else np.full(len(trials), nan)
    families = []
    for rows in grouped(trials, task_columns(trials)):
        for s, name in enumerate(names):
            check_single(trials, trial, name, rows[solver[rows] == s])
        layouts, place = np.unique(trial[rows], return_inverse=True)
        counts = np.bincount(solver[rows], minlength=len(names))
        if (counts != len(layouts)).any():
            flown = ", ".join(f"{name} {count}" for name, count in zip(names, counts, strict=True))
            expected = f"the same layouts of every solver in {_called(trials.iloc[rows])}"
            raise InputError("families", expected, f"{flown} of {len(layouts)}")
        of_each, least = np.empty((len(layouts), len(names))), np.full(len(layouts), nan)
        of_each[place, solver[rows]] = values[rows]
        np.fmin.at(least, place, best[rows])
        families.append((of_each, least))
    return families


def _called(rows: pd.DataFrame) -> str:
    """The name of a family, from its rows."""
    swept, row = swept_of(rows), rows.iloc[0]
    more = [f"{head} {cell}" for head, cell in zip(headers(swept), cells(row, swept), strict=True)]
    return ", ".join([f"{row['scenario']} ({row['model']})", *more])


def _ratios(values: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Values (L, S) by the least known, of any sign: 1 and their excess as a share of its amount, rounded."""
    least = np.fmin(values.min(axis=1), best)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.where(values == least, 1.0, 1.0 + (values - least) / np.abs(least))
    return np.where(np.isfinite(values), np.round(ratios, DIGITS), np.inf)


def _table(ratios: Sequence[np.ndarray], names: Sequence[str], seed: int) -> pd.DataFrame:
    pairs = list(combinations(range(len(names)), 2))
    means = [_of_layouts(family, pairs) for family in ratios]
    scores = [1.0 / family for family in ratios]

    def statistic(*picked: np.ndarray, axis: int) -> np.ndarray:
        """All values (rows, ...) of layouts (..., L) that are picked from each family."""
        of_families = [numbers[rows].mean(axis=-2) for numbers, rows in zip(means, picked, strict=True)]
        middle = np.concatenate([score[rows] for score, rows in zip(scores, picked, strict=True)], axis=-2)
        whole = np.concatenate((np.mean(of_families, axis=0), trim_mean(middle, 0.25, axis=-2)), axis=-1)
        return np.moveaxis(whole, -1, 0)

    places = [np.arange(len(family)) for family in ratios]
    value, (low, high) = statistic(*places, axis=-1), _interval(places, statistic, means, seed)
    labels = [(PROFILE, name, "", at) for at in RATIOS.tolist() for name in names]
    labels += [(RANK, name, "", nan) for name in names]
    labels += [(IMPROVEMENT, names[a], names[b], nan) for a, b in pairs]
    labels += [(MIDDLE, name, "", nan) for name in names]
    rows = [(*label, *ends, nan) for label, *ends in zip(labels, value, low, high, strict=True)]
    layouts = np.concatenate(ratios)
    rows += [(FRIEDMAN, "", "", nan, *_friedman(layouts))] if len(names) > 2 and len(layouts) > 1 else []
    return pd.DataFrame([(*row, len(ratios), len(layouts)) for row in rows], columns=COLUMNS)


def _of_layouts(ratios: np.ndarray, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """What statistics are means of, (L, rows): whether each ratio is kept by each solver, ranks, and who is better."""
    within = (ratios[:, None, :] <= RATIOS[:-1, None]).reshape(len(ratios), -1)
    better = [(ratios[:, a] < ratios[:, b]) + 0.5 * (ratios[:, a] == ratios[:, b]) for a, b in pairs]
    return np.column_stack((within, np.isfinite(ratios), rankdata(ratios, axis=1), *better))


def _interval(places: Sequence[np.ndarray], statistic: Any, means: Sequence[np.ndarray], seed: int) -> Any:
    """The ends of the intervals; NaN where a family of one layout would give no spread."""
    if min(map(len, places)) < 2:
        nothing = np.full(len(statistic(*places, axis=-1)), nan)
        return nothing, nothing
    batch = max(1, BATCH_NUMBERS // sum(numbers.size for numbers in means))
    result = bootstrap(
        places, statistic, n_resamples=RESAMPLES, batch=batch, vectorized=True, method="percentile",
        confidence_level=CONFIDENCE, random_state=np.random.default_rng(seed),
    )  # fmt: skip
    return result.confidence_interval


def _friedman(ratios: np.ndarray) -> tuple[float, float, float, float]:
    """Kendall's W, no interval, and the test's p-value, of ratios (L, S)."""
    if (ratios == ratios[:, :1]).all():
        return 0.0, nan, nan, 1.0
    test = friedmanchisquare(*ratios.T)
    return float(test.statistic) / (ratios.shape[0] * (ratios.shape[1] - 1)), nan, nan, float(test.pvalue)


def families_text(table: pd.DataFrame, measure: str, form: str) -> str:
    """What `over_families` returns, in one of `tables.OUTPUTS`: all of it in csv and json, else what a paper prints."""
    if form in ("csv", "json"):
        return format_frame(table, form)
    frames = [_by_solver(table), _by_pair(table)]
    if form != "table":
        return "\n\n".join(format_frame(frame, form) for frame in frames)
    count, layouts = table[["families", "layouts"]].iloc[0]
    lines = [f"{measure} over {count} families, {layouts} layouts" if count > 1 else f"{measure}, {layouts} layouts"]
    lines += [aligned([list(frame.columns), *frame.to_numpy().tolist()], 1) for frame in frames]
    for row in table[table["statistic"] == FRIEDMAN].itertuples():
        lines.append(f"ranks differ: Friedman p {row.p_value:.2g}, Kendall's W {row.value:.2f}")
    about = "[95 % bootstrap interval]; within: of the least; score: least by own, 0 where the goal wasn't reached"
    return "\n\n".join([*lines, about])


def _by_solver(table: pd.DataFrame) -> pd.DataFrame:
    """A row per solver: score, rank, and the profile at SHOWN."""
    score, rank = (table[table["statistic"] == name].set_index("solver") for name in (MIDDLE, RANK))
    columns: Columns = {"mean score": lambda row: _cell(score.loc[row.name], 3)}
    columns["mean rank"] = lambda row: _cell(rank.loc[row.name], 2)
    for head, at in SHOWN.items():
        share = table[(table["statistic"] == PROFILE) & (table["at"] == at)].set_index("solver")
        columns[head] = lambda row, share=share: _cell(100 * share.loc[row.name, ["value", "low", "high"]], 0, " %")
    rows = [[name, *(cell(row) for cell in columns.values())] for name, row in score.iterrows()]
    return pd.DataFrame(rows, columns=["solver", *columns])


def _by_pair(table: pd.DataFrame) -> pd.DataFrame:
    """A row per pair of solvers: how often the first is better."""
    pairs = table[table["statistic"] == IMPROVEMENT]
    rows = [[f"{row['solver']} - {row['other']}", _cell(row, 3)] for _, row in pairs.iterrows()]
    return pd.DataFrame(rows, columns=["pair", "first is better"])


def _cell(row: Any, digits: int, unit: str = "") -> str:
    """A value with its interval, where it has one."""
    ends = "" if pd.isna(row["low"]) else f" [{row['low']:.{digits}f}, {row['high']:.{digits}f}]"
    return f"{row['value']:.{digits}f}{unit}{ends}"
