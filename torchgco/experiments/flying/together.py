"""Batches are flown one after the other in this process, or side by side by several."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
import torch
from tqdm import tqdm

from torchgco.experiments.flying.flight import Batch, Flown, fly, prepare
from torchgco.experiments.flying.progress import BAR_FORMAT, Lines, lines_alone
from torchgco.experiments.flying.workers import run_all
from torchgco.kernels import native


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
