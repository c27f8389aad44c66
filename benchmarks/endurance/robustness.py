"""python -m benchmarks.endurance.robustness: what was tried against the library, and how often.

Runs the tests of wrong input, damaged files, killed processes, batches and known answers, the slow ones too, and counts
the cases and the random examples in them (some minutes on two cores). With --write the tables go into
benchmarks/results/robustness.md. --bombs measures the small files that promise much alone (a minute).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd
import torch

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.page import filed, markdown, origin, put

PAGE = RESULTS / "robustness.md"
# Kinds of trials, and the tests that make them: files, folders, or parts of a test's name after "::".
KINDS: dict[str, tuple[str, ...]] = {
    "wrong options and arguments from Python": (
        "tests/test_wrong_input.py", "tests/test_wrong_options.py", "tests/base/test_options.py",
    ),
    "wrong words and values on the command line": ("tests/experiments/test_wrong_commands.py",),
    "wrong layouts and layout files": ("tests/scenarios/test_layouts.py", "tests/scenarios/test_boxed_layouts.py"),
    "damaged and missing files of studies, full disks": ("tests/experiments/test_damage.py",),
    "signals at any moment: Ctrl-C and SIGTERM": ("tests/experiments/test_interrupts.py",),
    "killed studies and worker processes": ("tests/experiments/test_workers.py",),
    "studies stopped and resumed in other pieces": ("tests/experiments/test_resume.py",),
    "studies cut over jobs, launchers": ("tests/experiments/test_jobs.py", "tests/cluster/test_launchers.py"),
    "tampered tables, found by --verify": ("tests/experiments/test_verify.py",),
    "batch contract: order, slots, neighbours, broken problems": ("tests/solvers/test_batch_contract.py",),
    "known answers: dense KKT systems, convex problems, ALTRO's problems": ("tests/golden",),
    "random values, files, calls and batches": ("tests/fuzz",),
    "small files that promise much": ("tests/test_bombs.py",),
    "runs of others: classes, CSV": ("tests/experiments/test_stored.py", "tests/experiments/test_tables.py"),
    "the same study several times at once": ("tests/experiments/test_lock.py",),
}  # fmt: skip


def run_tests(folder: Path, arguments: Sequence[str]) -> tuple[Counter[tuple[str, str]], Counter[tuple[str, str]]]:
    """Cases by (file, outcome), and random examples by (kind, outcome)."""
    paths = [path for paths in KINDS.values() for path in paths]
    report, tally = folder / "report.xml", folder / "tally"
    words = ["-m", "pytest", "-q", "-m", "not slurm", f"--junitxml={report}", *arguments, *paths]
    environment = {**os.environ, "TORCHGCO_TALLY": str(tally)}
    subprocess.run([sys.executable, *words], cwd=ROOT, env=environment, check=False)
    cases: Counter[tuple[str, str]] = Counter()
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        ends = {child.tag for child in case} & {"failure", "error", "skipped"}
        name = case.get("classname", "").replace(".", "/")
        cases[name, min(ends, default="passed")] += 1
    examples: Counter[tuple[str, str]] = Counter()
    for path in sorted(folder.glob("tally.*.json")):
        for kind, outcome, count in json.loads(path.read_text()):
            examples[kind, outcome] += count
    return cases, examples


def case_table(cases: Mapping[tuple[str, str], int]) -> str:
    """Markdown: a row per kind of trial."""
    rows = []
    for kind, paths in KINDS.items():
        starts = tuple(path.removesuffix(".py") for path in paths)
        ends: Counter[str] = Counter()
        for (name, end), count in cases.items():
            if name.startswith(starts):
                ends[end] += count
        failed = ends["failure"] + ends["error"]
        rows.append((kind, ends.total(), failed, ends["skipped"]))
    return markdown(("tried", "cases", "failed", "skipped"), rows)


def example_table(examples: Mapping[tuple[str, str], int]) -> str:
    """Markdown: a row per kind of random example and outcome."""
    rows = ((kind, outcome, f"{count:,}") for (kind, outcome), count in sorted(examples.items()))
    return markdown(("random examples", "outcome", "count"), rows)


def put_bombs(write: bool) -> bool:
    """Try the small files that promise much, print their table, and with `write` put it into the page.

    Returns whether each was refused within the limits.
    """
    sys.path.insert(0, str(ROOT))
    from tests.bombs import BOMBS, BYTES, SECONDS, attempt

    held = []
    for name in BOMBS:
        with tempfile.TemporaryDirectory() as folder:
            told, seconds, memory, size = attempt(name, Path(folder))
        refused = ": expected " in told and "\n" not in told
        held.append((name, size, "in one line" if refused else told, seconds, memory))
    tried = pd.DataFrame(held, columns=["file", "bytes", "refused", "seconds", "MB"])
    refused = tried.refused == "in one line"
    most = f"{tried.seconds.max():.1f} s and {tried.MB.max():.0f} MB"
    said = f"{refused.sum()} of {len(tried)} refused in one line, in at most {most}."
    rows = ((name, f"{size:,}", end, f"{seconds:.1f}", f"{memory:.0f}") for name, size, end, seconds, memory in held)
    text = f"{origin('Run')}.\n\n{filed('robustness-files', markdown(tried.columns, rows), said)}"
    print(text)
    if write:
        put(PAGE, "bombs", text)
    return bool((refused & (tried.seconds < SECONDS) & (tried.MB < BYTES / 1e6)).all())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.endurance.robustness", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--write", action="store_true", help="put the tables into results/robustness.md")
    parser.add_argument("--bombs", action="store_true", help="the small files that promise much alone")
    options, more = parser.parse_known_args(arguments)
    right = put_bombs(options.write)
    if options.bombs:
        return 0 if right else 1
    with tempfile.TemporaryDirectory() as folder:
        cases, examples = run_tests(Path(folder), more)
    counts = f"{sum(cases.values()):,} cases, {sum(examples.values()):,} random examples"
    head = f"{origin('Run')}, torch {torch.__version__}: {counts}."
    ends: Counter[str] = Counter()
    for (_, outcome), count in examples.items():
        ends[outcome] += count
    said = f"Random examples: {', '.join(f'{count:,} {end}' for end, count in ends.most_common())}."
    random = filed("robustness-random", example_table(examples), said)
    text = "\n\n".join([head, case_table(cases), random])
    print(text)
    if options.write:
        put(PAGE, "robustness", text)
    return 0 if right and all(end in ("passed", "skipped") for _, end in cases) else 1


if __name__ == "__main__":
    sys.exit(main())
