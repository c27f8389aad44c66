"""The columns of the benchmark of stiff models: how far a rod drifts, and what a first solve compiles."""

import math

import pytest
import torch

from benchmarks.families.stiff import CASES, HEAD, compiling, row
from benchmarks.lib import RESULTS


def test_drift_is_the_largest_departure_from_the_length_of_the_rod():
    X = torch.tensor([[0.0, -1.0, 3.0, 3.0], [0.6, 0.8, 0.0, 0.0], [0.0, 0.75, 0.0, 0.0], [1.2, 0.0, 9.0, 0.0]])
    assert CASES["pendulum, index 1"].drift(X.double()) == 0.25
    assert math.isnan(CASES["Robertson"].drift(X.double()))


@pytest.mark.slow  # compiles steps of two implicit models
def test_a_row_says_how_far_the_rod_drifts_and_what_was_compiled(monkeypatch):
    monkeypatch.setattr("benchmarks.families.stiff.compiling", lambda name, method: 2.5)
    cells = dict(zip(HEAD, row("pendulum, index 2", CASES["pendulum, index 2"], "radau5", False), strict=True))
    assert cells["status"] == "CONVERGED" and cells["compiles, s"] == "2.5"
    assert 0.0 < float(cells["drift"]) < 1e-8  # of index 2, positions are kept on the circle to rounding
    index_1 = dict(zip(HEAD, row("pendulum, index 1", CASES["pendulum, index 1"], "radau5", False), strict=True))
    assert float(cells["drift"]) < float(index_1["drift"]) < 1e-5


def test_the_page_has_the_columns_that_the_command_writes():
    text = (RESULTS / "stiff.md").read_text()
    assert f"| {' | '.join(HEAD)} |" in text


@pytest.mark.slow  # compiles with the default flags
def test_a_first_solve_in_a_process_of_its_own_compiles():
    assert compiling("lag, 1 of a stage", "rk4") > 0.0
