"""Settings of all tests: one thread each, because parallel test workers share the cores."""

import os
import signal
import threading
from collections.abc import Iterator

import pytest
import torch

from torchgco.native import kernels
from torchgco.native.compiler import find_compiler

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for processes that tests start
# Most tests spend more time in the compiler than in what it has made; see `as_shipped`.
os.environ.setdefault("TORCHGCO_CFLAGS", "-O1")
torch.set_num_threads(1)
# In the background of a shell Ctrl-C is ignored, also by all processes that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Native kernels compiled as for users, for tests of bits and of agreement between kernels."""
    monkeypatch.delenv("TORCHGCO_CFLAGS", raising=False)


@pytest.fixture
def seldom_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Native kernels that compile in half the time and solve up to 1.5 times as long, where forms are solved once."""
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-Og")


@pytest.fixture(params=["native", "eager"])
def native(request: pytest.FixtureRequest) -> Iterator[bool]:
    """Native and eager kernels in turn; True for native ones."""
    if request.param == "native" and find_compiler() is None:
        pytest.skip("no C compiler")
    kernels.use_native(request.param == "native")
    yield request.param == "native"
    kernels.use_native(True)
