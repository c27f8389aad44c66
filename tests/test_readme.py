"""The README's example runs as printed; test_documents.py tests links and commands."""

import re
from pathlib import Path

import pytest
import torch

from torchgco import Problem, Solution, Status, judge

ROOT = Path(__file__).resolve().parents[1]
README, WORDS = (ROOT / "README.md").read_text(), (ROOT / "docs" / "words.md").read_text()


def test_the_python_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # it writes a picture
    (code,) = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    names: dict[str, object] = {}
    exec(code, names)
    problem, solution = names["problem"], names["solution"]
    assert isinstance(problem, Problem) and isinstance(solution, Solution)
    assert solution.statuses == [Status.CONVERGED] * 2
    assert bool(judge(problem, solution.U, torch.tensor([1.0, 0.4], dtype=torch.float64), 0.3).reached.all())


def test_every_status_is_explained() -> None:
    for status in Status:
        assert status is Status.RUNNING or f"| `{status.name}` |" in WORDS
