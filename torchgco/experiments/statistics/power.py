"""How many layouts tell two rates apart, by the test that reports use."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy.stats import binom

from torchgco.base.errors import InputError
from torchgco.base.options import Within, check_value
from torchgco.experiments.statistics.statistics import CONFIDENCE

POWER = 0.8  # probability that the test finds the difference: what trials are usually planned for
LEAST_DIFFERENCE = 0.005  # of two rates: smaller ones need 100,000 layouts and more
SPREAD = 9.0  # standard deviations of a count beyond which a probability is below rounding


def power(n: int, first: float, second: float) -> float:
    """The probability that the exact McNemar test, two-sided at 5 %, tells two solvers apart on n layouts.

    Summed over the number of layouts that only one of the two attains (Duffy 1984, Biometrics 40, 1005-1015).

    Args:
        first, second: shares of the layouts that only the first, only the second attains.
    """
    mean = n * (first + second)
    reach = SPREAD * np.sqrt(mean) + SPREAD**2
    d = np.arange(max(0, int(mean - reach)), min(n, int(mean + reach)) + 1)
    level = (1.0 - CONFIDENCE) / 2.0
    most = binom.ppf(level, d, 0.5)  # the first count whose tail reaches the level
    most = np.where(binom.cdf(most, d, 0.5) <= level, most, most - 1)  # the test rejects up to here, at either end
    share = first / (first + second)
    rejects = binom.cdf(most, d, share) + binom.sf(d - most - 1, d, share)
    return float((binom.pmf(d, n, first + second) * rejects).sum())


def layouts_needed(a: float, b: float, nested: bool, wanted: float = POWER) -> int:
    """The layouts on which two solvers of these rates are told apart with probability `wanted`.

    Solvers fly the same layouts, so it matters on which the worse one succeeds.

    Args:
        nested: only on layouts on which the better one does, too: the least number. Else on any, independently.

    Raises:
        InputError: a rate out of 0 to 1, or rates that differ by less than 0.005.
    """
    for rate in (a, b):
        check_value(float(rate), Annotated[float, Within(0, 1)], "--power")
    high, low = max(a, b), min(a, b)
    if high - low < LEAST_DIFFERENCE:
        raise InputError("--power", f"rates that differ by at least {LEAST_DIFFERENCE:g}", f"{a:g} and {b:g}")
    shares = (high - low, 0.0) if nested else (high * (1.0 - low), low * (1.0 - high))
    few, many = 0, 8
    while power(many, *shares) < wanted:
        few, many = many, 2 * many
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if power(middle, *shares) >= wanted else (middle, many)
    return many


def in_words(a: float, b: float) -> str:
    """The numbers in words."""
    least, most = (layouts_needed(a, b, nested) for nested in (True, False))
    return (
        f"rates {a:g} and {b:g}: the exact McNemar test (5 %) tells them apart with a probability of {POWER:.0%} on\n"
        f"  {least} layouts, if the worse solver succeeds only where the better one does\n"
        f"  {most} layouts, if each succeeds independently of the other"
    )
