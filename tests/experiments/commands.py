"""Commands that tests run."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
TINY = [
    "study.layouts=3",
    "scenario.stages=12",
    "study.batch_size=2",
    "study.shard_size=2",
    "solver.local.max_outer_iterations=2",
    "study.workers=1",
]
# `hold` solves nothing: such a study takes only the time of its files.
HOLD = ["solver=hold", "study.baselines=[]", "study.layouts=4", "scenario.stages=5", "study.workers=1"]


def changed(words: list[str], *others: str) -> list[str]:
    """`words` without those whose key `others` give, and `others`: the command line refuses a key given twice."""
    keys = {other.partition("=")[0] for other in others}
    return [*(word for word in words if word.partition("=")[0] not in keys), *others]


def command(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run torchgco in a new process, to its end."""
    line = [sys.executable, "-m", "torchgco", *words]
    return subprocess.run(line, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)


def begin(*words: str, cwd: Path) -> subprocess.Popen[str]:
    """Start torchgco in a new process group."""
    return subprocess.Popen(
        [sys.executable, "-m", "torchgco", *words], cwd=cwd, env=ENVIRONMENT, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def problem_line(err: str) -> str:
    """The line of an error: the only line of `err` but for those on the progress."""
    progress = re.compile(r": \d+/\d+ trials, |^drawing \d+ figures?|^torchgco: compiling ")
    lines = [line for line in err.splitlines() if line.strip() and not progress.search(line)]
    assert len(lines) == 1, err
    return lines[0]
