"""python -m benchmarks.endurance.study: a long study, its memory, and the same study killed three times.

Two workers fly forests; the memory of all their processes is sampled each second. The same study in another folder is
killed at three random times (SIGKILL to all of its processes) and started again each time; its table must equal that of
the undisturbed study bit for bit. Then one process measures what a study costs besides its solves. With --write the
tables and the figure are put into results/endurance.md, with date and commit. Linux only.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from benchmarks.endurance.memory import Sampler, draw, group_of, summary
from benchmarks.endurance.overhead import FLIGHT, PHASES, REPORT, REST
from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.page import cells_of, chosen, filed, machine, markdown, origin, put

KILLS = 3
TIMING = ["seconds", "batch_size", "threads"]  # columns that describe how a trial was flown
SHARDS, LARGEST = 8, 512  # at least so many shards, of at most so many layouts
LIMIT = 0.03  # the overhead of sharding, as a share of the direct calls
PROCESS = "processor seconds in one process"
POLL = 0.05  # s


@dataclass(frozen=True)
class Undisturbed:
    """Measurements of the undisturbed study; times in seconds.

    Args:
        first, last: when its first and last shard were written, since its start.
        processor: of all its processes.
    """

    wall: float
    processor: float
    first: float
    last: float
    memory: pd.DataFrame


def command(folder: Path, layouts: int) -> list[str]:
    return [
        sys.executable, "-m", "torchgco", "solver=gco", "study.baselines=[]", "study.workers=2", "device.threads=1",
        f"study.layouts={layouts}", f"study.shard_size={shard_size(layouts)}", f"hydra.run.dir={folder}",
    ]  # fmt: skip


def shard_size(layouts: int) -> int:
    return min(LARGEST, -(-layouts // SHARDS))


@contextmanager
def running(folder: Path, layouts: int) -> Iterator[subprocess.Popen[bytes]]:
    """The study in a process group of its own, of which nothing runs any more at the end of the block."""
    study = subprocess.Popen(command(folder, layouts), cwd=ROOT, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        yield study
    finally:
        while group_of(study.pid):
            os.killpg(study.pid, signal.SIGKILL)
            study.poll()
            time.sleep(POLL)
        study.wait()


def shards_in(folder: Path) -> list[Path]:
    return sorted(folder.glob("shards/*.npz"))


def undisturbed(folder: Path, layouts: int) -> Undisturbed:
    """Fly the study to its end."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    with running(folder, layouts) as study:
        with Sampler(study.pid) as sampler:
            written = _when_written(folder, study, began)
        if study.wait() != 0:
            raise RuntimeError(f"the study in {folder} ended with exit code {study.returncode}")
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Undisturbed(wall, processor, written[0], written[-1], sampler.table())


def _when_written(folder: Path, study: subprocess.Popen[bytes], began: float) -> list[float]:
    """When each shard was written, seconds since the start; returns at the end of the study.

    A finished study removes its shards, so they are counted while it runs.
    """
    times: list[float] = []
    while study.poll() is None:
        new = len(shards_in(folder)) - len(times)
        times += [time.monotonic() - began] * max(0, new)
        time.sleep(POLL)
    return times or [time.monotonic() - began]


def killed(folder: Path, layouts: int, whole: Undisturbed, seed: int) -> list[tuple[float, int]]:
    """Fly the study with kills; returns when each start was killed, s, and how many shards were there then.

    The times are drawn between just before the first shard and an eighth of the flights after it, so that work is left
    for the last start. A start that ends before its time was not killed, and is not in the list.
    """
    last = whole.first + (whole.last - whole.first) / 8
    times = np.random.default_rng(seed).uniform(0.9 * whole.first, last, KILLS)
    kills = []
    for seconds in times:
        with running(folder, layouts) as study:
            try:
                study.wait(timeout=float(seconds))
            except subprocess.TimeoutExpired:
                os.killpg(study.pid, signal.SIGKILL)
                kills.append((float(seconds), len(shards_in(folder))))
    with running(folder, layouts) as study:
        if study.wait() != 0:
            raise RuntimeError(f"the study in {folder} did not resume: exit code {study.returncode}")
    return kills


def differences(one: Path, other: Path) -> list[str]:
    """Columns and files in which two finished studies differ, by their bits; the columns of TIMING don't count."""
    a, b = (pd.read_parquet(folder / "trials.parquet") for folder in (one, other))
    if list(a.columns) != list(b.columns) or len(a) != len(b):
        return ["the columns or the number of rows"]
    found = [name for name in a.columns if name not in TIMING and not _same(a[name], b[name])]
    controls = [np.load(folder / "solutions.npz")["U"].tobytes() for folder in (one, other)]
    files = [{str(path.relative_to(folder)) for path in folder.rglob("*")} for folder in (one, other)]
    return [*found, *["solutions.npz"] * (controls[0] != controls[1]), *sorted(files[0] ^ files[1])]


