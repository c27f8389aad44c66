"""The command line as tests type it."""

import os
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
# Nothing is solved: a study of it takes as long as its files.
HOLD = ["solver=hold", "study.baselines=[]", "study.layouts=4", "scenario.stages=5", "study.workers=1"]


def command(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """torchgco in a process of its own, to its end."""
    line = [sys.executable, "-m", "torchgco", *words]
    return subprocess.run(line, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)


def begin(*words: str, cwd: Path) -> subprocess.Popen[str]:
    """torchgco in a process group of its own, started."""
    return subprocess.Popen(
        [sys.executable, "-m", "torchgco", *words], cwd=cwd, env=ENVIRONMENT, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def problem_line(err: str) -> str:
    """The one line of an error; the progress bar aside, nothing else may stand there."""
    lines = [line for line in err.splitlines() if line.strip() and "trial/s" not in line and "s/trial" not in line]
    assert len(lines) == 1, err
    return lines[0]
