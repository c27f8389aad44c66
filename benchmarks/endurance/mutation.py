"""python -m benchmarks.endurance.mutation: would the tests notice if the solver's code were wrong?

Changes one operator, number or condition at a time, in Python and in C, in a copy of the repository, and runs the tests
that are meant to guard it. A sample, drawn by a seed, of the files of `AREAS`: some minutes per ten mutants on one
core. A run that was stopped, even killed, goes on where it was. With --write the table goes into
benchmarks/results/mutation.md; the reasons for survivors, in mutation-survivors.csv, are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from benchmarks.endurance.mutants import Mutant, mutants_of, sampled
from benchmarks.lib.page import filed, put_between
from benchmarks.lib.page import read as read_table
from benchmarks.lib.provenance import provenance
from torchgco.experiments.statistics.statistics import wilson

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "benchmarks" / "results" / "mutation.md"
REASONS = PAGE.with_name("mutation-survivors.csv")
RECORDS = ROOT / "outputs" / "mutation.jsonl"
COPIED = ("torchgco", "tests", "benchmarks", "conf", "docs", "notebooks", "pyproject.toml", "README.md")
KILLED, SURVIVED, TIMEOUT = "killed", "survived", "timeout"
SAME = "Same results"  # with which the reason of a survivor begins that can't be noticed
SEED = 30
SLOWER, SPARE = 3.0, 60.0  # a mutant's limit: so many times as long as its tests take without it, and spare seconds


@dataclass(frozen=True)
class Area:
    """Files that the same tests guard, the quickest first: the first failure ends them."""

    name: str
    files: tuple[str, ...]
    tests: tuple[str, ...]


AREAS = (
    Area("lagrangian", ("torchgco/lagrangian/*.py",), (
        "tests/lagrangian/test_lagrangian.py", "tests/solvers/test_ilqr.py", "tests/solvers/test_optimality.py",
        "tests/solvers/test_augmented_lagrangian.py",
    )),
    Area("solvers", ("torchgco/solvers/*.py",), (
        "tests/solvers/test_ilqr.py", "tests/solvers/test_iterations.py", "tests/solvers/test_optimality.py",
        "tests/solvers/test_augmented_lagrangian.py", "tests/solvers/test_against_reference.py",
        "tests/solvers/test_memory.py", "tests/native/test_declarations.py",
    )),
    Area("polish", ("torchgco/solvers/polish/*.py",), ("tests/solvers/test_polish.py",)),
    Area("roadmap", ("torchgco/roadmap/*.py",), (
        "tests/search/test_scene.py", "tests/roadmap/test_homotopy.py", "tests/roadmap/test_roadmap.py",
        "tests/roadmap/test_graph.py", "tests/search/test_paths.py", "tests/roadmap/test_boxes.py",
    )),
    Area("solver in C", ("torchgco/native/c/*.[ch]",), (
        "tests/native/test_engine.py", "tests/native/test_declarations.py", "tests/native/test_emit.py",
        "tests/native/test_sampler.py", "tests/native/test_boxes.py", "tests/native/test_users.py",
        "tests/native/test_overruns.py",
    )),
    Area("roadmap in C", ("torchgco/roadmap/c/*.[ch]",), (
        "tests/roadmap/test_graph.py", "tests/roadmap/test_roadmap.py", "tests/native/test_overruns.py",
        "tests/roadmap/test_boxes.py",
    )),
)  # fmt: skip


# Of an area's tests, those that some of its files meet first.
FIRST = {
    "memory.py": "tests/solvers/test_memory.py", "ending.py": "tests/solvers/test_optimality.py",
    "lifted.py": "tests/native/test_declarations.py", "boxes.c": "tests/native/test_boxes.py",
    "mppi.c": "tests/native/test_sampler.py", "normal.c": "tests/native/test_sampler.py",
    "ilqr.c": "tests/native/test_declarations.py", "trajectories.c": "tests/native/test_engine.py",
    "traced.c": "tests/native/test_users.py", "lanes.h": "tests/native/test_emit.py",
    "boxes.h": "tests/roadmap/test_boxes.py",
}  # fmt: skip


def tests_of(mutant: Mutant) -> list[str]:
    """The tests that a mutant meets, in turn."""
    name = Path(mutant.path).name
    return list(dict.fromkeys((*([FIRST[name]] if name in FIRST else []), *area_of(mutant).tests)))


def area_of(mutant: Mutant) -> Area:
    """The area that a mutant's file belongs to."""
    return next(area for area in AREAS if any(Path(mutant.path).match(pattern) for pattern in area.files))


