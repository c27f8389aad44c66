"""Drawn models, costs and constraints: each is solved as PyTorch's kernels solve it, or refused in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("first", "count"), [(0, 2), *(pytest.param(k, 25, marks=pytest.mark.slow) for k in range(1000, 1200, 25))]
)
def test_a_users_code_is_solved_as_it_is_or_refused(first: int, count: int) -> None:
    command = [sys.executable, "-m", "tests.fuzz.user_code", str(first), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]  # a crash of the process is a failure, too
    lines = done.stdout.splitlines()
    assert len(lines) == count
    assert [line for line in lines if line.split()[1] not in ("equal", "refused")] == []
