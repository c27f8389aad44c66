"""The benchmark of GPUs: it says so where there is none, and its tables hold what solves have found."""

from __future__ import annotations

import os
import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import gpu
from benchmarks.lib.page import cells_of
from tests.native.shim import Shim
from tests.native.test_cuda import needs_gxx
from torchgco.native.compiler import NativeError
from torchgco.native.cuda.engine import OnDevice


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_device_it_says_so(capsys) -> None:
    assert gpu.main([]) == 0
    assert capsys.readouterr().out.strip() == gpu.NO_DEVICE


def bench_of(load: Any, least: int = 1, **changes: Any) -> gpu.Bench:
    """Of two problems, and of forty samples."""
    return gpu.Bench(OnDevice(load, least), time.monotonic() + 600, [2], [40], ["planar_random", "pendulum"], **changes)


@pytest.mark.slow
@needs_gxx
def test_a_dry_run_writes_its_page(monkeypatch, tmp_path) -> None:
    """All parts in order, with g++ for the device."""
    monkeypatch.setattr(gpu, "_seconds", lambda prepared: [prepared()(), 0.5][1])
    monkeypatch.setattr(gpu, "_toolkits", lambda: [])
    monkeypatch.setenv("PATH", str(Path(str(shutil.which("g++"))).parent))
    bench, path = bench_of(Shim), tmp_path / "gpu.md"
    sections = [partial(gpu.bits, B=2), gpu.memcheck, *(partial(part, form="planar_random") for part in PARTS)]
    assert gpu.measure(bench, sections, "A device (driver 1, NVRTC 2, PyTorch 3)", path) == 0
    text = path.read_text()
    for told in ("24 of 24 problems have the bits of C", "A device (driver 1,", "at commit", "compute-sanitizer"):
        assert told in text
    assert [len(rows) for rows in bench.rows.values()] == [6, 2, 3] and not bench.failures
    assert ["planar_random", "float32", "40", "500.00", "500.0", "1.0"] in cells_of(text)


PARTS = gpu.samples, gpu.problems


def absent(text: str) -> Any:
    raise NativeError("no device")


@pytest.mark.slow
def test_what_the_cpu_solves_proves_nothing(tmp_path) -> None:
    """The CPU takes what a device refuses, and has the bits of C: no problem counts, and none has a speed."""
    bench, path = bench_of(absent), tmp_path / "gpu.md"
    bench.forms = ["pendulum"]
    sections = [partial(gpu.bits, B=2), *(partial(part, form="planar_random") for part in PARTS)]
    assert gpu.measure(bench, sections, "no device", path) == 1 and list(bench.rows) == [gpu.BITS]
    assert "0 of 16 problems have the bits of C" in path.read_text() and "solved by C on the CPU" in path.read_text()


def test_a_part_that_fails_leaves_the_others(tmp_path) -> None:
    def bits(bench: gpu.Bench) -> None:
        bench.row(gpu.BITS, "pendulum", "al_ilqr", 2, 2, 2, "0.0e+00")

    def broken(bench: gpu.Bench) -> None:
        raise RuntimeError("CUDA error: an illegal memory access was encountered\nmore")

    path = tmp_path / "gpu.md"
    assert gpu.measure(bench_of(Shim), [bits, broken], "a device", path) == 1
    assert "2 of 2 problems" in path.read_text() and "Broken failed: CUDA error: an illegal" in path.read_text()
    assert gpu.measure(bench_of(Shim), [bits], "a device", None) == 0


def test_a_checker_that_hangs_is_stopped(tmp_path, monkeypatch) -> None:
    checker = tmp_path / "compute-sanitizer"
    checker.write_text("#!/bin/sh\nexec sleep 60\n")
    checker.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    bench = bench_of(Shim)
    bench.deadline = time.monotonic() + 4.0
    gpu.memcheck(bench)
    assert "stopped after 1 s" in bench.checked
