"""How much memory is left, before anything large is read or solved, and how much of what was found is kept."""

from __future__ import annotations

import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def free_memory() -> int:
    """Bytes that can be allocated without swapping: the kernel's own estimate, else unused pages."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@contextmanager
def limited(size: float) -> Iterator[None]:
    """In this block the process gets `size` bytes of memory on top of its own: more is a MemoryError.

    For libraries that take what a file promises. Linux counts data alone, no stacks and no mapped files, of all
    threads; on other systems nothing is limited.
    """
    if sys.platform != "linux" or size == math.inf:
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    with open("/proc/self/status") as lines:
        used = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData"))
    limit = used + int(size) if soft == resource.RLIM_INFINITY else min(used + int(size), soft)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def trim(
    kept: dict[Any, Any], most: int, total: float = math.inf, size: Callable[[Any], float] = lambda _: 0.0
) -> None:
    """Drop the first entries beyond so many, or while the sizes of several add up to more; other threads may, too."""
    pairs = list(kept.items())  # at once: no thread changes it meanwhile
    sums = list(itertools.accumulate(size(value) for _, value in reversed(pairs)))[::-1]
    for (key, _), left, after in zip(pairs, range(len(pairs), 1, -1), sums, strict=False):
        if left > most or after > total:
            kept.pop(key, None)
