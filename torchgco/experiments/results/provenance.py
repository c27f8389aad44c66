"""How a study was run: run.json in its folder, and run-JOB-of-JOBS.json of every job that flew a share.

Each is written by who holds the study, or that very share (`lock.held`): nobody else reads and changes it meanwhile.

Each file is a list with an entry per start, the oldest first. An entry is a dict of

- command: the command line
- torchgco: version, and where the package is a git checkout its commit, and whether files differ from it
- packages: versions of Python and of the libraries that compute
- machine: platform, processor, number of cores, first line of the C compiler's version (null: none)
- devices: that share the layouts, with the names of GPUs
- threads, workers: per process, and processes
- seed
- job: [job, jobs] where the process flew a share, else null
- started: UTC
- ended: "finished", "share flown" (by a job: others finish the study), "interrupted", "failed", or null while it runs
  and where it was killed
- wall_seconds, processor_seconds: from start to end, of all its processes; null as above

Nothing here names a host, a user or the environment. A record that can't be written is left out: it never makes a study
fail.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from torchgco.base.files import regular
from torchgco.base.version import PACKAGE, VERSION
from torchgco.experiments.config.build import Setup
from torchgco.experiments.flying.flight import Schedule
from torchgco.experiments.results.files import write
from torchgco.native.compiler import find_compiler

RECORD = "run.json"
PACKAGES = ("torch", "numpy", "scipy", "casadi", "hydra-core", "pandas", "pyarrow")
GIT_PATIENCE = 10.0  # s, for git


@contextmanager
def recorded(
    folder: Path, setup: Setup, plan: Schedule, command: Sequence[str], program: str = "torchgco"
) -> Iterator[list[str]]:
    """Record a start in the study's folder, and how it ended: the last word that the block appends, or "finished"."""
    path = folder / (RECORD if plan.job is None else f"run-{plan.job}-of-{plan.jobs}.json")
    began, used = time.perf_counter(), _processor_seconds()
    entries: list[dict[str, Any]] = []
    with suppress(Exception):
        entries = [*_held(path), _entry(setup, plan, [program, *command])]
        _keep(path, entries)
    ending: list[str] = []
    how = "failed"
    try:
        yield ending
        how = ending[-1] if ending else "finished"
    except (KeyboardInterrupt, SystemExit):
        how = "interrupted"
        raise
    finally:
        with suppress(Exception):
            entries[-1]["ended"] = how
            entries[-1]["wall_seconds"] = round(time.perf_counter() - began, 3)
            entries[-1]["processor_seconds"] = round(_processor_seconds() - used, 3)
            _keep(path, entries)


def _entry(setup: Setup, plan: Schedule, command: Sequence[str]) -> dict[str, Any]:
    return {
        "command": shlex.join(command),
        "torchgco": _or_none(source),
        "packages": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "machine": {
            "platform": platform.platform(), "processor": _or_none(_processor), "cores": os.cpu_count(),
            "compiler": _or_none(_compiler),
        },
        "devices": [_or_none(partial(_device, device)) for device in setup.devices],
        "threads": torch.get_num_threads(),
        "workers": plan.workers,
        "seed": setup.seed,
        "job": None if plan.job is None else [plan.job, plan.jobs],
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "ended": None,
        "wall_seconds": None,
        "processor_seconds": None,
    }  # fmt: skip


def _held(path: Path) -> list[dict[str, Any]]:
    """The entries of earlier starts; none where they can't be read."""
    try:
        entries = json.loads(regular(path).read_bytes())
    except (OSError, ValueError, RecursionError):
        return []
    return entries if isinstance(entries, list) else []


def _keep(path: Path, entries: list[dict[str, Any]]) -> None:
    write(path, lambda file: file.write(json.dumps(entries, indent=1).encode()))


def source() -> dict[str, Any]:
    """Version, and commit of a checkout. An installed package may lie in a checkout of something else: no commit."""
    root = PACKAGE.parent
    source: dict[str, Any] = {"version": VERSION, "commit": None, "changed": None}
    if (root / ".git").exists():
        source["commit"] = _git(root, "rev-parse", "HEAD").strip()
        source["changed"] = bool(_git(root, "status", "--porcelain", "--", "torchgco", "conf"))
    return source


def _git(root: Path, *words: str) -> str:
    line = ["git", "--no-optional-locks", *words]
    return subprocess.run(line, cwd=root, capture_output=True, text=True, check=True, timeout=GIT_PATIENCE).stdout


def _version(name: str) -> str | None:
    return _or_none(lambda: metadata.version(name))


def _processor() -> str | None:
    lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)


def _device(device: torch.device) -> str:
    return f"{device}, {torch.cuda.get_device_name(device)}" if device.type == "cuda" else str(device)


def _compiler() -> str | None:
    compiler = find_compiler()
    return None if compiler is None else compiler.identity.splitlines()[1]  # after its path


def _processor_seconds() -> float:
    return sum(os.times()[:4])  # children that have ended included


def _or_none(tell: Callable[[], Any]) -> Any:
    """What the system tells, None where it can't."""
    with suppress(Exception):
        return tell()
    return None
