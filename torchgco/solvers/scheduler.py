"""The batched loop: passes over the running problems, in a limited number of slots.

Nested loops would wait for the slowest problem of the batch at three levels. Here every problem is at its own place in
the loops. A problem that ends frees its slot for a waiting one; if none waits, the running batch shrinks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.solvers.state import State


class Work(Protocol):
    """The work on problems, given by their rows in a batch; statuses are (b,) int64, RUNNING until a problem ends."""

    def begin(self, rows: Tensor) -> tuple[State, Tensor]:
        """The first state of the problems `rows`, and the statuses of those that can't start."""
        ...

    def regroup(self, rows: Tensor) -> None:
        """Continue with these problems as the running ones."""
        ...

    def advance(self, s: State) -> Tensor:
        """One pass over all running problems, in place; returns their statuses."""
        ...

    def end(self, s: State, places: Tensor, status: Tensor) -> None:
        """Keep the results of the problems at `places` of the state."""
        ...


def run_all(work: Work, rows: Tensor, slots: int, report: Callable[[int, Tensor, int, State], None]) -> None:
    """Run the problems `rows` to their end, at most `slots` at a time.

    `report(passes, rows of the pass, rows left, state)` follows every pass.
    """
    waiting = rows[slots:]
    state, status = work.begin(rows[:slots])
    work.regroup(state.rows)
    state, waiting = _replaced(work, state, status, waiting)
    passes = 0
    while state.rows.numel() > 0:
        worked = state.rows.clone()  # a copy: slots are refilled in place
        state, waiting = _replaced(work, state, work.advance(state), waiting)
        passes += 1
        report(passes, worked, state.rows.numel() + waiting.numel(), state)


def _replaced(work: Work, state: State, status: Tensor, waiting: Tensor) -> tuple[State, Tensor]:
    """The state with ended problems replaced by waiting ones, or removed; and the rows still waiting."""
    while True:
        ended = (status != Status.RUNNING).nonzero().flatten()
        if ended.numel() == 0:
            return state, waiting
        work.end(state, ended, status[ended])
        status = status.clone()
        status[ended] = Status.RUNNING
        news = min(ended.numel(), waiting.numel())
        if news > 0:
            begun, refused = work.begin(waiting[:news])
            waiting = waiting[news:]
            put(state, ended[:news], begun)
            status[ended[:news]] = refused
        if ended.numel() > news:
            stays = torch.ones_like(status, dtype=torch.bool)
            stays[ended[news:]] = False
            stay = stays.nonzero().flatten()
            state, status = take(state, stay), status[stay]
        work.regroup(state.rows)
