"""The general benchmark: families that can be drawn."""

from __future__ import annotations

import pytest
import torch

from benchmarks.families.general_problems import FAMILIES


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_is_drawn_by_its_seed(name: str) -> None:
    family = FAMILIES[name]
    drawn, same, other = (family.drawn(seed) for seed in (7, 7, 8))
    one = drawn.problem
    assert one.B == family.B and drawn.end.shape == one.x0.shape
    assert torch.equal(one.x0, same.problem.x0) and torch.equal(drawn.end, same.end)
    X, U = (torch.full((one.B, one.N + k, size), 0.1, dtype=torch.float64) for k, size in ((1, one.n), (0, one.m)))
    rows = [[part.value(X, U) for part in p.constraints] for p in (one, same.problem, other.problem)]
    assert all(map(torch.equal, rows[0], rows[1]))
    moves = [[p.x0, p.dynamics.step(p.x0, U[:, 0])] for p in (one, other.problem)]
    assert not all(map(torch.equal, [*moves[0], *rows[0]], [*moves[1], *rows[2]]))


def test_there_are_four_sets() -> None:
    counts = [sum(family.B for family in FAMILIES.values() if family.set == number) for number in (1, 2, 3, 4)]
    assert counts == [80, 104, 160, 20]
