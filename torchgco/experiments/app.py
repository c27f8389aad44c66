"""The command `torchgco`: the only `hydra.main`."""

from __future__ import annotations

import os
import re
import sys
import traceback
import warnings
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchgco.base.errors import InputError, first_line
from torchgco.base.version import VERSION
from torchgco.experiments import new
from torchgco.experiments.config.build import forget_composed, plain, recomposer
from torchgco.experiments.config.checks import as_input_error, check_once, hydra_words
from torchgco.experiments.config.groups import ENTRY, config_dir, register_resolver
from torchgco.experiments.ending import Refused, ended, raised, say, silence
from torchgco.experiments.flying.jobs import SWEPT, Report, Scored
from torchgco.experiments.results.files import write
from torchgco.experiments.results.identity import decisive, digest, settings_of

# conf/hydra/launcher extends the plugins' configurations of the same names. Hydra warns that it may stop to join them;
# ours are whole.
warnings.filterwarnings("ignore", r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema", UserWarning)
REFUSED = "refused"  # folder that exists while a study is refused
LAUNCHERS = ("joblib", "submitit", "ray")  # packages whose errors tell that a job was killed or timed out


def study_folder(_root_: Any) -> str:
    """A folder name from the settings that decide results. It holds no time, so a second start resumes the first.

    A malformed configuration gets a name, too: the study refuses it, and the other jobs of a sweep go on.
    """
    try:
        return re.sub(r"[^\w.-]", "_", _described(_root_))
    except (InputError, AttributeError, KeyError, TypeError):
        return REFUSED


def _described(_root_: Any) -> str:
    config = plain(OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"]))
    solvers = {config["solver"]["name"]: settings_of(config)}
    recompose = recomposer(_root_.hydra.overrides.task, _root_.hydra.runtime.config_sources)
    for option in config["study"]["baselines"] or ():
        baseline = recompose(option)
        solvers.setdefault(baseline["solver"]["name"], settings_of(baseline))
    path = config["scenario"].get("path")
    scenario = Path(path).stem if path else config["scenario"]["name"]
    described = [VERSION, config["seed"], config["study"]["layouts"], decisive(config, solvers)]
    return f"{scenario}-{config['model']['vehicle']['name']}-{config['solver']['name']}-{digest(described)[:8]}"


register_resolver("torchgco.folder", study_folder)


def _task(config: DictConfig) -> Report | Scored:
    job = HydraConfig.get()
    folder, overrides = Path(job.runtime.output_dir), list(job.overrides.task)
    alone, objective = job.mode == RunMode.RUN, OmegaConf.select(config, "study.objective")
    try:
        kind, named = ("run", job.run.dir) if alone else ("sweep", job.sweep.dir)
        if not named:
            raise InputError(f"hydra.{kind}.dir", "the name of a folder", "an empty one")
        with raised() as noted:  # a job may run in a process that a launcher started
            from torchgco.experiments.flying.study import run_study  # here: workers import this module, not the figures

            noted.raise_late()
            done = run_study(
                plain(config), folder, recomposer(overrides, job.runtime.config_sources),
                lambda: _keep_configuration(config, folder), command=sys.argv[1:] if alone else ["-m", *overrides],
                swept=tuple(SWEPT),
            )  # fmt: skip
            report = Report(str(folder), overrides, done)
            return report if objective is None else _scored(config, report)
    except (InputError, HydraException, OmegaConfBaseException) as error:
        _remove_empty(folder)
        if not alone and objective is not None:  # a sweeper that steers would take a report for a number
            raise as_input_error(error) from None
        if not alone:
            return Report(str(folder), overrides, False, str(as_input_error(error)))
        raise Refused(as_input_error(error)) from None
    except Exception as error:
        if _is_of_launcher(error):
            return Report(str(folder), overrides, False, _stopped(error))
        raise


def _scored(config: DictConfig, report: Report) -> Scored:
    """The report with the number of the study."""
    from torchgco.experiments.results.folder import TRIALS, read_trials
    from torchgco.experiments.results.kinds import objective_of

    name, solver = config.study.objective, config.solver.name
    number = objective_of(read_trials(Path(report.folder) / TRIALS, trust=True), name, solver)
    say(f"{name} of {solver}: {number:g}")
    return Scored(number, report)


# Not as a decorator: launchers send the task to other processes by its name.
_run = hydra.main(config_path=str(config_dir()), config_name="config", **ENTRY)(_task)


def _is_of_launcher(error: Exception) -> bool:
    return type(error).__module__.split(".")[0] in LAUNCHERS


def _stopped(error: Exception) -> str:
    """A launcher's error as one line."""
    return f"a job was stopped ({first_line(error)}); what jobs flew is kept, and the same command resumes"


def _remove_empty(folder: Path) -> None:
    """Remove the folder that Hydra made for a study that is refused, and empty ones around it in the current folder."""
    here = Path.cwd()
    around = [candidate for candidate in folder.parents if here in candidate.parents]
    for candidate in (folder, *around) if folder != here else ():
        try:
            candidate.rmdir()
        except OSError:  # not empty, or of somebody else
            return


def _keep_configuration(config: DictConfig, folder: Path) -> None:
    """Write `.hydra/` as Hydra does, but only once the command is accepted (`hydra.output_subdir` is null)."""
    whole: Any = HydraConfig.instance().cfg
    texts = {"config": config, "hydra": whole, "overrides": whole.hydra.overrides.task}
    for name, node in texts.items():
        text = OmegaConf.to_yaml(node).encode()
        write(folder / ".hydra" / f"{name}.yaml", lambda file, text=text: file.write(text))


def main() -> int:
    """Run the command line; returns the exit code, see `ended`."""
    return ended("torchgco", _command)


def _command() -> int:
    if "--version" in sys.argv[1:]:
        say(f"torchgco {VERSION}")
        return 0
    if sys.argv[1:2] == ["new"]:
        return new.main(sys.argv[2:])
    # Hydra would print and exit by itself; with this it raises its errors, and each is printed as one line.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    forget_composed()  # the files of conf/ may have changed since the last call
    parser = get_args_parser()
    parser.error = _refuse_flags
    try:
        asked = parser.parse_intermixed_args()
        words = asked.overrides
        check_once(words)
        # Hydra's own main reads them, and takes no flags between words.
        sys.argv[1:] = [*(word for word in sys.argv[1:] if word not in words), *hydra_words(words)]
        _shown(asked.package) if asked.cfg and asked.package else _run()
    except InputError:
        raise
    except (HydraException, OmegaConfBaseException) as error:
        raise as_input_error(error) from None
    except BrokenPipeError as error:  # a reader of Hydra's pages has read enough, as `head` does
        if not _by_hydra(error):
            raise
        silence()
    except OSError as error:  # Hydra can't make the study's folder; the study's own files raise InputError
        raise InputError("hydra.run.dir", "a folder that can be made", error) from None
    except Exception as error:
        if _is_of_launcher(error):
            print(f"torchgco: {_stopped(error)}", file=sys.stderr)
            return 1
        if not isinstance(error, ValueError) or not _by_hydra(error):
            raise
        raise InputError("command line", "words that Hydra accepts", error) from None
    return 0


def _shown(package: str) -> None:
    """Print a part of the configuration; Hydra itself would write of one that isn't there, and exit."""
    try:
        with redirect_stderr(StringIO()):
            _run()
    except SystemExit as end:
        if end.code:
            raise InputError("-p", "a group or a key of the configuration", package) from None
        raise


def _refuse_flags(message: str) -> NoReturn:
    raise InputError("command line", "KEY=VALUE, GROUP=OPTION and the flags of --hydra-help", message)


def _by_hydra(error: BaseException) -> bool:
    """Whether Hydra itself raised an error; it raises plain ones, too."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).startswith("hydra.")
