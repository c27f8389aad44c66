"""From a Hydra config to objects: the only place that instantiates."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton
from hydra.errors import HydraException, InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchgco
from torchgco.errors import InputError
from torchgco.experiments.hydra_versions import ANY_CLASS, ENTRY
from torchgco.experiments.preset_nodes import register
from torchgco.kernels import use_native
from torchgco.scenarios import Layouts, Scenario, Task, Vehicle
from torchgco.simulation import Mission

DEFAULT_LAYOUTS = 64
register()


def config_dir() -> Path:
    """Absolute path of conf/: next to the package in a checkout, inside it in a wheel."""
    package = Path(torchgco.__file__).resolve().parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError(f"no conf/config.yaml in or next to {package}")


@dataclass(frozen=True)
class Setup:
    """A composed configuration and the objects made from it, for studies and notebooks."""

    config: DictConfig
    vehicle: Vehicle
    scenario: Scenario
    solver: Any
    solver_name: str
    seed: int
    device: torch.device
    dtype: torch.dtype
    mission: Mission | None = None  # with the solver under study as its planner's

    def layouts(self, count: int | None = None) -> Layouts:
        """Layouts 0..count-1 under the seed; by default all of a file, or 64.

        Raises:
            InputError: count below 1, or more than there are.
        """
        count = count if count is not None else self.config.study.layouts
        count = count if count is not None else self.scenario.available or DEFAULT_LAYOUTS
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError("study.layouts", "at least 1", repr(count))
        return self.scenario.draw(range(count), self.seed)

    def task(self, layouts: Layouts | None = None) -> Task:
        """The planning problems of some layouts (default: `layouts()`) on the configured device."""
        return self.vehicle.task(layouts or self.layouts(), self.device, self.dtype)


def compose(overrides: Sequence[str] = ()) -> Setup:
    """The objects that `torchgco` would use with these command-line overrides.

    Raises:
        InputError: unknown key or group, or a value that a part refuses.
    """
    return build(compose_config(overrides))


def compose_config(overrides: Sequence[str], searchpath: Sequence[str] = ()) -> DictConfig:
    """The configuration alone; `searchpath` names further folders of configs."""
    extra = [f"hydra.searchpath=[{','.join(searchpath)}]"] if searchpath else []
    running = Singleton.get_state()  # a study composes its baselines while Hydra's own main runs
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(config_dir()), **ENTRY):
            return hydra.compose("config", [*overrides, *extra])
    except (HydraException, OmegaConfBaseException) as error:
        raise as_input_error(error) from None
    finally:
        Singleton.set_state(running)


def build(config: DictConfig) -> Setup:
    """Instantiate model, scenario, solver and device of a configuration.

    Raises:
        InputError: a value that a part refuses, or parts that don't fit each other.
    """
    seed = config.seed
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError("seed", "a whole number of at least 0", repr(seed))
    device, dtype = _device(config.device)
    setup = Setup(
        config=config,
        vehicle=_instantiate(config.model.vehicle, "model.vehicle"),
        scenario=_instantiate(config.scenario, "scenario"),
        solver=solver_of(config),
        solver_name=config.solver.name,
        seed=seed,
        device=device,
        dtype=dtype,
    )
    setup = replace(setup, mission=_mission(setup))
    if config.model.dimension != setup.vehicle.dimension:
        raise InputError("model.dimension", f"{setup.vehicle.dimension}, as its dynamics say", config.model.dimension)
    if setup.scenario.dimension != setup.vehicle.dimension:
        other = "quadrotor" if setup.scenario.dimension == 3 else "planar"
        wanted = f"model={other}, as {setup.scenario.name} is {setup.scenario.dimension}-D"
        raise InputError("model", wanted, f"model={setup.vehicle.name}")
    return setup


def _mission(setup: Setup) -> Mission | None:
    """The closed loop of a configuration; None where it has none.

    Raises:
        InputError: a value that a part refuses, a model other than the quadrotor, or a device other than the CPU.
    """
    node = setup.config.get("mission")
    if node is None:
        if setup.config.get("plant") is not None:
            raise InputError("plant", "a mission: experiment=mission or mission=default", "a plant alone")
        return None
    if setup.config.get("plant") is None:
        raise InputError("plant", "the vehicle that flies the mission: plant=rotors", "none")
    if setup.device.type != "cpu" or setup.dtype != torch.float64:
        raise InputError("device", "device=cpu in float64 for missions", f"{setup.device.type}, {setup.dtype}")
    parts = {name: _instantiate(node[name], f"mission.{name}") for name in ("planner", "tracker", "disturbance")}
    held = OmegaConf.to_container(node, resolve=True)
    assert isinstance(held, dict)
    others: dict[str, Any] = {str(key): value for key, value in held.items() if key not in parts}
    planner = parts.pop("planner")(solver=setup.solver)
    try:
        mission = Mission(planner=planner, plant=_instantiate(setup.config.plant, "plant"), **parts, **others)
    except TypeError as error:
        raise InputError("mission", "keys that the configuration knows", error) from None
    mission.check(setup.vehicle.dynamics)
    return mission


def solver_of(config: DictConfig) -> Any:
    """The solver alone."""
    return _instantiate(config.solver, "solver", leave_out="name")


def _instantiate(node: DictConfig, field: str, leave_out: str | None = None) -> Any:
    try:
        # Containers become lists here: no part of the library knows OmegaConf.
        plain = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
        assert isinstance(plain, dict)
        parts = {key: value for key, value in plain.items() if key != leave_out}
        return hydra.utils.instantiate(parts, _convert_="all", **ANY_CLASS)
    except (InstantiationException, OmegaConfBaseException, TypeError) as error:  # Hydra 1.4 wraps no TypeError
        raise as_input_error(error, field) from None


def as_input_error(error: BaseException, field: str = "configuration") -> InputError:
    """An error of Hydra or OmegaConf as one line that names the key."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return cause
        cause = cause.__cause__
    text = "\n".join((str(error), *getattr(error, "__notes__", ())))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    key = getattr(error, "full_key", None) or next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("full_key:")), field
    )
    message = " ".join(line for line in lines if not line.startswith(("full_key:", "object_type=")))
    return InputError(str(key) or field, "a value that the configuration knows", message)


def _device(node: DictConfig) -> tuple[torch.device, torch.dtype]:
    """The device and dtype; also sets the threads and kernels of this process."""
    if node.name not in ("cpu", "cuda"):
        raise InputError("device.name", "cpu or cuda", node.name)
    if node.name == "cuda" and not torch.cuda.is_available():
        raise InputError("device", "device=cpu, as no CUDA device is visible", "device=cuda")
    if node.dtype not in ("float64", "float32"):
        raise InputError("device.dtype", "float64 or float32", node.dtype)
    if node.kernels not in ("native", "eager"):
        raise InputError("device.kernels", "native or eager", repr(node.kernels))
    torch.set_num_threads(_threads(node.threads))
    use_native(node.kernels == "native")
    return torch.device(node.name), getattr(torch, node.dtype)


def allotted_cores() -> int:
    """Cores that this process may use, according to Slurm or else the system."""
    return int(os.environ.get("SLURM_CPUS_PER_TASK", 0)) or len(os.sched_getaffinity(0))


def _threads(wanted: int | None) -> int:
    if wanted is None:
        return allotted_cores()
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise InputError("device.threads", "at least 1, or null for all that are allotted", repr(wanted))
    return wanted
