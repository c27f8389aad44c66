"""A small file that promises much is one line, within seconds and little memory."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.bombs import BOMBS, BYTES, SECONDS, attempt, run
from tests.slow import mostly
from torchgco import InputError
from torchgco.experiments.reports.finished import Study
from torchgco.experiments.results.limits import read_npz

SLOW = {name for name in BOMBS if "100 MB" in name}  # some seconds
SLOW |= {"trials.parquet, pages of 1.2 GB that name 100 bytes"}


@pytest.mark.sampled(7)
@pytest.mark.parametrize("name", mostly(BOMBS, *SLOW))
def test_a_small_file_that_promises_much_is_refused(name: str, tmp_path: Path) -> None:
    told, seconds, memory, size = attempt(name, tmp_path)
    assert ": expected " in told and "\n" not in told, told
    assert seconds < SECONDS and memory < BYTES / 1e6, (seconds, memory)
    assert size < 10e6


@pytest.mark.parametrize("name", ["layouts.npz", "trials.parquet", "study.json", "done", "solutions.npz"])
@pytest.mark.parametrize("kind", ["a pipe", "a link to /dev/zero"])
def test_what_has_no_end_is_no_file_of_a_run(name: str, kind: str, tmp_path: Path) -> None:
    """A reader would wait for a pipe, or fill its memory with zeros."""

    def late(*_: Any) -> None:
        raise TimeoutError("it waits, or reads on")

    path = run(tmp_path) / name
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "a pipe" else path.symlink_to("/dev/zero")
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(2)
    try:
        with pytest.raises((InputError, OSError), match=r"no regular file|RUN: expected"):
            read_npz(path) if name == "solutions.npz" else Study.read(tmp_path)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
