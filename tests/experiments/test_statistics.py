from math import inf, isnan, nan, sqrt

import pandas as pd
import pytest

from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import summarise


def wilson(count: int, n: int) -> tuple[float, float]:
    """The score interval from its closed form."""
    z = 1.959963984540054
    rate = count / n
    middle = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    return middle - half, middle + half


def only(summary: pd.DataFrame) -> pd.Series:
    assert len(summary) == 1
    return summary.iloc[0]


def test_a_row_per_scenario_model_and_solver_in_order_of_appearance() -> None:
    table = trials({"solver": "zeta"}, {"solver": "alpha"}, {"solver": "zeta", "layout": 1}, {"scenario": "walls"})
    summary = summarise(table)
    assert summary["solver"].tolist() == ["zeta", "alpha", "gco"]
    assert summary["scenario"].tolist() == ["forest", "forest", "walls"]
    assert summary["n"].tolist() == [2, 1, 1]


@pytest.mark.parametrize(("hits", "n"), [(30, 32), (0, 7), (7, 7), (1, 3)])
def test_rates_have_their_wilson_interval(hits: int, n: int) -> None:
    row = only(summarise(trials(*flights("gco", [i < hits for i in range(n)]))))
    assert (row["reached_count"], row["reached_n"]) == (hits, n)
    assert row["reached_rate"] == pytest.approx(hits / n)
    low, high = wilson(hits, n)
    assert row["reached_low"] == pytest.approx(low, abs=1e-9)
    assert row["reached_high"] == pytest.approx(high, abs=1e-9)


def test_an_invalid_start_counts_as_a_failure_in_every_rate() -> None:
    invalid = {"layout": 1, "status": "INVALID_START", "violation": nan, "cost": nan, "iterations": 0}
    row = only(summarise(trials({}, {**invalid, "success": pd.NA})))
    assert (row["n"], row["invalid"]) == (2, 1)
    for name in ("feasible", "reached", "success", "clear_95"):
        assert (row[f"{name}_count"], row[f"{name}_n"]) == (1, 2)
    assert row["iterations_median"] == 40, "nothing was solved there, so it doesn't make the solver look fast"


def test_success_is_counted_over_the_rows_where_it_is_defined() -> None:
    rows = [{"success": True}, {"layout": 1, "success": pd.NA}, {"layout": 2, "success": False}]
    row = only(summarise(trials(*rows)))
    assert (row["success_count"], row["success_n"], row["success_rate"]) == (1, 2, 0.5)
    assert row["reached_n"] == 3


def test_success_defined_nowhere_has_no_rate() -> None:
    rows = [{"success": pd.NA}, {"layout": 1, "success": pd.NA, "status": "INVALID_START"}]
    row = only(summarise(trials(*rows)))
    assert row["success_n"] == 0
    assert isnan(row["success_rate"]) and isnan(row["success_low"]) and isnan(row["success_high"])


def test_a_violation_that_is_no_number_counts_as_infinite() -> None:
    rows = [{"layout": i, "violation": value} for i, value in enumerate([1e-4, nan, nan, 1e-3, 1e-2])]
    row = only(summarise(trials(*rows)))
    assert row["violation_median"] == 1e-2
    assert only(summarise(trials(*rows[1:3])))["violation_median"] == inf


def test_costs_over_the_reached_and_over_all_that_are_finite() -> None:
    costs = [(10.0, True), (20.0, True), (60.0, False), (nan, False), (inf, False)]
    rows = [{"layout": i, "cost": cost, "reached": hit} for i, (cost, hit) in enumerate(costs)]
    row = only(summarise(trials(*rows)))
    assert (row["cost_median_reached"], row["cost_median"], row["cost_n"]) == (15, 20, 3)


def test_a_missing_effort_is_not_averaged_away() -> None:
    row = only(summarise(trials({"iterations": 10}, {"layout": 1, "iterations": nan})))
    assert isnan(row["iterations_median"])
    assert row["outer_iterations_median"] == 10 and row["guided_median"] == 2 and row["seconds_median"] == 0.1


def test_times_are_of_the_trials_that_have_one() -> None:
    row = only(summarise(trials({"seconds": 0.1}, {"layout": 1, "seconds": nan}, {"layout": 2, "seconds": 0.3})))
    assert (row["seconds_median"], row["seconds_n"]) == (0.2, 2)
    row = only(summarise(trials({"seconds": nan})))
    assert isnan(row["seconds_median"]) and row["seconds_n"] == 0


