"""No native kernel reads or writes beyond its arrays: GCC's address sanitizer watches them in another process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WATCHED = """#!/bin/sh
for word; do shift; [ "$word" = -O3 ] && word=-O1; set -- "$@" "$word"; done
exec gcc "$@" -fsanitize=address
"""


def sanitizer() -> str | None:
    """GCC's library, which has to be loaded before Python's own memory functions; None where there is none."""
    if shutil.which("gcc") is None:
        return None
    found = subprocess.run(["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    return found if Path(found).is_absolute() else None


@pytest.mark.slow
@pytest.mark.skipif(sanitizer() is None, reason="no GCC with its address sanitizer")
def test_no_kernel_reads_or_writes_beyond_its_arrays(tmp_path: Path) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text(WATCHED)
    compiler.chmod(0o755)
    watched = {
        "LD_PRELOAD": str(sanitizer()), "ASAN_OPTIONS": "detect_leaks=0", "TORCHGCO_CC": str(compiler),
        "TORCHGCO_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT),
    }  # fmt: skip
    words = [sys.executable, "-m", "tests.native.overruns"]
    done = subprocess.run(words, cwd=ROOT, env={**os.environ, **watched}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:3000]
    assert done.stdout.split() == ["called"] * 3
