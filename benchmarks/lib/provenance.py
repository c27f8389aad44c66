"""The origin of a measurement: date, commit, processor, versions."""

from __future__ import annotations

import platform
import subprocess
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from benchmarks.lib import ROOT

# Files that a benchmark itself changes.
WRITTEN = (
    ":!benchmarks/README.md", ":!benchmarks/results", ":!benchmarks/board", ":!benchmarks/data/worlds/peers.csv",
    ":!benchmarks/data/general_peers.csv",
)  # fmt: skip


def provenance(device: str) -> dict[str, str]:
    """The columns that all rows of a run share, with their values."""
    import torch

    from benchmarks.lib import acados

    graphics = torch.cuda.get_device_name() if device == "cuda" else ""
    return {
        "date": date.today().isoformat(),
        "commit": _commit(),
        "processor": graphics or _processor(),
        "torch": torch.__version__,
        "casadi": _version("casadi"),
        "pytorch_mppi": _version("pytorch-mppi"),
        "acados": acados.version(),
        "threads": str(torch.get_num_threads()),
        "device": device,
    }


def _commit() -> str:
    """Short hash of the commit checked out; followed by "and changes" where tracked files differ from it."""
    try:
        head = _git("rev-parse", "--short", "HEAD")
        return head + (" and changes" if _git("status", "--porcelain", "-uno", "--", ".", *WRITTEN) else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def _processor() -> str:
    """The processor's name, from the operating system."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
