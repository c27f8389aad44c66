"""The command `torchgco`: the only `hydra.main`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchgco
from torchgco.errors import InputError
from torchgco.experiments.build import as_input_error, compose_config, config_dir
from torchgco.experiments.files import write
from torchgco.experiments.hydra_versions import ENTRY, register_resolver
from torchgco.experiments.identity import decisive, digest, plain, settings_of


def study_folder(_root_: Any) -> str:
    """A folder name from the settings that decide results. It holds no time, so a second start resumes the first."""
    held = plain(OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"]))
    solvers = {held["solver"]["name"]: {key: value for key, value in held["solver"].items() if key != "name"}}
    recompose = _recomposer(_root_.hydra)
    baselines = held["study"]["baselines"]
    for name in baselines if isinstance(baselines, list) else ():
        try:
            solvers.setdefault(str(name), settings_of(recompose(str(name))))
        except InputError:  # an unknown solver, say: the study itself refuses it in one line
            solvers.setdefault(str(name), {})
    path = held["scenario"].get("path")
    scenario = Path(path).stem if path else held["scenario"]["name"]
    described = [torchgco.__version__, held["seed"], held["study"]["layouts"], decisive(held, solvers)]
    return f"{scenario}-{held['model']['vehicle']['name']}-{held['solver']['name']}-{digest(described)[:8]}"


register_resolver("torchgco.folder", study_folder)


def _recomposer(job: Any) -> Callable[[str], DictConfig]:
    """A function that composes the running job's configuration (its node `hydra`) with another solver."""
    given = [o for o in job.overrides.task if not o.lstrip("+~").startswith(("solver=", "solver."))]
    folders = [source.path for source in job.runtime.config_sources if source.schema == "file"]
    others = [f"file://{path}" for path in folders if str(config_dir()) not in path]
    return lambda solver: _composed((*given, f"solver={solver}"), tuple(others))


@cache
def _composed(overrides: tuple[str, ...], searchpath: tuple[str, ...]) -> DictConfig:
    return compose_config(overrides, searchpath)  # needed several times by the folder's name


@hydra.main(config_path=str(config_dir()), config_name="config", **ENTRY)
def _run(config: DictConfig) -> None:
    from torchgco.experiments.study import run_study  # here, as workers import this module and need no figures

    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    try:
        if run_study(config, folder, _recomposer(job), lambda: _keep_configuration(config, folder)) == 0:
            raise InputError("scenario", "a layout whose start is outside its obstacles", "none")
    except InputError as error:
        # An exit, because Hydra would print a line before an exception.
        print(f"torchgco: {error}", file=sys.stderr)
        sys.exit(2)


def _keep_configuration(config: DictConfig, folder: Path) -> None:
    """Write `.hydra/` as Hydra does, but only once the command is accepted (`hydra.output_subdir` is null)."""
    whole: Any = HydraConfig.instance().cfg
    texts = {"config": config, "hydra": whole, "overrides": whole.hydra.overrides.task}
    for name, node in texts.items():
        text = OmegaConf.to_yaml(node).encode()
        write(folder / ".hydra" / f"{name}.yaml", lambda file, text=text: file.write(text))


def main() -> int:
    """Run the command line; returns the exit code: 0, 2 for malformed input, 130 when interrupted."""
    if "--version" in sys.argv[1:]:
        print(f"torchgco {torchgco.__version__}")
        return 0
    # Hydra would print and exit by itself; with this it raises its errors, and each is printed as one line.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    _composed.cache_clear()  # the files of conf/ may have changed since the last call
    try:
        _run()
    except (HydraException, OmegaConfBaseException) as error:
        print(f"torchgco: {as_input_error(error)}", file=sys.stderr)
        return 2
    except OSError as error:  # Hydra can't make the study's folder; the study's own files raise InputError
        print(f"torchgco: {InputError('hydra.run.dir', 'a folder that can be made', error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ntorchgco: interrupted; the same command resumes from here", file=sys.stderr)
        return 130
    return 0