def test_all_seeds_of_a_group_are_named() -> None:
    assert only(summarise(trials({"seed": 3}, {"seed": 0})))["seed"] == "3 0"


@pytest.mark.parametrize("column", ["status", "reached", "violation", "seconds"])
def test_a_missing_column_is_named(column: str) -> None:
    with pytest.raises(InputError, match=column):
        summarise(trials({}).drop(columns=column))


def test_an_empty_table_is_refused() -> None:
    with pytest.raises(InputError, match="at least one row"):
        summarise(trials({}).iloc[:0])


A = [True, True, True, True, True, True, False, False]
B = [True, False, False, False, False, False, True, False]


def paired(table: pd.DataFrame, outcome: str = "reached") -> pd.Series:
    """The row of the two solvers in a table, by one outcome."""
    return only(compare(table).query("outcome == @outcome"))


def test_pairs_are_counted_by_who_attained_the_outcome() -> None:
    result = paired(trials(*flights("a", A), *flights("b", B)))
    assert (result.n, result.both, result.only_a, result.only_b, result.neither) == (8, 1, 5, 1, 1)
    assert result.difference == pytest.approx(4 / 8)
    # Two-sided: 0, 1, 5 or 6 heads of 6 throws of a fair coin.
    assert result.p_value == pytest.approx((1 + 6 + 6 + 1) / 2**6)


def test_pairs_are_matched_by_trial_not_by_position() -> None:
    table = trials(*flights("a", A), *flights("b", B))
    shuffled = pd.concat([rows.sample(frac=1, random_state=1) for _, rows in table.groupby("solver")])
    pd.testing.assert_frame_equal(compare(shuffled), compare(table))


def test_swapping_the_solvers_swaps_the_counts() -> None:
    forth = paired(trials(*flights("a", A), *flights("b", B)))
    back = paired(trials(*flights("b", B), *flights("a", A)))
    assert (back.only_a, back.only_b) == (forth.only_b, forth.only_a)
    assert back.difference == -forth.difference and back.p_value == forth.p_value


def test_solvers_that_agree_everywhere_give_no_evidence() -> None:
    result = paired(trials(*flights("a", A), *flights("b", A)))
    assert (result.only_a, result.only_b, result.p_value, result.difference) == (0, 0, 1.0, 0.0)


def test_the_same_layout_under_another_seed_is_another_trial() -> None:
    result = paired(trials(*flights("a", A), *flights("b", B, seed=1)))
    assert (result.n, result.unmatched) == (0, 16)
    assert isnan(result.difference)


def test_trials_that_cannot_be_compared_are_counted() -> None:
    rows = [
        *flights("a", [True, True, True]),
        *flights("b", [False, False]),
        {"solver": "b", "layout": 2, "success": pd.NA},
        {"solver": "b", "layout": 3},
    ]
    result = paired(trials(*rows), "success")
    assert (result.n, result.only_a, result.undefined, result.unmatched) == (2, 2, 1, 1)


def test_an_invalid_start_is_a_failure_in_a_pair_too() -> None:
    rows = [*flights("a", [True]), *flights("b", [True], status="INVALID_START")]
    assert paired(trials(*rows)).only_a == 1


def test_two_rows_for_one_trial_are_refused() -> None:
    with pytest.raises(InputError, match="layout 0"):
        compare(trials(*flights("a", [True]), *flights("a", [True]), *flights("b", [True])))


def test_the_table_compares_a_solver_with_each_other_one_in_each_task() -> None:
    rows = [
        *flights("a", A),
        *flights("b", B),
        *flights("c", A),
        *flights("a", A, scenario="walls"),
        *flights("b", A, scenario="walls"),
        *flights("b", B, scenario="alone"),
    ]
    table = compare(trials(*rows))
    seen = list(zip(table["scenario"], table["solver_b"], table["outcome"], strict=True))
    outcomes = ("feasible", "reached", "success")
    tasks = [("forest", "b"), ("forest", "c"), ("walls", "b")]
    assert seen == [(scenario, other, name) for scenario, other in tasks for name in outcomes]
    assert table["only_a"].tolist() == [5] * 3 + [0] * 6
    assert set(table["solver_a"]) == {"a"} and set(table["n"]) == {8}


def test_the_table_of_a_solver_alone_has_columns_but_no_rows() -> None:
    table = compare(trials(*flights("a", A)))
    assert table.empty and "p_value" in table.columns
