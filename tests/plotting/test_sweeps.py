"""Figures of rates and costs against swept variables."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from tests.trials import flights, missions, trials
from torchgco.experiments.results.kinds import summarise_missions
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting.rates import sweep_figure
from torchgco.plotting.style import solver_colours

VARIABLE = "scenario.num_obstacles"


def drawn(values, other=(None,), variable: str = VARIABLE, **more) -> tuple[Figure, pd.DataFrame]:
    """A sweep in which `gco` reaches 3 of 4 layouts at the first value, 2 at the second, ..., and `mine` all."""
    rows = []
    for gust in other:
        extra = {} if gust is None else {"mission.gust": gust}
        for i, value in enumerate(values):
            held = {variable: value, **extra, **more}
            rows += flights("gco", [True] * (3 - i) + [False] * (1 + i), **held) + flights("mine", [True] * 4, **held)
    summary = summarise(trials(*rows))
    return sweep_figure(summary, variable), summary


def test_a_line_per_solver_runs_through_its_rates() -> None:
    figure, summary = drawn([40, 10, 20])
    assert [ax.get_ylabel().split(",")[0] for ax in figure.axes] == [
        "feasible", "reached", "success", "cost / best"
    ]  # fmt: skip
    ax, colours = figure.axes[1], solver_colours(summary["solver"])
    lines = {line.get_color(): line.get_xydata().tolist() for line in ax.lines}
    assert lines[colours["gco"]] == [[10, 0.5], [20, 0.25], [40, 0.75]]
    assert lines[colours["mine"]] == [[10, 1], [20, 1], [40, 1]]
    band = np.concatenate([path.vertices[:, 1] for path in ax.collections[0].get_paths()])
    gco = summary[summary["solver"] == "gco"]
    assert (band.min(), band.max()) == pytest.approx((gco["reached_low"].min(), gco["reached_high"].max()))
    assert [label.get_text() for label in ax.get_xticklabels()] == ["10", "20", "40"]


def test_other_swept_variables_have_rows_of_panels() -> None:
    figure, _ = drawn([10, 20], other=(0.0, 0.5))
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert len(titles) == 8 and titles[0].endswith("gust 0") and "gust 0.5" in titles[4]


def test_a_variable_of_text_gives_groups_of_bars() -> None:
    figure, _ = drawn(["shifted", "reset"], variable="mission.planner.multipliers")
    ax = figure.axes[1]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["shifted", "reset"]
    assert sorted(bar.get_height() for bar in ax.patches) == [0.5, 0.75, 1, 1]


def test_an_outcome_defined_nowhere_has_no_panel_and_costs_need_no_best() -> None:
    rows = [row | {VARIABLE: 10, "success": pd.NA, "best_cost": np.nan} for row in flights("gco", [True, False])]
    figure = sweep_figure(summarise(trials(*rows)), VARIABLE)
    assert [ax.get_ylabel() for ax in figure.axes][1:] == ["reached, 95 % interval", "median cost, reached"]
    assert figure.axes[-1].lines[0].get_ydata().tolist() == [100]


@pytest.mark.parametrize(("values", "scale"), [([1, 10, 1000], "log"), ([0, 10, 1000], "linear"), ([10, 40], "linear")])
def test_wide_ranges_get_a_logarithmic_axis(values: list, scale: str) -> None:
    figure, _ = drawn(values)
    assert {ax.get_xscale() for ax in figure.axes} == {scale}


def test_a_task_that_lacks_the_variable_or_a_solver_is_drawn_as_far_as_it_goes() -> None:
    rows = [*flights("gco", [True], **{VARIABLE: 10}), *flights("b", [True], **{VARIABLE: 20})]
    rows += flights("gco", [True], scenario="walls", **{VARIABLE: np.nan})
    summary = summarise(trials(*rows))
    figure = sweep_figure(summary, VARIABLE)
    assert [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")] == ["forest (quadrotor)"]
    assert [len(line.get_xdata()) for line in figure.axes[0].lines] == [1, 1]


def test_a_cost_that_no_trial_has_gets_no_panel() -> None:
    rows = [row | {VARIABLE: 10, "cost": np.nan, "best_cost": np.nan} for row in flights("gco", [True, False])]
    figure = sweep_figure(summarise(trials(*rows)), VARIABLE)
    assert [ax.get_ylabel().split(",")[0] for ax in figure.axes] == ["feasible", "reached", "success"]


def test_missions_have_the_outcomes_that_occur_and_flight_times() -> None:
    variable = "mission.disturbance.wind"
    rows = [*missions("gco", "RRRC", **{variable: 0.0}), *missions("gco", "RRCC", **{variable: 1.0})]
    figure = sweep_figure(summarise_missions(trials(*rows)), variable)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["reached, 95 % interval", "collision, 95 % interval", "median flight time, reached [s]"]
    drawn = [np.asarray(ax.lines[0].get_ydata()).tolist() for ax in figure.axes]
    assert drawn == [[0.75, 0.5], [0.25, 0.5], [6.0, 5.5]]
    assert {ax.get_xlabel() for ax in figure.axes} == {"wind [N]"}
    lost = trials(*missions("gco", "CC", **{variable: 0.0}))
    assert [ax.get_ylabel().split(",")[0] for ax in sweep_figure(summarise_missions(lost), variable).axes] == [
        "reached", "collision"
    ]  # fmt: skip
