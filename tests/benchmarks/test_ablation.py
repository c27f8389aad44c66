"""Variants of `gco`: every number is changed once, everywhere it stands, and the table counts what differs."""

import pytest

from benchmarks.causes import ablation
from benchmarks.causes.ablation import changed, noticed, options, table, variants, with_constant, with_option
from torchgco import presets
from torchgco.search import ClearChords, chords


def test_numbers_of_any_form_are_changed() -> None:
    assert changed((2, (0.5, {3: 4})), "doubled") == (4, (1.0, {3: 8})) and changed(5, "halved") == 2
    assert changed(True, "none") is False and changed("float32", "none") is None


@pytest.mark.parametrize("space", [2, 3])
def test_an_option_is_changed_wherever_it_stands_and_nothing_else(space: int) -> None:
    solver = presets.gco(space)
    other = with_option(solver, "ILQR.max_iterations", "doubled")
    for (name, old), (_, new) in zip(options(solver), options(other), strict=True):
        assert new == (2 * old if name == "ILQR.max_iterations" else old)
    doubled = with_option(solver, "ClearChords.rounds", "doubled")
    assert [row.rounds for row in doubled.passes if isinstance(row, ClearChords)] == [8]


def test_a_value_that_cannot_be_doubled_comes_nearer_to_one() -> None:
    assert with_option(presets.gco(3), "Follow.arrive", "doubled").passes.paths.follow.arrive == 0.95


def test_a_constant_is_changed_where_it_is_read(monkeypatch) -> None:
    monkeypatch.setattr(chords, "EXTRA", chords.EXTRA)  # is put back
    with_constant("torchgco.search.chords.EXTRA", "halved")
    assert chords.EXTRA == 0.55


def test_every_row_and_many_numbers_are_varied() -> None:
    found = variants()
    assert sum(kind == "row" for kind, _, _ in found) == len(presets.gco(3).passes)
    assert {("option", "Follow.pace", "doubled"), ("constant", "torchgco.search.chords.EXTRA", "halved")} <= set(found)
    assert not any("record" in name for _, name, _ in found)


def test_the_table_counts_what_differs() -> None:
    def flown(*costs: float) -> list[dict]:
        return [
            {"layout": str(i), "controls": str(c), "reached": c < 9, "sound": c < 9, "cost": c, "iterations": int(c)}
            for i, c in enumerate(costs)
        ]

    default, other = flown(2.0, 4.0, 6.0), flown(2.0, 3.9, 9.0)
    assert noticed(other, default) and not noticed(default[:2], default)
    values = {("", "default", ""): "", ("option", "A.b", "doubled"): "1"}
    text = table(dict(zip(values, (default, other), strict=True)), values)
    assert text.splitlines()[-1] == "| A.b | 1 | doubled | 3 | 2 | 2 (3) | 2 (3) | 2 (2) | 1.167 |"
    assert ablation.HEAD[0] in text
