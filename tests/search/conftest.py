"""Fixtures of the tests of restarts."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.search.gates import CLOSED, PASSES, SHORT, SOLVER, Solve, gates
from torchgco import AugmentedLagrangian, Solution
from torchgco.search.candidates import LINE_SEARCH


@pytest.fixture
def solves(monkeypatch) -> Iterator[list[Solve]]:
    """All local solves made after this fixture, in order; those that refine candidates are left out."""
    made, iterate = [], AugmentedLagrangian.outer_loop

    def noted(self, call, guidance=None, penalty=None, *rest, **options):
        end = iterate(self, call, guidance, penalty, *rest, **options)
        if self.inner.line_search != LINE_SEARCH:
            made.append(Solve(call, guidance, penalty, end))
        return end

    monkeypatch.setattr(AugmentedLagrangian, "outer_loop", noted)
    yield made


@pytest.fixture(scope="module")
def whole() -> Solution:
    """A solution with attempts along a path, from samples, and into the goal."""
    solution = SOLVER.solve(*gates(), seed=3)
    assert solution.guided[PASSES] == solution.guided[SHORT] == 1 < int(solution.guided[CLOSED])
    return solution