def drawn(each: int, seed: int) -> list[Mutant]:
    """`each` mutants of every language, from all of its files alike; area by area, so that tables grow evenly."""
    found = {Path(path): mutants_of(ROOT, path) for area in AREAS for f in area.files for path in sorted(ROOT.glob(f))}
    python = [mutant for path, mutants in found.items() if path.suffix == ".py" for mutant in mutants]
    c = [mutant for path, mutants in found.items() if path.suffix != ".py" for mutant in mutants]
    pairs = zip(sampled(python, each, seed), sampled(c, each, seed), strict=True)
    return [mutant for pair in pairs for mutant in pair]


class Copy:
    """A copy of the repository in a scratch folder, with its own cache of kernels and a compiler that hurries."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "repository"
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, self.root / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                self.root.mkdir(exist_ok=True)
                shutil.copy2(source, self.root / name)
        compiler = folder / "cc"
        # Every mutant in C is compiled for many forms of problems; optimised code takes several times as long.
        compiler.write_text('#!/bin/sh\nfor word; do shift; [ "$word" = -O3 ] && word=-O1; set -- "$@" "$word"; done\n'
                            'exec cc "$@"\n')  # fmt: skip
        compiler.chmod(0o755)
        self.environment = {
            **os.environ, "PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1",
            "TORCHGCO_CC": str(compiler), "TORCHGCO_CACHE": str(folder / "cache"),
        }  # fmt: skip

    def ends(self, tests: Sequence[str], limit: float | None) -> str:
        """How the tests end: killed where one fails, survived where all pass, or timeout."""
        words = ["-m", "pytest", "-x", "-q", "-n", "0", "-m", "not slurm", "-p", "no:cacheprovider", *tests]
        process = subprocess.Popen(
            [sys.executable, *words], cwd=self.root, env=self.environment, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            return SURVIVED if process.wait(limit) == 0 else KILLED
        except subprocess.TimeoutExpired:
            return TIMEOUT
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def try_out(self, mutant: Mutant, limit: float) -> str:
        """How the tests of the mutant's area end, with the mutant in place of its file."""
        path = self.root / mutant.path
        whole = path.read_bytes()
        path.write_bytes(mutant.applied(whole))
        try:
            return self.ends(tests_of(mutant), limit)
        finally:
            path.write_bytes(whole)


def read(path: Path) -> dict[str, str]:
    """How the mutants ended that were tried before, by their keys; a line cut off by a kill is left out."""
    known = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
            known[row["key"]] = row["end"]
        except (json.JSONDecodeError, KeyError, TypeError):
            continue
    return known


def run(mutants: Sequence[Mutant], records: Path, again: bool = False) -> dict[str, str]:
    """How all mutants end; those in `records` are not tried again, or, with `again`, only those that survived.

    Raises:
        SystemExit: tests that fail without any mutant.
    """
    known = {key: end for key, end in read(records).items() if not (again and end == SURVIVED)}
    left = [mutant for mutant in mutants if mutant.key not in known]
    records.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder, records.open("a") as file:
        copy, limits = Copy(Path(folder)), {}
        for area in tqdm(sorted({area_of(mutant).name for mutant in left}), "unchanged", unit="area"):
            began = time.monotonic()
            (tests,) = (a.tests for a in AREAS if a.name == area)
            if copy.ends(tests, None) != SURVIVED:
                raise SystemExit(f"the tests of {area} fail without a mutant: {' '.join(tests)}")
            limits[area] = SLOWER * (time.monotonic() - began) + SPARE
        for mutant in tqdm(left, "mutants", unit="mutant", smoothing=0.0):
            known[mutant.key] = copy.try_out(mutant, limits[area_of(mutant).name])
            file.write("\n" + json.dumps({"key": mutant.key, "end": known[mutant.key]}))
            file.flush()
            os.fsync(file.fileno())
    return known


