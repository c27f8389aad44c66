"""The time of a first use: `import torchgco`, and a model's first solve with an empty and a full cache folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from statistics import median

from benchmarks.lib.provenance import ROOT
from benchmarks.speed.bench import Bench
from benchmarks.speed.first_solve import MODELS

SECTION = "first_use"
IMPORTS = 5  # number; their median counts
IMPORT = "import time; t = time.process_time(); import {}; print(time.process_time() - t)"


def run(bench: Bench) -> None:
    for module in ("torchgco", "torch"):
        times = [float(_started(["-c", IMPORT.format(module)], {})) for _ in range(IMPORTS)]
        bench.row(SECTION, f"import {module}", "python", "seconds", median(times), "s")
    for name in list(MODELS)[: bench.sizes.models]:
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("empty", "full"):
                found = json.loads(_started(["-m", "benchmarks.speed.first_solve", name], {"TORCHGCO_CACHE": folder}))
                for quantity, seconds in found.items():
                    bench.row(SECTION, f"{name}, cache {cache}", "torchgco.solve", quantity, seconds, "s")


def _started(words: list[str], environment: dict[str, str]) -> str:
    """The last line that a new Python process prints.

    Raises:
        RuntimeError: the process failed.
    """
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, env={**os.environ, **environment}
    )
    if done.returncode != 0:
        raise RuntimeError(f"{words} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout.splitlines()[-1]
