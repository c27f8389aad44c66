"""Sample sizes against published values and against a count of all outcomes."""

from itertools import product
from math import comb, isnan

import pytest
from scipy.stats import binomtest

from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.experiments.reports.report import main
from torchgco.experiments.statistics.power import (
    paired_layouts,
    paired_power,
    power_table,
    unpaired_layouts,
    unpaired_power,
)


def test_the_two_proportion_test_needs_the_published_numbers() -> None:
    """The examples of R's `power.prop.test`: n = 76.7 for a power of 0.9, and power 0.740 for n = 50."""
    assert unpaired_layouts(0.5, 0.75, 0.05, 0.9) == 77
    assert unpaired_power(50, 0.5, 0.75, 0.05) == pytest.approx(0.740, abs=5e-4)


def test_the_exact_mcnemar_test_has_the_published_power() -> None:
    """O'Brien (2002), in the manual of G*Power: 50 pairs, shares 0.08 and 0.32, one-sided 0.05, power 0.8393."""
    assert paired_power(50, 0.32 - 0.08, 0.32 + 0.08, 0.10) == pytest.approx(0.839343, abs=5e-5)


@pytest.mark.parametrize(
    ("n", "gap", "share", "level"), [(9, 0.3, 0.5, 0.05), (12, 0.6, 0.7, 0.1), (7, 0.9, 0.9, 0.05)]
)
def test_the_power_is_that_of_the_test_in_a_report(n: int, gap: float, share: float, level: float) -> None:
    """Every outcome of n layouts with its probability, tested as the report tests it."""
    a, b = (share + gap) / 2, (share - gap) / 2
    power = 0.0
    for only_a, only_b in product(range(n + 1), repeat=2):
        if 0 < only_a + only_b <= n and binomtest(only_a, only_a + only_b).pvalue <= level:
            ways = comb(n, only_a) * comb(n - only_a, only_b)
            power += ways * a**only_a * b**only_b * (1 - share) ** (n - only_a - only_b)
    assert paired_power(n, gap, share, level) == pytest.approx(power, abs=1e-12)


@pytest.mark.parametrize(("gap", "share"), [(0.1, 0.1), (0.1, 0.26), (0.4, 0.5), (1.0, 1.0)])
def test_no_smaller_number_of_layouts_is_enough(gap: float, share: float) -> None:
    n = paired_layouts(gap, share, 0.05, 0.8)
    assert paired_power(n, gap, share, 0.05) >= 0.8
    assert all(paired_power(smaller, gap, share, 0.05) < 0.8 for smaller in range(1, n))


def test_pairs_of_the_data_give_their_discordant_share() -> None:
    a, b = [True] * 8 + [False] * 12, [True] * 5 + [False] * 10 + [True] * 5
    rows = [*flights("a", a), *flights("b", b), *flights("c", a)]
    table = power_table(0.9, 0.8, trials=trials(*rows))
    assert isnan(table["discordant"][0]) and table["discordant"].tolist()[1:] == pytest.approx([0.26, 0.4, 0.1])
    assert table["layouts"][2] > table["layouts"][1] > table["layouts"][3], "equal outcomes: the share is the gap"
    assert (table["power"] >= 0.8).all()


def test_the_command_needs_no_folder(capsys) -> None:
    assert main(["--power", "0.9", "0.8"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and lines[1].split()[-2:] == ["199", "0.800"]


@pytest.mark.parametrize(
    "words",
    [["0.5", "0.5"], ["1.5", "0.5"], ["nan", "0.5"], ["0.5", "1", "--level", "0"], ["0.5", "1", "--power-target", "1"]],
)
def test_bad_rates_get_one_line(words: list[str], capsys) -> None:
    assert main(["--power", *words]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(InputError):
        power_table(0.5, 0.5)


@pytest.mark.parametrize(
    "words",
    [
        ["0.5", "0.5000000001"], ["0", "1e-300"], ["0.5", "0.5009"], ["0.1", "0.2", "--level", "5e-324"],
    ],
)  # fmt: skip
def test_rates_that_nobody_can_tell_apart_end_in_one_line(words: list[str], capsys) -> None:
    assert main(["--power", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--power: expected rates that at most 1,000,000 layouts tell apart" in line


def test_pairs_that_need_too_many_layouts_are_refused_too() -> None:
    """Different layouts tell these rates apart, the same ones with outcomes that hardly agree don't."""
    assert unpaired_layouts(0.0, 1e-4, 0.05, 0.8) < 200_000
    with pytest.raises(InputError, match="1,000,000 layouts"):
        paired_layouts(1e-4, 0.5, 0.05, 0.8)
