"""The benchmark of calls: only the package's own functions count, and each case has a row."""

from __future__ import annotations

import pytest

from benchmarks.lib.page import cells_of
from benchmarks.speed import overhead
from torchgco.base.shapes import describe


def test_functions_of_the_package_are_counted() -> None:
    assert overhead.counted(lambda: [describe(1), describe(2), sum(map(abs, range(9)))]) >= 2
    assert overhead.counted(lambda: [len(str(i)) for i in range(9)]) == 0


@pytest.mark.slow
def test_each_case_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overhead, "started", lambda words, own: "1.5")
    head, *rows = cells_of(overhead.table(["bicycle", "first"], 1))
    assert tuple(head) == overhead.HEAD and [row[0].split(":")[0] for row in rows[:-1]] == ["bicycle"] * 4
    assert all(int(row[1]) > 0 and float(row[2]) <= float(row[3]) for row in rows[:-1])
    assert rows[-1][2] == "2"
