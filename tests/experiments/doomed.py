"""Work and solvers that kill their process, as the system does when memory is short."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from torchgco.baselines import Hold
from torchgco.experiments.flying.workers import Shared


def prepare(*_: object) -> None:
    """Nothing to prepare."""


def work(job: tuple[int, str]) -> int:
    """The job's number doubled. A job with a path kills its process unless the file exists; it makes the file first."""
    number, path = job
    bar = Shared()
    bar.update(1)
    if path == "always":
        time.sleep(1.0)  # the others are done by then
        os.kill(os.getpid(), signal.SIGKILL)
    if path and not Path(path).exists():
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number < 0:
        raise ValueError(f"job {number}")
    return 2 * number


@dataclass(frozen=True)
class Doomed(Hold):
    """Hold, but a process that flies layout 2 or a later one is killed, unless the file `spared` exists."""

    def solve(self, problem, U0, seed=0, ids=None, warm=None, callback=None):
        if int(ids.max()) >= 2 and not Path("spared").exists():
            deadline = time.monotonic() + 60.0  # until the other process has flown its layouts
            while not list(Path("out/shards").glob("*.npz")) and time.monotonic() < deadline:
                time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGKILL)
        return super().solve(problem, U0, seed, ids, warm, callback)


@dataclass(frozen=True)
class Slow(Hold):
    """Hold, but from layout 2 on it takes longer than any test waits."""

    def solve(self, problem, U0, seed=0, ids=None, warm=None, callback=None):
        if int(ids.max()) >= 2 and not Path("spared").exists():
            time.sleep(600)
        return super().solve(problem, U0, seed, ids, warm, callback)