def _same(a: pd.Series, b: pd.Series) -> bool:
    """Whether two columns have equal bits."""
    if pd.api.types.is_float_dtype(a) and pd.api.types.is_float_dtype(b):
        return a.to_numpy().tobytes() == b.to_numpy().tobytes()
    return a.dtype == b.dtype and a.equals(b)


def overhead(folder: Path, layouts: int) -> dict[str, dict[str, float]]:
    """Processor seconds by phase of a study and of direct calls, in one process."""
    words = [sys.executable, "-m", "benchmarks.endurance.overhead", str(folder), str(layouts), str(shard_size(layouts))]
    return json.loads(subprocess.run(words, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout)


def share(seconds: dict[str, dict[str, float]]) -> float:
    """The time of a study besides solves, judging and report, beyond that of direct calls, as a share of the latter."""
    besides = [
        sum(value for phase, value in held.items() if phase not in (*FLIGHT, REPORT)) for held in seconds.values()
    ]
    return (besides[0] - besides[1]) / sum(seconds["direct"].values())


def page(
    layouts: int, whole: Undisturbed, kills: Sequence[tuple[float, int]], found: Sequence[str], seconds: dict
) -> str:
    """Markdown: origin, the undisturbed study with its figure, the comparison, the overhead."""
    size = shard_size(layouts)
    head = [
        f"{origin('Flown')}, torch {torch.__version__}, {machine()},",
        f"shared: {layouts:,} forests of 30 spheres, seed 0, `gco`, two workers of one thread, "
        f"{-(-layouts // size)} shards of at",
        f"most {size} layouts.",
    ]
    times = ", ".join(f"{time:.1f} s ({shards} shards written)" for time, shards in kills)
    same = "The table, controls and names of files are those of the undisturbed study, bit for bit."
    compared = [
        f"Killed {len(kills)} times, after these times from a start: {times}.",
        "The same command started it again each time.",
        f"There are differences in {', '.join(found)}." if found else same,
    ]
    figure = "![Memory over time](endurance.png)"
    parts = "\n".join(head), undisturbed_table(layouts, whole), figure, "\n".join(compared), overhead_table(seconds)
    return "\n\n".join(parts)


def undisturbed_table(layouts: int, whole: Undisturbed) -> str:
    memory = summary(whole.memory, whole.first, whole.last)
    rows = {
        "wall time": f"{whole.wall:.0f} s; last flight after {whole.last:.0f} s",
        "processor time of all processes": f"{whole.processor:.0f} s",
        "trials per second": f"{layouts / whole.wall:.1f}",
        "memory, peak of all processes": f"{memory['peak']:.0f} MiB",
    }
    if "slope" in memory:
        growth = 100 * (memory["last"] / memory["first"] - 1)
        rows |= {
            "in the first quarter of the flights": f"{memory['first']:.0f} MiB",
            "in the last quarter": f"{memory['last']:.0f} MiB ({growth:+.1f} %)",
            "slope during the flights": f"{memory['slope']:+.1f} MiB per minute",
        }
    return markdown(["undisturbed", ""], rows.items())


def overhead_table(seconds: dict[str, dict[str, float]]) -> str:
    rows = [[phase, *(f"{held.get(phase, 0.0):.2f}" for held in seconds.values())] for phase in (*PHASES, REST)]
    rows.append(["all", *(f"{sum(held.values()):.2f}" for held in seconds.values())])
    report = seconds["study"].get(REPORT, 0.0) / sum(seconds["direct"].values())
    table = markdown([PROCESS, "study", "direct calls"], rows)
    return (
        f"{filed('endurance', table, chosen(table, cells_of(table)[0], **{PROCESS: (*FLIGHT, 'all')}))}\n\n"
        "The study took more than the direct calls, solves, judging and report left out, by "
        f"{100 * share(seconds):.1f} % of these\n"
        f"(wanted: under {100 * LIMIT:.0f} %); the report took {100 * report:.1f} %."
    )


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "results/endurance.md")
    parser.add_argument("--layouts", type=int, default=10_000, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the times of the kills")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "endurance", help="its folders are emptied")
    return parser


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    outputs = asked.outputs.resolve()
    folders = [outputs / name for name in ("undisturbed", "killed", "one-process")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    whole = undisturbed(folders[0], asked.layouts)
    kills = killed(folders[1], asked.layouts, whole, asked.seed)
    found = differences(*folders[:2])
    text = page(asked.layouts, whole, kills, found, overhead(folders[2], asked.layouts))
    print(text)
    figure = (RESULTS if asked.write else outputs) / "endurance.png"
    draw(whole.memory, whole.first, whole.last, figure)
    if asked.write:
        put(RESULTS / "endurance.md", "endurance", text)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