def table(mutants: Sequence[Mutant], ends: dict[str, str], page: str) -> list[str]:
    """A row per area and one of all: mutants tried, killed, survived, timeout, and the shares that were noticed."""
    lines = ["| area | tried | killed | timeout | survived | same results | noticed of all | of the others |"]
    lines += ["| " + " | ".join(["---"] * 8) + " |"]
    tried = [mutant for mutant in mutants if mutant.key in ends]
    for name in (*(area.name for area in AREAS), "all"):
        part = [mutant for mutant in tried if name in (area_of(mutant).name, "all")]
        count = Counter(ends[mutant.key] for mutant in part)
        noticed, same = count[KILLED] + count[TIMEOUT], sum(reason_of(m, page).startswith(SAME) for m in part)
        shares = f"{_share(noticed, len(part))} | {_share(noticed, len(part) - same)}"
        ended = " | ".join(str(count[end]) for end in (KILLED, TIMEOUT, SURVIVED))
        lines.append(f"| {name} | {len(part)} | {ended} | {same} | {shares} |")
    return lines


def _share(count: int, n: int) -> str:
    """A share and its Wilson interval."""
    if n == 0:
        return "-"
    low, high = (100 * end for end in wilson(count, n))
    return f"{100 * count / n:.0f} % [{low:.0f}, {high:.0f}]"


def _change(mutant: Mutant) -> str:
    """A line of code and the change to it, as cells of the page."""
    code, old, new = (word.replace("|", "\\|") for word in (mutant.code, mutant.old, mutant.new))
    return f"| `` {code} `` | {mutant.column}: `` {old} `` {f'to `` {new} ``' if new else 'left out'} |"


def reason_of(mutant: Mutant, page: str) -> str:
    """Why no test fails, as the page says; the line may have moved."""
    change = _change(mutant)
    found = [line.split(change)[1].strip(" |") for line in page.splitlines() if change in line]
    return found[0] if found else "not examined"


def survivors(mutants: Sequence[Mutant], ends: dict[str, str], page: str) -> list[str]:
    """A row per survivor: place, line of code, change, and the reason that the page gives for it."""
    lines = ["| file:line | code | change | why no test fails |", "| --- | --- | --- | --- |"]
    for mutant in sorted(mutants, key=lambda m: (m.path, m.start)):
        if ends.get(mutant.key) == SURVIVED:
            place = f"| {mutant.path.removeprefix('torchgco/')}:{mutant.line}"
            lines.append(f"{place} {_change(mutant)} {reason_of(mutant, page)} |")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.endurance.mutation", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--each", type=int, default=60, help="mutants of each language")
    parser.add_argument("--seed", type=int, default=SEED, help="of the sample")
    parser.add_argument("--records", type=Path, default=RECORDS, help="what was tried already, and how it ended")
    parser.add_argument("--again", action="store_true", help="try those again that survived: tests were added")
    parser.add_argument("--write", action="store_true", help="put the tables into results/mutation.md")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the tests that run and the copy go, too
    mutants = drawn(options.each, options.seed)
    ends = run(mutants, options.records, options.again)
    origin, kept = provenance("cpu"), read_table(REASONS)
    head = f"Run on {origin['date']} at commit {origin['commit']}, torch {origin['torch']}; seed {options.seed}."
    shares = "\n".join(table(mutants, ends, kept))
    text = f"{head}\n\n{shares}\n\n{filed(REASONS.stem, chr(10).join(survivors(mutants, ends, kept)))}"
    print(text)
    if options.write:
        put_between(PAGE, "<!-- mutation -->", "<!-- end mutation -->", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
