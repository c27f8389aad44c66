"""What this process may take of its machine, and how it was launched: alone, or as one of several jobs."""

from __future__ import annotations

import os
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from torchgco.base.errors import InputError

BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"  # one job after the other, in this process


def allotted_cores() -> int:
    """Cores that this process may use: those that Slurm or else the system allots, or its part of them as a job."""
    cores = int(os.environ.get("SLURM_CPUS_PER_TASK", 0)) or len(os.sched_getaffinity(0))
    launcher = _launcher()
    cpus = launcher.get("cpus_per_task") or launcher.get("ray", {}).get("remote", {}).get("num_cpus")
    if cpus is not None:
        return min(cores, max(1, int(cpus)))
    return max(1, cores // jobs_at_once())


def jobs_at_once(launcher: Any = None) -> int:
    """How many jobs joblib runs on this machine at the same time; 1 without joblib.

    Args:
        launcher: its configuration, by default that of this process.

    Raises:
        InputError: a number of jobs that joblib doesn't take.
    """
    count = (_launcher() if launcher is None else launcher).get("n_jobs", 1)
    if isinstance(count, bool) or not isinstance(count, int) or count == 0:
        raise InputError("hydra.launcher.n_jobs", "a whole number of jobs, or -1 for one per core", repr(count))
    return count if count > 0 else max(1, len(os.sched_getaffinity(0)) + 1 + count)  # -1: all cores, -2: all but one


def side_by_side() -> bool:
    """Whether other jobs of the same launch may run at the same time, and write to the same terminal."""
    return bool(_launcher())


def _launcher() -> Any:
    """The launcher's configuration in a job that may run beside others; empty elsewhere."""
    if not HydraConfig.initialized():
        return {}
    config = HydraConfig.get()
    return config.launcher if config.mode == RunMode.MULTIRUN and config.launcher._target_ != BASIC else {}
