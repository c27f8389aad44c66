"""The command `torchgco`: the only `hydra.main`."""

from __future__ import annotations

import json
import os
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchgco
from torchgco.experiments.build import as_input_error, compose_config, config_dir
from torchgco.experiments.study import run_study
from torchgco.shapes import InputError


def study_folder(_root_: Any) -> str:
    """A name for what a configuration computes: no clock in it, so a second start finds the first one's work."""
    plain = OmegaConf.to_container(_root_, resolve=False)
    assert isinstance(plain, dict)
    plain.pop("hydra", None)
    path = plain["scenario"].get("path")
    scenario = Path(path).stem if path else plain["scenario"]["name"]
    code = sha256(json.dumps([torchgco.__version__, plain], sort_keys=True, default=str).encode()).hexdigest()
    return f"{scenario}-{plain['model']['vehicle']['name']}-{plain['solver']['name']}-{code[:8]}"


OmegaConf.register_new_resolver("torchgco.folder", study_folder, replace=True)


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="config")
def _run(config: DictConfig) -> None:
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    given = [o for o in job.overrides.task if not o.lstrip("+~").startswith(("solver=", "solver."))]
    searchpath = [f"file://{s.path}" for s in job.runtime.config_sources if s.schema == "file"]

    def recompose(solver: str) -> DictConfig:
        return compose_config([*given, f"solver={solver}"], [p for p in searchpath if str(config_dir()) not in p])

    try:
        if run_study(config, folder, recompose) == 0:
            raise InputError("scenario", "a layout whose start is outside its obstacles", "none")
    except InputError as error:
        # An exit, as Hydra would put a line of its own before an exception.
        print(f"torchgco: {error}", file=sys.stderr)
        sys.exit(2)


def main() -> int:
    """Run the command line; returns the exit code: 0, 2 for malformed input, 130 when interrupted."""
    if "--version" in sys.argv[1:]:
        print(f"torchgco {torchgco.__version__}")
        return 0
    # Hydra would print and exit by itself; with this it hands its errors on, to be told in one line.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        _run()
    except (HydraException, OmegaConfBaseException) as error:
        print(f"torchgco: {as_input_error(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ntorchgco: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    return 0
