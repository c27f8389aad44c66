"""The mutation run: what it changes, that it tells killed from surviving mutants, and that it goes on after a kill."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.endurance import mutation
from benchmarks.endurance.mutants import Mutant, mutants_of, sampled
from benchmarks.endurance.mutation import KILLED, SURVIVED, TIMEOUT, Area, survivors, table

PYTHON = '''"""Half of x - 1."""

def half(x: int | None = None, *, most: float = 0.0) -> float:
    if x is not None and not x < 2:
        return -x * 0.5  # less - more
    return [most for most, _ in zip("a", "b", strict=True)][-1]
'''
OF_PYTHON = [
    (3, "0.0", "1.0"), (4, "is not", "is"), (4, "and", "or"), (4, "not ", ""), (4, "<", "<="), (4, "2", "3"),
    (5, "-", ""), (5, "*", "/"), (5, "0.5", "1.0"), (6, "1", "2"),
]  # fmt: skip
IN_C = """/* a - b */
#include <math.h>
#define MOST 0x1p-3
double half(double x, const V *p) {
    if (x <= 2 && !(x != 1e-3f)) x += 0.5 * p[0xFFu]; // a * b
    for (int i = 0; i < 10; i++) x = ~i | i;
}
"""
OF_C = [
    (3, "0x1p-3", "(2 * 0x1p-3)"), (5, "<=", "<"), (5, "2", "3"), (5, "&&", "||"), (5, "!", ""), (5, "!=", "=="),
    (5, "1e-3", "0.002"), (5, "+=", "-="), (5, "0.5", "1.0"), (5, "*", "/"), (5, "0xFF", "0x100"), (6, "0", "1"),
    (6, "<", "<="), (6, "10", "11"), (6, "~", ""), (6, "|", "&"),
]  # fmt: skip


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(("name", "text", "expected"), [("a.py", PYTHON, OF_PYTHON), ("a.c", IN_C, OF_C)])
def test_each_operator_number_and_condition_is_changed_once(tmp_path: Path, name: str, text: str, expected) -> None:
    made = mutants_of(tmp_path, written(tmp_path, name, text))
    assert [(m.line, m.old, m.new) for m in made] == expected
    for mutant in made:
        changed = mutant.applied(text.encode()).decode()
        row = changed.splitlines()[mutant.line - 1]
        assert row == f"{mutant.new}".join(_around(text.splitlines()[mutant.line - 1], mutant))
    assert len({mutant.key for mutant in made}) == len(made)


def _around(line: str, mutant: Mutant) -> tuple[str, str]:
    first = mutant.column - 1
    assert line[first:].startswith(mutant.old)
    return line[:first], line[first + len(mutant.old) :]


def test_a_sample_stays_where_other_lines_change(tmp_path: Path) -> None:
    before = sampled(mutants_of(tmp_path, written(tmp_path, "a.c", IN_C)), 8, seed=1)
    after = sampled(mutants_of(tmp_path, written(tmp_path, "a.c", "int zero = 0;\n" + IN_C)), 8, seed=1)
    assert len({m.key for m in before} & {m.key for m in after}) >= 7
    assert [m.key for m in sampled(mutants_of(tmp_path, tmp_path / "a.c"), 4, seed=1)] == [m.key for m in after[:4]]
    assert [m.key for m in sampled(mutants_of(tmp_path, tmp_path / "a.c"), 8, seed=2)] != [m.key for m in after]


@pytest.fixture
def small(tmp_path: Path, monkeypatch) -> Path:
    """A repository of one file and its test, which passes after a while and ends no loop."""
    root = tmp_path / "repository"
    (root / "torchgco").mkdir(parents=True)
    (root / "tests").mkdir()
    written(root / "torchgco", "__init__.py", "")
    count = "def count(n):\n    i = 0\n    while i < n:\n        i = i + 1\n    return i * 1\n"
    written(root / "torchgco", "count.py", count)
    test = "from torchgco.count import count\n\n\ndef test_count():\n    assert count(3) == 3\n"
    written(root / "tests", "test_count.py", test)
    monkeypatch.setattr(mutation, "ROOT", root)
    monkeypatch.setattr(mutation, "COPIED", ("torchgco", "tests"))
    monkeypatch.setattr(mutation, "AREAS", (Area("counting", ("torchgco/*.py",), ("tests/test_count.py",)),))
    monkeypatch.setattr(mutation, "SPARE", 5.0)
    return root


@pytest.mark.slow
def test_mutants_are_killed_survive_or_never_end_and_a_killed_run_goes_on(small: Path, monkeypatch) -> None:
    records, text = small / "records.jsonl", (small / "torchgco" / "count.py").read_text()
    made = mutants_of(small, small / "torchgco" / "count.py")
    tried: list[Mutant] = []
    plain = mutation.Copy.try_out

    def noted(self: mutation.Copy, mutant: Mutant, limit: float) -> str:
        if len(tried) == 3:
            raise KeyboardInterrupt
        tried.append(mutant)
        return plain(self, mutant, limit)

    monkeypatch.setattr(mutation.Copy, "try_out", noted)
    with pytest.raises(KeyboardInterrupt):
        mutation.run(made, records)
    records.write_text(records.read_text() + '\n{"key": "cut o')
    monkeypatch.setattr(mutation.Copy, "try_out", plain)
    ends = mutation.run(made, records)
    assert {(m.old, m.new): ends[m.key] for m in made} == {
        ("0", "1"): SURVIVED, ("<", "<="): KILLED, ("+", "-"): TIMEOUT, ("1", "2"): KILLED, ("*", "/"): SURVIVED,
    }  # fmt: skip
    assert len(tried) == 3 and set(ends) == {m.key for m in made}
    assert (small / "torchgco" / "count.py").read_text() == text
    assert [line.split(" | ")[1] for line in table(made, ends, "")[2:]] == [str(len(made))] * 2


def test_the_page_keeps_the_reasons_of_survivors(tmp_path: Path, monkeypatch) -> None:
    made = mutants_of(tmp_path, written(tmp_path, "a.py", "a = 1 | 2\n"))
    ends = {mutant.key: SURVIVED for mutant in made}
    first = survivors(made, ends, "")
    assert len(first) == 5 and all(line.endswith("| not examined |") for line in first[2:])
    page = "\n".join(first).replace("a.py:1", "a.py:7").replace("not examined", "Same results: speed", 1)
    again = survivors(made, ends, page)
    reasons = ["Same results: speed |", "not examined |", "not examined |"]
    assert [line.rsplit(" | ", 1)[1] for line in again[2:]] == reasons
    assert len(survivors(made, {made[0].key: KILLED}, page)) == 2
    monkeypatch.setattr(mutation, "AREAS", (Area("a", ("a.py",), ()),))
    row = table(made, {**ends, made[1].key: KILLED, made[2].key: KILLED}, page)[-1]
    assert row == "| all | 3 | 2 | 0 | 1 | 1 | 67 % [21, 94] | 100 % [34, 100] |"
