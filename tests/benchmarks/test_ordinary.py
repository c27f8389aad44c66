"""The benchmark of ordinary problems: families that can be drawn, and a whole table."""

from __future__ import annotations

import pytest
import torch

from benchmarks.families import ordinary
from benchmarks.families.ordinary_problems import FAMILIES, B


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_is_drawn_by_its_seed(name: str) -> None:
    one, same, other = (FAMILIES[name](seed) for seed in (7, 7, 8))
    assert one.B == B and torch.equal(one.x0, same.x0)
    X, U = (torch.full((B, one.N + k, size), 0.1, dtype=torch.float64) for k, size in ((1, one.n), (0, one.m)))
    rows = [[part.value(X, U) for part in problem.constraints] for problem in (one, same, other)]
    assert all(map(torch.equal, rows[0], rows[1]))
    step = [problem.dynamics.step(problem.x0, U[:, 0]) for problem in (one, other)]
    assert not (torch.equal(*step) and all(map(torch.equal, rows[0], rows[2])))


def test_the_finish_shows_in_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert ordinary.main(["--families", "bryson_denham", "--seeds", "3"]) == 0
    lines = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()]
    assert [len(line) for line in lines] == [len(ordinary.HEAD)] * 4
    assert [cell.strip() for cell in lines[2][:4]] == ["bryson_denham", "8", "0", "8"]
    assert lines[3][3].strip().startswith("8 [")
