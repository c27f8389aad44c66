"""The command `torchgco`: the only `hydra.main`."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchgco
from torchgco.errors import InputError
from torchgco.experiments.build import compose_config, config_dir
from torchgco.experiments.checks import as_input_error, check, check_words
from torchgco.experiments.files import write
from torchgco.experiments.identity import decisive, digest, plain, settings_of
from torchgco.interrupts import farewell, raised


def study_folder(_root_: Any) -> str:
    """A folder name from the settings that decide results. It holds no time, so a second start resumes the first."""
    held = plain(OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"]))
    check(held, config_dir())
    solvers = {held["solver"]["name"]: {key: value for key, value in held["solver"].items() if key != "name"}}
    recompose = _recomposer(_root_.hydra)
    for name in held["study"]["baselines"] or ():
        solvers.setdefault(name, settings_of(recompose(name)))
    path = held["scenario"].get("path")
    scenario = Path(path).stem if path else held["scenario"]["name"]
    described = [torchgco.__version__, held["seed"], held["study"]["layouts"], decisive(held, solvers)]
    return f"{scenario}-{held['model']['vehicle']['name']}-{held['solver']['name']}-{digest(described)[:8]}"


OmegaConf.register_new_resolver("torchgco.folder", study_folder, replace=True)


def _recomposer(job: Any) -> Callable[[str], DictConfig]:
    """A function that composes the running job's configuration (its node `hydra`) with another solver."""
    given = [o for o in job.overrides.task if not o.lstrip("+~").startswith(("solver=", "solver."))]
    folders = [source.path for source in job.runtime.config_sources if source.schema == "file"]
    others = [f"file://{path}" for path in folders if str(config_dir()) not in path]

    def recompose(solver: str) -> DictConfig:
        try:
            return _composed((*given, f"solver={solver}"), tuple(others))
        except InputError as error:
            if error.field != "solver":
                raise
            raise InputError("study.baselines", error.expected, solver) from None

    return recompose


@cache
def _composed(overrides: tuple[str, ...], searchpath: tuple[str, ...]) -> DictConfig:
    return compose_config(overrides, searchpath)  # needed several times by the folder's name


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="config")
def _run(config: DictConfig) -> None:
    from torchgco.experiments.study import run_study  # here, as workers import this module and need no figures

    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    try:
        kind, named = ("sweep", job.sweep.dir) if job.mode == RunMode.MULTIRUN else ("run", job.run.dir)
        if not named:
            raise InputError(f"hydra.{kind}.dir", "the name of a folder", "an empty one")
        with raised():  # modules are loaded, and files are about to be written
            flown = run_study(config, folder, _recomposer(job), lambda: _keep_configuration(config, folder))
        if flown == 0:
            raise InputError("scenario", "a layout whose start is outside its obstacles", "none")
    except (InputError, HydraException, OmegaConfBaseException) as error:
        _remove_empty(folder)
        # An exit, because Hydra would print a line before an exception.
        print(f"torchgco: {as_input_error(error)}", file=sys.stderr)
        sys.exit(2)


def _remove_empty(folder: Path) -> None:
    """Remove the folder that Hydra made for a study that is refused, and empty ones around it in the current folder."""
    here = Path.cwd()
    around = [place for place in folder.parents if here in place.parents]
    for place in (folder, *around) if folder != here else ():
        try:
            place.rmdir()
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
    """Run the command line; returns the exit code: 0, 2 for malformed input, 130 when interrupted, 143 by SIGTERM."""
    if "--version" in sys.argv[1:]:
        print(f"torchgco {torchgco.__version__}")
        return 0
    # Hydra would print and exit by itself; with this it raises its errors, and each is printed as one line.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    _composed.cache_clear()  # the files of conf/ may have changed since the last call
    parser = get_args_parser()
    parser.error = _refuse_flags
    try:
        check_words(parser.parse_args().overrides, config_dir())
        _run()
    except (InputError, HydraException, OmegaConfBaseException) as error:
        return _refuse(as_input_error(error))
    except OSError as error:  # Hydra can't make the study's folder; the study's own files raise InputError
        return _refuse(InputError("hydra.run.dir", "a folder that can be made", error))
    except KeyboardInterrupt as error:
        return farewell(error)
    except ValueError as error:
        if not _by_hydra(error):
            raise
        return _refuse(InputError("command line", "words that Hydra accepts", error))
    return 0


def _refuse(error: InputError) -> int:
    print(f"torchgco: {error}", file=sys.stderr)
    return 2


def _refuse_flags(message: str) -> NoReturn:
    sys.exit(_refuse(InputError("command line", "KEY=VALUE, GROUP=OPTION and the flags of --hydra-help", message)))


def _by_hydra(error: BaseException) -> bool:
    """Whether Hydra itself raised an error; it raises plain ones, too."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).startswith("hydra.")
