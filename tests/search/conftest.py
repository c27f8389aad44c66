"""Fixtures of the tests of restarts."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.search.gates import CLOSED, PASSES, SHORT, SOLVER, Solve, gates
from torchgco import (
    AugmentedLagrangian,
    Solution,
)


@pytest.fixture
def solves(monkeypatch) -> Iterator[list[Solve]]:
    """All local solves made after this fixture, in order."""
    made, iterate = [], AugmentedLagrangian.iterate

    def noted(self, call, guidance=None, penalty=None, *rest, **options):
        made.append(Solve(call, guidance, penalty, iterate(self, call, guidance, penalty, *rest, **options)))
        return made[-1].end

    monkeypatch.setattr(AugmentedLagrangian, "iterate", noted)
    yield made


@pytest.fixture(scope="module")
def whole() -> Solution:
    """A solution with attempts along a path, from samples, and into the goal."""
    solution = SOLVER.solve(*gates(), seed=3)
    assert solution.guided[PASSES] == 1 < int(solution.guided[SHORT]) and int(solution.guided[CLOSED]) > 1
    return solution
