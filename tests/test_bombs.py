"""A small file that promises much is one line, within seconds and little memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bombs import BOMBS, BYTES, SECONDS, attempt

SLOW = {name for name in BOMBS if "100 MB" in name}  # a million records are read, some seconds
CASES = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in BOMBS]


@pytest.mark.parametrize("name", CASES)
def test_a_small_file_that_promises_much_is_refused(name: str, tmp_path: Path) -> None:
    told, seconds, memory, size = attempt(name, tmp_path)
    assert ": expected " in told and "\n" not in told, told
    assert seconds < SECONDS and memory < BYTES / 1e6, (seconds, memory)
    assert size < 10e6
