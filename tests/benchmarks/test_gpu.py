"""The benchmark of GPUs: it says so where there is none, and its tables hold what solves have found."""

from __future__ import annotations

import time

import pytest
import torch

from benchmarks import gpu
from benchmarks.lib.page import cells_of
from tests.native.shim import Shim
from tests.native.test_cuda import needs_gxx
from torchgco.native.cuda.engine import OnDevice


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_device_it_says_so(capsys) -> None:
    assert gpu.main([]) == 0
    assert capsys.readouterr().out.strip() == gpu.NO_DEVICE


@pytest.mark.slow
@needs_gxx
def test_its_page_says_how_many_problems_have_the_bits_of_c(monkeypatch) -> None:
    bench = gpu.Bench(OnDevice(Shim, 1), time.monotonic() + 600, [2], [40], ["planar_random", "pendulum"])
    monkeypatch.setattr(gpu, "_seconds", lambda prepared: [prepared()(), 0.5][1])
    gpu.bits(bench, 2)
    for section in (gpu.samples, gpu.problems):
        section(bench, "planar_random")
    text = gpu.page(bench, "Nothing was checked.", "shim")
    assert "24 of 24 problems have the bits of C" in text and "Nothing was checked." in text
    assert [len(rows) for rows in bench.rows.values()] == [6, 2, 2]
    assert ["planar_random", "float32", "40", "500.00", "500.0", "1.0"] in cells_of(text)
