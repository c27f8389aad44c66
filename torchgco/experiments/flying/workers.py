"""Work in several processes that survives the death of some of them: batches side by side, or one after the other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from torchgco.base import notices
from torchgco.base.errors import InputError
from torchgco.experiments.ending import Noted, raised
from torchgco.experiments.flying.flight import Batch, Flown, fly, prepare
from torchgco.experiments.flying.progress import BAR_FORMAT, Lines, NoBar, lines_alone
from torchgco.kernels import native

Job = TypeVar("Job")
Result = TypeVar("Result")
CONTEXT = multiprocessing.get_context("spawn")
WORKERS_POLL = 1.0  # seconds until progress is shown, and an interrupt noticed that Python dropped
NEW_POOLS = 3  # replacements of broken pools before giving up


def run_all(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    prepare: Callable[..., None],
    options: tuple[Any, ...],
    keep: Callable[[Result], None],
    say: Callable[[str], None],
    watch: Callable[[float], None],
) -> None:
    """`keep(work(job))` for every job, `work` in other processes, `keep` in this one, in any order.

    A process that dies (killed, out of memory) breaks its pool: the jobs without a result are given to a new pool, at
    most NEW_POOLS times. An interruption or an error of `work` or `keep` ends all processes.

    Args:
        prepare, options: `prepare(number, *options)` runs first in every process; the processes are numbered from 0.
        say: receives a line for each broken pool.
        watch: called every WORKERS_POLL seconds with the sum of what `Shared` bars counted in all jobs: trials.

    Raises:
        InputError: the last pool broke, too.
    """
    left = dict(enumerate(jobs))
    counts = CONTEXT.RawArray("d", len(left))  # of trials, by job: each is written by one process

    def look() -> None:
        watch(sum(counts))

    for number in range(NEW_POOLS + 1):
        _run_pool(work, left, min(processes, len(left)), (prepare, options, counts), keep, look)
        if not left:
            return
        if number < NEW_POOLS:
            say(f"a worker process died: {len(left)} batches are flown again (new pool {number + 1} of {NEW_POOLS})")
    raise InputError(
        "study.workers", "processes that live until their batches are flown",
        f"{NEW_POOLS + 1} pools in which one died (killed, or out of memory?); finished batches are kept, and the "
        "same command resumes",
    )  # fmt: skip


def _run_pool(
    work: Callable[[Job], Result],
    left: dict[int, Job],
    processes: int,
    begin: tuple[Any, ...],
    keep: Callable[[Result], None],
    look: Callable[[], None],
) -> None:
    """Run the jobs that are left by one pool and remove those with a result; returns early where it broke."""
    others = set(multiprocessing.active_children())
    arguments: Any = *begin, CONTEXT.Value("i", 0)
    pool = ProcessPoolExecutor(processes, CONTEXT, _begin_worker, arguments)
    try:
        with raised() as noted:
            with _interrupts_held(noted):
                futures = {pool.submit(_work, work, job, number): number for number, job in left.items()}
            while futures:
                done, _ = wait(futures, timeout=WORKERS_POLL, return_when=FIRST_COMPLETED)
                noted.raise_late()
                for future in done:
                    number = futures.pop(future)  # and with it the memory of the result
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        continue
                    keep(result)
                    del left[number]
                look()
    except BrokenProcessPool:  # while jobs were still being submitted
        pass
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_held(noted: Noted) -> Iterator[None]:
    """Signals wait until the end of the block: a process that is half started would end with an error of its own.

    Processes started in the block never see Ctrl-C, nor the signals of schedulers before a time limit, which reach all
    processes of a job: the parent handles them. SIGTERM ends them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2})
    noted.held = True
    try:
        yield
    finally:
        noted.held = False
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    noted.raise_late()


class Shared(NoBar):
    """The bar of a worker process: counts the trials of its job where the parent sees them."""

    counts: ClassVar[Any] = None  # of all jobs; None outside worker processes
    job: ClassVar[int] = 0

    def update(self, n: float) -> None:
        """Count trials."""
        if self.counts is not None:
            self.counts[self.job] += n


def _begin_worker(prepare: Callable[..., None], options: tuple[Any, ...], counts: Any, begun: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    Shared.counts = counts
    with begun.get_lock():
        number = begun.value
        begun.value += 1
    prepare(number, *options)


def _work(work: Callable[[Job], Result], job: Job, number: int) -> Result:
    Shared.job = number
    notices.speak(number == 0)  # all workers compile the same, and one line on that is enough
    Shared.counts[number] = 0.0  # a previous pool may have died in this job
    return work(job)


def _end_with_parent() -> None:
    """End a worker whose parent was killed: it would wait for its next job forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def cut(ids: Sequence[int] | np.ndarray, size: int) -> list[list[int]]:
    """The ids in batches of at most `size` that follow each other without a gap."""
    runs = np.split(np.array(ids, int), np.flatnonzero(np.diff(ids) != 1) + 1)
    return [run[first : first + size].tolist() for run in runs for first in range(0, len(run), size)]


def trial_bar(name: str, count: int, left: int) -> tqdm | Lines:
    """Progress over the trials that this process flies, those flown before included."""
    if lines_alone():
        return Lines(name, count, count - left)
    return tqdm(total=count, initial=count - left, unit="trial", dynamic_ncols=True, bar_format=BAR_FORMAT)


def fly_all(flights: Sequence[Batch], workers: int, bar: tqdm | Lines, keep: Callable[[Flown], None]) -> None:
    """Fly all batches, and `keep` what each returns, in this process."""
    if workers > 1:
        return _side_by_side(flights, workers, bar, keep)
    for flight in flights:  # in this process, with a bar that moves inside a batch
        bar.set_description(flight.name)
        keep(fly(flight))


def _side_by_side(flights: Sequence[Batch], workers: int, bar: tqdm | Lines, keep: Callable[[Flown], None]) -> None:
    shown, total = 0.0, sum(len(flight.places) for flight in flights)

    def watch(finished: float) -> None:
        nonlocal shown
        bar.update(max(0.0, finished - shown))
        shown = max(shown, finished)
        bar.set_postfix_str(f"solved {int(shown)}/{total}", refresh=True)

    bar.set_description("compiling")
    for first in {flight.name: flight for flight in reversed(flights)}.values():
        first.compile()
    bar.set_description(f"{workers} processes")
    run_all(
        fly,
        flights,
        workers,
        prepare=prepare,
        options=(torch.get_num_threads(), native()),
        keep=keep,
        watch=watch,
        say=lambda line: bar.write(line, sys.stderr),
    )
