"""Solvers are told apart in figures by colour-blind readers, too: where colours look alike, dashes differ."""

from itertools import combinations

import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tests.plotting.colours import APART, VISION, apart, contrast
from tests.trials import flights, trials
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting.distributions import clearance_figure, violation_figure
from torchgco.plotting.rates import sweep_figure
from torchgco.plotting.style import DASHES, KNOWN, PALETTE, solver_colours

SWEPT = "scenario.num_obstacles"


def test_distances_are_those_of_another_code() -> None:
    """colorspacious 1.1.2: cspace_convert to sRGB1+CVD of severity 100, clipped, and to CAM02-UCS."""
    known = {"trichromat": 62.366, "protanope": 49.087, "deuteranope": 56.207, "tritanope": 59.425}
    assert {vision: apart(*PALETTE[:2], vision) for vision in VISION} == pytest.approx(known, abs=0.01)
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)


@pytest.mark.parametrize("vision", VISION)
def test_colours_that_look_alike_have_different_dashes(vision: str) -> None:
    colours = dict.fromkeys([*KNOWN.values(), *PALETTE])
    assert set(colours) == set(DASHES) and len(colours) == 16
    alike = [pair for pair in combinations(colours, 2) if apart(*pair, vision) < APART]
    assert [pair for pair in alike if DASHES[pair[0]] == DASHES[pair[1]]] == []
    assert alike, "colours alone would do"


def figures() -> list[Figure]:
    rows = []
    for value in (10, 20):
        for name in ("gco", "al_ilqr"):
            rows += flights(name, [True, False], **{SWEPT: value})
    spread = [row | {"clearance": 0.1 * i, "violation": 1e-4 + i} for i, row in enumerate(rows)]
    return [
        sweep_figure(summarise(trials(*rows)), SWEPT),
        *(draw(trials(*spread)) for draw in (clearance_figure, violation_figure)),
    ]


def test_ratios_near_1_are_written_whole() -> None:
    figure = figures()[0]
    figure.draw_without_rendering()
    axis = figure.axes[-1].yaxis
    axis.axes.set_ylim(1.0, 1.0006)
    figure.draw_without_rendering()
    assert axis.get_offset_text().get_text() == ""


def test_lines_of_solvers_have_their_dashes_and_the_legend_shows_them() -> None:
    for figure in figures():
        handles = {
            text.get_text(): line
            for box in figure.legends
            for text, line in zip(box.get_texts(), box.get_lines(), strict=True)
        }
        for name, colour in solver_colours(["gco", "al_ilqr"]).items():
            wanted = Line2D([], [], linestyle=DASHES[colour]).is_dashed()
            drawn = [line for line in figure.axes[0].lines if to_hex(line.get_color()).upper() == colour]
            assert drawn and all(line.is_dashed() == wanted for line in [*drawn, handles[name]])
