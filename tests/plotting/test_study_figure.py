"""The figure of a whole study at a paper's size: what it shows, and that all of it is inside."""

from __future__ import annotations

import io
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from tests.plotting.straight import study_figure
from tests.plotting.test_layouts import plane, straight
from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting.study_figure import PRINTS, Columns
from torchgco.plotting.style import save

COSTS = {"gco": [100.0, 100.0, 130.0, 100.0], "al_ilqr": [150.0, 110.0, 100.0, 90.0]}
REACHED = {"gco": [True] * 4, "al_ilqr": [True, True, True, False]}
BEST = 100.0


def table() -> pd.DataFrame:
    rows = []
    for solver, costs in COSTS.items():
        rows += [row | {"cost": cost} for row, cost in zip(flights(solver, REACHED[solver]), costs, strict=True)]
    return trials(*rows).assign(best_cost=BEST)


def drawn(columns: Columns, rows: pd.DataFrame | None = None) -> Figure:
    rows = table() if rows is None else rows
    states = {"gco": straight(4), "al_ilqr": straight(4)}
    return study_figure(plane(4), states, rows, summarise(rows), columns)


@pytest.mark.parametrize("columns", get_args(Columns))
def test_it_is_as_wide_as_the_paper_and_nothing_is_cut_off(columns: Columns) -> None:
    figure, form = drawn(columns), PRINTS[columns]
    assert figure.get_figwidth() == form.width
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        assert not text.get_text() or text.get_fontsize() in (form.font, form.font - 0.5), text
    figure.draw_without_rendering()
    whole = figure.bbox.padded(1.0)
    for ax in figure.axes:
        box = ax.get_tightbbox()
        assert box is not None and whole.contains(*box.min) and whole.contains(*box.max), ax.get_xlabel()
    boxes = [ax.get_position() for ax in figure.axes]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    (legend,) = figure.legends
    assert max(box.y1 for box in boxes) * figure.bbox.height <= legend.get_window_extent().y0 + 1


def test_maps_rates_and_costs_are_those_of_the_study() -> None:
    *maps, rates, costs = drawn("two").axes
    assert [ax.get_title(loc="left") for ax in maps] == [f"layout {i}" for i in range(4)]
    summary, outcomes = summarise(table()).set_index("solver"), ("feasible", "reached", "success")
    bars = {round(float(line[0].get_ydata()[0]), 6) for line in (held.lines for held in rates.containers)}
    assert bars == {round(float(summary.loc[s, f"{o}_rate"]), 6) for s in COSTS for o in outcomes}
    first, second = (np.asarray(line.get_xydata()) for line in costs.lines)
    np.testing.assert_allclose(first[1:-1], [[1.0, 0.25], [1.0, 0.5], [1.0, 0.75], [1.3, 1.0]])
    np.testing.assert_allclose(second[1:-1], [[1.0, 0.25], [1.1, 0.5], [1.5, 0.75]])  # 90 wasn't reached


def test_a_solver_that_reached_nothing_has_a_line_at_zero() -> None:
    rows = table()
    rows.loc[rows["solver"] == "al_ilqr", "reached"] = False
    line = drawn("one", rows).axes[-1].lines[1]
    assert not np.asarray(line.get_ydata()).any()


def test_a_pdf_holds_text_and_has_the_same_bytes_again() -> None:
    written = [io.BytesIO() for _ in range(2)]
    for file in written:
        save(drawn("one"), file, form="pdf")
    assert written[0].getvalue() == written[1].getvalue()
    assert written[0].getvalue().startswith(b"%PDF") and b"/FontFile2" in written[0].getvalue()


def test_what_does_not_fit_is_refused() -> None:
    wrong: Any = "three"
    with pytest.raises(InputError, match="one or two"):
        drawn(wrong)
    with pytest.raises(InputError, match="one scenario and model"):
        drawn("one", pd.concat([table(), table().assign(scenario="walls")]))
