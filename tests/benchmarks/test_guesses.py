"""The benchmark of several guesses."""

import pytest

from benchmarks.speed import guesses


def test_eight_guesses_are_counted_beside_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guesses, "NAMES", ("pendulum",))
    head, _, row = guesses.text(4, 3, 1, 1, "interior_point").splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    assert cells["solved by one, by all"] == "4, 4 of 4" and cells["dearer"] == "0"
    assert float(cells["ms of one"]) > 0 and float(cells["ratio |"].strip(" |")) > 0
