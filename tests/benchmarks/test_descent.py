"""Powered descents: where they begin, what the relaxation bounds, and what the flight misses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchgco
from benchmarks.families.descent import DRY, LEAST, MOST, PER_THRUST, WET, flown, problem, relaxation, starts


def test_a_start_depends_on_its_number_and_seed_alone() -> None:
    few, more = starts(2, 101), starts(4, 101)
    assert np.array_equal(few, more[:2]) and not np.array_equal(few, starts(2, 102))
    assert (np.hypot(more[:, 0], more[:, 1]) < 1.2 * more[:, 2]).all() and (more[:, 6] == WET).all()


@pytest.mark.slow
def test_a_descent_takes_the_fuel_of_its_relaxation() -> None:
    """From no guess, its mass that of its thrust; a start from which no time serves has no bound."""
    x0 = starts(2, 101)
    stated, least = problem(x0, 30, 60.0), relaxation(30)
    found, bound = torchgco.solve(stated), least(x0[0])
    assert [status.name for status in found.statuses] == ["CONVERGED"] * 2
    fuel, size = WET - found.X[:, -1, 6], found.U.norm(dim=-1)
    assert bound.loose < 1e-4 and float(fuel[0]) == pytest.approx(bound.fuel, rel=2e-3)
    assert float(found.duration[0]) == pytest.approx(bound.duration, rel=1e-2)
    torch.testing.assert_close(fuel, PER_THRUST * size.mean(-1) * found.duration, rtol=1e-9, atol=0)
    assert float(size.min()) > LEAST - 1e-3 and float(size.max()) < MOST + 1e-3
    end, outside = flown(found)
    assert float(end.max()) < 1e-4 and float(outside.max()) < 0.5
    low = np.array([0.0, 0.0, 200.0, 0.0, 0.0, -90.0, DRY + 1.0])  # too low to stop
    assert least(low).fuel == math.inf
