"""Settings of all tests: one thread each, because parallel test workers share the cores."""

import gc
import logging
import os
import signal
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import omegaconf.base
import pytest
import torch
import yaml

from torchgco import kernels
from torchgco.experiments.config import build, checks
from torchgco.native.compiler import find_compiler

ROOT = Path(__file__).parents[1]
os.environ.setdefault("OMP_NUM_THREADS", "1")  # for processes that tests start
# Most tests spend more time in the compiler than in what it has made: with -Og it takes a third of the time, and solves
# up to twice as long, with the same bits (tests/native/test_units.py).
os.environ.setdefault("TORCHGCO_CFLAGS", "-Og")
torch.set_num_threads(1)
gc.disable()  # until all tests are collected: what is made on the way stays
# In the background of a shell Ctrl-C is ignored, also by all processes that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _parse_once() -> None:
    """Tests compose configurations a thousand times, and parse the same texts in nearly half of that time.

    Values with interpolations are parsed once each, files by libyaml where Python's yaml has it.
    """
    slow = omegaconf.base.parse
    quick = cache(slow)
    for module in [held for name, held in sys.modules.items() if name.startswith("omegaconf")]:
        if getattr(module, "parse", None) is slow:
            setattr(module, "parse", quick)  # noqa: B010
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


_parse_once()


@pytest.fixture(autouse=True)
def _logs_as_before() -> Iterator[None]:
    """What a test has configured, as Hydra does in this process, doesn't take the lines of the next one."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@cache
def _known(words: tuple[str, ...], folder: str, slow: Any = build.compose_config) -> dict[str, Any]:
    return slow(words)


def _composed(overrides: Sequence[str], searchpath: Sequence[str] = (), slow: Any = build.compose_config) -> Any:
    """What conf/ alone decides is composed once in a process, and copied."""
    return slow(overrides, searchpath) if searchpath else deepcopy(_known(tuple(overrides), os.getcwd()))


build.compose_config = _composed
checks._read = cache(checks._read)
# Without a C compiler PyTorch's kernels solve, many times slower, and no interior point does: these folders and files,
# whose tests are of native kernels, of the interior point or of many solves, are skipped then.
COMPILED = (
    "native", "compiled", "search", "missions", "exploration", "benchmarks", "experiments", "notebooks", "golden",
    "fuzz", "solvers", "view", "cluster", "test_horizons.py", "test_scale.py", "test_presets.py", "roadmap",
    "sensitivity", "test_required_goal.py",
)  # fmt: skip


def pytest_report_header() -> str | None:
    return None if find_compiler() else f"no C compiler: without the tests of {', '.join(COMPILED)}"


def pytest_collection_finish() -> None:
    """What is there before the first test stays, and is no garbage to look for: a twentieth of all time."""
    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000, 20, 50)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the cases of a test marked `sampled(k)`, all but k, evenly among them, are slow.

    Without a compiler: no tests of these folders, and no cases of native kernels (`native=True`) of others.

    Samples of nets in double precision are drawn in it there, which a warning says.
    """
    sampled = defaultdict[str, list[pytest.Item]](list)
    for item in items:
        if item.get_closest_marker("sampled") is not None and item.get_closest_marker("slow") is None:
            sampled[item.nodeid.partition("[")[0]].append(item)
    for cases in sampled.values():
        few = cases[0].get_closest_marker("sampled").args[0]  # type: ignore[union-attr]
        for i in set(range(len(cases))) - {j * len(cases) // few for j in range(few)}:
            cases[i].add_marker(pytest.mark.slow)
    if find_compiler() is not None:
        return
    for item in items:
        item.add_marker(pytest.mark.filterwarnings("ignore:guided in part:torchgco.GuidanceWarning"))
        natively = getattr(item, "callspec", None) is not None and item.callspec.params.get("native") is True
        if natively or not set(COMPILED).isdisjoint(item.path.relative_to(ROOT).parts):
            item.add_marker(pytest.mark.skip(reason="no C compiler"))


@pytest.fixture(params=["native", "eager"])
def native(request: pytest.FixtureRequest) -> Iterator[bool]:
    """Native and eager kernels in turn; True for native ones."""
    if request.param == "native" and find_compiler() is None:
        pytest.skip("no C compiler")
    kernels.use_native(request.param == "native")
    yield request.param == "native"
    kernels.use_native(True)
