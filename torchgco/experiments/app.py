"""The command `torchgco`: the only `hydra.main`."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchgco
from torchgco.errors import InputError
from torchgco.experiments.build import as_input_error, config_dir, forget_composed, recomposer
from torchgco.experiments.files import write
from torchgco.experiments.identity import decisive, digest, plain, settings_of
from torchgco.experiments.jobs import Report

# conf/hydra/launcher extends the plugins' configurations of the same names. Hydra warns that it may stop to join them;
# ours are whole.
warnings.filterwarnings("ignore", r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema", UserWarning)
LAUNCHERS = ("joblib", "submitit", "ray")  # packages whose errors tell that a job was killed or timed out


def study_folder(_root_: Any) -> str:
    """A folder name from the settings that decide results. It holds no time, so a second start resumes the first."""
    held = plain(OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"]))
    solvers = {held["solver"]["name"]: {key: value for key, value in held["solver"].items() if key != "name"}}
    recompose = recomposer(_root_.hydra.overrides.task, _root_.hydra.runtime.config_sources)
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


OmegaConf.register_new_resolver("torchgco.folder", study_folder, replace=True)


def _task(config: DictConfig) -> Report:
    from torchgco.experiments.study import run_study  # here, as workers import this module and need no figures

    job = HydraConfig.get()
    folder, overrides = Path(job.runtime.output_dir), list(job.overrides.task)
    alone = job.mode == RunMode.RUN
    try:
        done = run_study(
            config, folder, recomposer(overrides, job.runtime.config_sources),
            lambda: _keep_configuration(config, folder), command=sys.argv[1:] if alone else ["-m", *overrides],
        )  # fmt: skip
    except InputError as error:
        if not alone:
            return Report(str(folder), overrides, False, str(error))
        # An exit, because Hydra would print a line before an exception.
        print(f"torchgco: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        if _is_of_launcher(error):
            return Report(str(folder), overrides, False, _stopped(error))
        raise
    return Report(str(folder), overrides, done)


# Not as a decorator: launchers send the task to other processes by its name.
_run = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="config")(_task)


def _is_of_launcher(error: Exception) -> bool:
    return type(error).__module__.split(".")[0] in LAUNCHERS


def _stopped(error: Exception) -> str:
    """A launcher's error as one line."""
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return f"a job was stopped ({reason}); what jobs flew is kept, and the same command resumes"


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
    forget_composed()  # the files of conf/ may have changed since the last call
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
    except Exception as error:
        if not _is_of_launcher(error):
            raise
        print(f"torchgco: {_stopped(error)}", file=sys.stderr)
        return 1
    return 0
