"""How many layouts tell two success rates apart, with different layouts for the two solvers or with the same."""

from __future__ import annotations

from math import ceil, sqrt
from typing import NoReturn

import numpy as np
import pandas as pd
from scipy.stats import binom, norm

from torchgco.base.errors import InputError
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import task_columns

MOST = 1_000_000  # layouts; nobody flies more, and the search for their number takes seconds
WIDTH = 9.0  # standard deviations around the expected number of discordant layouts; the rest is below 1e-17
SEARCHED = 40  # numbers below the one found, where the power, which isn't quite monotone, may reach the target too


def power_table(
    rate_a: float, rate_b: float, level: float = 0.05, target: float = 0.8, trials: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Layouts needed to find a difference between two rates: a row per design.

    Args:
        rate_a, rate_b: the two rates, in 0..1.
        level: of the two-sided test; target: its power.
        trials: a table of trials, whose pairs of solvers give further rows.

    Columns: `design`; `discordant`, the share of layouts that only one solver attains; `layouts` per solver; `power`.
    In a pair of the data the discordant share is that of `success` (of `reached`, where success is undefined), and at
    least the difference of the rates.

    Raises:
        InputError: a rate outside 0..1, equal rates, a level or target not between 0 and 1, or rates so close, a level
            so small or a target so large that more than a million layouts are needed.
    """
    for name, value in (("level", level), ("power-target", target)):
        if not 0 < value < 1:
            raise InputError(f"--{name}", "a number between 0 and 1", value)
    for value in (rate_a, rate_b):
        if not 0 <= value <= 1:
            raise InputError("--power", "two rates from 0 to 1", value)
    if rate_a == rate_b:
        raise InputError("--power", "two different rates", f"{rate_a} twice")
    n = unpaired_layouts(rate_a, rate_b, level, target)
    rows: list[tuple[str, float, int, float]] = [
        ("different layouts, two-proportion test", np.nan, n, unpaired_power(n, rate_a, rate_b, level))
    ]
    independent = rate_a * (1 - rate_b) + rate_b * (1 - rate_a)
    shares = [("same layouts, McNemar, independent outcomes", independent)]
    shares += [] if trials is None else _shares(trials)
    gap = abs(rate_a - rate_b)
    for name, share in shares:
        share = max(share, gap)
        n = paired_layouts(gap, share, level, target)
        rows.append((name, share, n, paired_power(n, gap, share, level)))
    return pd.DataFrame(rows, columns=["design", "discordant", "layouts", "power"])


def _shares(trials: pd.DataFrame) -> list[tuple[str, float]]:
    """Name and discordant share of every pair of solvers in a table of trials."""
    pairs = compare(trials)
    names = task_columns(pairs)
    found = []
    for _, rows in pairs.groupby([*names, "solver_a", "solver_b"], sort=False, dropna=False):
        defined = rows[(rows["n"] > 0) & (rows["outcome"] != "feasible")]
        if len(defined):
            row = defined.iloc[-1]  # success, else reached
            swept = [f"{name.split('.')[-1]} {row[name]}" for name in names[2:] if pd.notna(row[name])]
            where = ", ".join([f"{row['scenario']} ({row['model']})", *swept])
            pair = f"{row['solver_a']} - {row['solver_b']}"
            share = (row["only_a"] + row["only_b"]) / row["n"]
            found.append((f"same layouts, McNemar, as {pair} by {row['outcome']}: {where}", float(share)))
    return found


def unpaired_layouts(rate_a: float, rate_b: float, level: float, target: float) -> int:
    """Layouts per solver, drawn separately for each, for the two-sided two-proportion test.

    Normal approximation with the pooled variance under the null hypothesis and without continuity correction: Fleiss,
    Levin and Paik, Statistical Methods for Rates and Proportions, 3rd ed. (2003), chapter 4.
    """
    null, other = _deviations(rate_a, rate_b)
    z = norm.isf(level / 2) * null + norm.ppf(target) * other
    needed = float((z / (rate_a - rate_b)) ** 2)
    return max(1, ceil(needed)) if needed <= MOST else _beyond(abs(rate_a - rate_b), level, target)


def _beyond(gap: float, level: float, target: float) -> NoReturn:
    expected = f"rates that at most {MOST:,} layouts tell apart"
    raise InputError("--power", expected, f"a difference of {gap:.3g} at level {level:g} and power {target:g}")


def unpaired_power(n: int, rate_a: float, rate_b: float, level: float) -> float:
    """The power of the same test with n layouts per solver."""
    null, other = _deviations(rate_a, rate_b)
    z = sqrt(n) * abs(rate_a - rate_b) - norm.isf(level / 2) * null
    return float(norm.cdf(z / other)) if other > 0 else float(z > 0)


def _deviations(rate_a: float, rate_b: float) -> tuple[float, float]:
    """Standard deviations of the difference of two single outcomes, for equal rates and for those given."""
    mean = (rate_a + rate_b) / 2
    return sqrt(2 * mean * (1 - mean)), sqrt(rate_a * (1 - rate_a) + rate_b * (1 - rate_b))


def paired_power(n: int, gap: float, share: float, level: float) -> float:
    """The power of the exact two-sided McNemar test on n layouts that both solvers fly.

    gap    difference of the two rates; share: of layouts that only one of the solvers attains, at least the gap

    Exact: the number of discordant layouts is binomial, and given their number the test is a binomial one, as in the
    comparisons of a report. Power is averaged over that number (SAS/STAT, PROC POWER, "exact conditional").
    """
    middle, width = n * share, WIDTH * sqrt(n * share * (1 - share)) + 1
    m = np.arange(max(0, int(middle - width)), min(n, ceil(middle + width)) + 1)
    # The largest count of the rarer kind that the test rejects, -1 where it rejects none.
    critical = binom.ppf(level / 2, m, 0.5)
    critical = np.where(binom.cdf(critical, m, 0.5) > level / 2, critical - 1, critical)
    q = (share + gap) / (2 * share)  # that a discordant layout is attained by the better solver
    rejects = binom.cdf(critical, m, q) + binom.sf(m - critical - 1, m, q)
    return float((binom.pmf(m, n, share) * np.where(critical >= 0, rejects, 0.0)).sum())


def paired_layouts(gap: float, share: float, level: float, target: float) -> int:
    """The smallest number of layouts with which `paired_power` reaches a target."""
    high = 1
    while paired_power(high, gap, share, level) < target:
        high = 2 * high if 2 * high <= MOST else _beyond(gap, level, target)
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if paired_power(middle, gap, share, level) >= target else (middle, high)
    below = range(max(1, high - SEARCHED), high)
    return next((n for n in below if paired_power(n, gap, share, level) >= target), high)
