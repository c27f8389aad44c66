"""Several jobs started by one command, `torchgco -m`: what becomes of each, and the studies that they flew together.

Jobs may run in other processes or on other machines, so they report by files, in a folder that the starting process
makes for them and that all can reach, as they can reach their studies.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import traceback
import weakref
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from torchgco.base.errors import InputError
from torchgco.experiments.config.build import recomposer
from torchgco.experiments.config.launching import jobs_at_once
from torchgco.experiments.ending import Refused
from torchgco.experiments.results.files import write

SWEPT: list[str] = []  # keys that differ between the jobs of the sweep that this process's job is one of
CUT_BY = ("study.jobs", "study.job")  # keys in which the jobs of one study differ


@dataclass(frozen=True)
class Report:
    """How a job ended; what the command's task returns.

    Args:
        folder: of the study.
        overrides: of the job.
        done: False: the job flew its share of a study.
        refused: the error as one line, None where there was none.
    """

    folder: str
    overrides: list[str]
    done: bool
    refused: str | None = None


class Scored(float):
    """The number of a study, as a sweeper takes it, with the report of its job."""

    def __new__(cls, number: float, report: Report) -> Scored:
        made = super().__new__(cls, number)
        made.report = report
        return made

    report: Report

    def __reduce__(self) -> tuple[Any, ...]:
        return Scored, (float(self), self.report)


def _exits(method: Callable[..., None]) -> Callable[..., None]:
    """Let a callback's error end the command: Hydra would turn it into a warning."""

    @wraps(method)
    def call(*words: Any, **more: Any) -> None:
        try:
            method(*words, **more)
        except InputError as error:
            raise Refused(error) from None
        except Exception:
            traceback.print_exc()
            sys.exit(1)

    return call


class Jobs(Callback):
    """Hydra's callback: jobs get a copy of it, which knows the folder that the starting process made."""

    def __init__(self) -> None:
        self.reports: str | None = None
        self.swept: list[str] = []

    @_exits
    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder of the reports.

        Exits with one line where the launcher isn't installed or its number of jobs is malformed.
        """
        _check(config)
        self.swept = _swept(config)
        sweep = Path(config.hydra.sweep.dir).resolve()
        try:
            sweep.mkdir(parents=True, exist_ok=True)
            self.reports = tempfile.mkdtemp(prefix=".jobs-", dir=sweep)
        except OSError as error:
            raise InputError("hydra.sweep.dir", "a folder that can be made", error) from None
        weakref.finalize(self, shutil.rmtree, self.reports, ignore_errors=True)  # for launches that are interrupted

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Let the job know the keys of its sweep."""
        SWEPT[:] = self.swept

    @_exits
    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """In a job of a sweep: write its report."""
        report = job_return._return_value
        report = report.report if isinstance(report, Scored) else report
        if self.reports is not None and isinstance(report, Report):
            text = json.dumps(asdict(report)).encode()
            write(Path(self.reports) / f"{config.hydra.job.num:06d}.json", lambda file: file.write(text))

    @_exits
    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Finish the studies that jobs flew together; exits with a line per job or study that failed."""
        paths = sorted(Path(self.reports or "").glob("[0-9]*.json"))
        reports = [Report(**json.loads(path.read_bytes())) for path in paths]
        shutil.rmtree(self.reports or "", ignore_errors=True)
        shared = set.intersection(*(set(report.overrides) for report in reports)) if reports else set()
        failed = []
        for report in reports:
            if report.refused is not None:
                words = " ".join(word for word in report.overrides if word not in shared)
                failed.append(f"job {words}: {report.refused}")
        cut = {report.folder: report for report in reports if not report.done and report.refused is None}
        for report in cut.values():
            try:
                _finish(config, report, self.swept)
            except InputError as error:
                failed.append(str(error))
        if failed:
            raise Refused(*failed)


def _check(config: DictConfig) -> None:
    """Raise where the launcher's plugin isn't installed, or its number of jobs is malformed."""
    name = str(config.hydra.runtime.choices.get("hydra/launcher"))
    package = str(config.hydra.launcher._target_).rpartition(".")[0]
    try:
        known = find_spec(package) is not None
    except ModuleNotFoundError:
        known = False
    if not known:
        plugin = package.removeprefix("hydra_plugins.").split(".")[0].replace("_", "-")
        raise InputError("hydra/launcher", f"an installed launcher: pip install {plugin}", name)
    jobs_at_once(config.hydra.launcher)


def _swept(config: DictConfig) -> list[str]:
    """The keys that a sweep changes, on the command line or in the configuration of its sweeper."""
    words = OverridesParser.create().parse_overrides(list(config.hydra.overrides.task))
    nodes = [config.hydra.sweeper.get(name) for name in ("params", "search_space")]
    keys = [word.key_or_group for word in words if word.is_sweep_override()]
    return list(dict.fromkeys([*keys, *(str(key) for node in nodes for key in node or ())]))


def _finish(config: DictConfig, report: Report, swept: Sequence[str]) -> None:
    """Write tables, summary and figures of a study whose shares are flown."""
    from torchgco.experiments.flying.study import run_study  # here, as jobs and workers import this module

    words = [word for word in report.overrides if not word.lstrip("+~").startswith(tuple(f"{key}=" for key in CUT_BY))]
    recompose = recomposer(words, config.hydra.runtime.config_sources)
    run_study(recompose(None), Path(report.folder), recompose, command=sys.argv[1:], collect=True, swept=swept)
