"""Memory of a group of processes over time: sampled from /proc, summarised, drawn. Linux only."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from torchgco.plotting.style import INK, PALETTE, legend, panels, save, tidy

MIB = 1024**2


def group_of(number: int) -> list[int]:
    """The processes of a process group that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = path.read_text().rpartition(")")[2].split()[:3]  # a command's name may contain blanks
        except OSError:  # ended meanwhile
            continue
        if int(group) == number and state not in "ZX":
            found.append(int(path.parent.name))
    return found


def resident(process: int) -> float:
    """Resident memory of a process in MiB, shared pages included; 0 where it has ended."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MIB
    except OSError:
        return 0.0


@dataclass
class Sampler:
    """Samples of a process group, one a period, between `with` and its end."""

    group: int
    period: float = 1.0  # s
    samples: list[tuple[float, int, float]] = field(default_factory=list)

    def __enter__(self) -> Sampler:
        self.began, self._end = time.monotonic(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.is_set():
            now = time.monotonic() - self.began
            self.samples += [(now, process, resident(process)) for process in group_of(self.group)]
            self._end.wait(self.period)

    def table(self) -> pd.DataFrame:
        """MiB per process: a row per sample, indexed by seconds since the start; a column per process."""
        held = pd.DataFrame(self.samples, columns=["seconds", "process", "mib"])
        return held.pivot(index="seconds", columns="process", values="mib")


def summary(memory: pd.DataFrame, first: float, last: float) -> dict[str, float]:
    """Memory of all processes together: its `peak`, MiB; and while trials were flown, from `first` to `last` seconds,
    the means of the `first` and the `last` quarter, MiB, and the `slope` of a straight line, MiB per minute.

    Flights that were sampled fewer than eight times have the peak alone.
    """
    total = memory.sum(axis=1)
    flown = total.loc[first:last]
    quarter = len(flown) // 4
    if quarter < 2:
        return {"peak": float(total.max())}
    slope = 60 * np.polyfit(flown.index.to_numpy(), flown.to_numpy(), 1)[0]
    ends = {"first": float(flown.iloc[:quarter].mean()), "last": float(flown.iloc[-quarter:].mean())}
    return {"peak": float(total.max()), **ends, "slope": float(slope)}


def draw(memory: pd.DataFrame, first: float, last: float, file: Path) -> None:
    """Memory over time: all processes together, and each of the largest three; the span of the flights is shaded."""
    figure, (ax,) = panels(1, 1, (7.0, 3.2))
    ax.axvspan(first, last, color="#F2F2F2", label="trials are flown")
    handles = [ax.patches[0], *ax.plot(memory.index, memory.sum(axis=1), color=INK, label="all processes")]
    largest = memory.max().sort_values(ascending=False).index[:3]
    for i, process in enumerate(name for name in memory.columns if name in largest):
        name = "study" if i == 0 else f"worker {i}"  # numbers rise in the order of starts
        handles += ax.plot(memory.index, memory[process], color=PALETTE[i], linewidth=1.2, label=name)
    ax.set(xlabel="seconds since the start", ylabel="resident memory [MiB]", ylim=(0, None))
    tidy(ax)
    legend(figure, handles)
    save(figure, file)
