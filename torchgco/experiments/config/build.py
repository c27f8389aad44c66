"""From a Hydra config to objects: the only place that instantiates, and only what a study's files may make."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from typing import Annotated, Any, Literal

import hydra
import numpy as np
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, InstantiationException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchgco.base.errors import InputError
from torchgco.base.memory import free_memory
from torchgco.base.options import Checked, Count, Within, check_value
from torchgco.base.shapes import check_device
from torchgco.dynamics import QuadrotorPlanning, QuadrotorThrusts
from torchgco.experiments.config.checks import as_input_error, check, hydra_words
from torchgco.experiments.config.groups import ANY_CLASS, ENTRY, classes_of, config_dir, register, scenarios_for
from torchgco.experiments.config.launching import allotted_cores
from torchgco.experiments.results.identity import settings_of
from torchgco.fleets.drawn import fleet_of
from torchgco.fleets.fleet import Fleet
from torchgco.kernels import use_native
from torchgco.missions import Mission, RaceMission
from torchgco.missions.mission import OTHER_MODELS
from torchgco.missions.plant import Plant, flown
from torchgco.scenarios import GateForest, Layouts, Race, Scenario, Task, Vehicle
from torchgco.scenarios.base import Family
from torchgco.scenarios.vehicle import BUILT_IN, fitting
from torchgco.solvers.memory import least_bytes

TARGET = "_target_"
PARTIAL = "_partial_"  # of missions: their planner and plant are put in later


def check_stored(tree: Any, group: str, field: str) -> None:
    """Check that a node of a study's file, in plain containers, makes nothing but classes of a group's own options.

    Their arguments are numbers, texts, lists and further classes of the group, by name too: no interpolations, which
    could read the environment, and no free mappings, which are options of other libraries.

    Args:
        group: of `conf`: model, solver, mission or plant.
        field: where the node lies, for errors.

    Raises:
        InputError: the node makes anything else.
    """
    if not isinstance(tree, Mapping) or TARGET not in tree:
        raise _refused(field, f"a node with a {TARGET}", tree)
    _check(tree, classes_of(group), group, field)


def _check(value: Any, known: frozenset[type], group: str, field: str) -> None:
    if isinstance(value, str) and "${" in value:
        raise _refused(field, "a text without interpolations", value)
    if isinstance(value, list):
        for i, item in enumerate(value):
            _check(item, known, group, f"{field}.{i}")
    if not isinstance(value, Mapping):
        return
    if TARGET not in value:
        if not value or not all(isinstance(item, Mapping) and TARGET in item for item in value.values()):
            raise _refused(field, "a number, a text, a list, a class or classes by name", value)
        for name, item in value.items():
            _check(item, known, group, f"{field}.{name}")
        return
    if not _is_known(value[TARGET], known):
        raise _refused(f"{field}.{TARGET}", f"a class that torchgco's own options of {group} make", value[TARGET])
    for key, item in value.items():
        if key.startswith("_") and key != TARGET and not (key == PARTIAL and group == "mission"):
            raise _refused(field, f"fields of {value[TARGET]}", key)
        _check(item, known, group, f"{field}.{key}")


def _is_known(target: Any, known: frozenset[type]) -> bool:
    """Whether a path names one of the classes. Nothing is imported: modules of the classes are by now."""
    module, _, name = target.rpartition(".") if isinstance(target, str) else ("", "", "")
    attribute = vars(sys.modules[module]).get(name) if module in sys.modules else None
    return any(attribute is kind for kind in known)


def _refused(field: str, expected: str, got: Any) -> InputError:
    return InputError(field, f"{expected} (--trust admits any, and its code runs)", got)


DEFAULT_LAYOUTS = 64
FLOWN = (
    "one in space for a mission: crossing, cylinders, forest, forest_moving, mazes, rooms, swarm, trefoils, walls, "
    f"woods, or a layout file ({OTHER_MODELS})"
)
RACED = "race, or a layout file with gates and a free time, for mission=race"
MAX_PROCESSES = 1024  # threads, too: PyTorch ends with an error of the system long before the system's own limit
register()


@dataclass(frozen=True)
class Setup:
    """A composed configuration, resolved, in plain containers, and the objects made from it."""

    configuration: dict[str, Any]
    vehicle: Vehicle
    scenario: Scenario
    solver: Any
    solver_name: str
    seed: int
    devices: tuple[torch.device, ...]  # that share a study's layouts, in turn
    dtype: torch.dtype
    mission: Mission | None = None  # with the solver under study as its planner's
    metrics: Mapping[str, Callable[..., Any]] = field(default_factory=dict)  # of the user, see `study.metrics`
    turn: int = 0  # of the process that works, among those that share the devices

    @property
    def device(self) -> torch.device:
        """That this process works on."""
        return self.devices[self.turn % len(self.devices)]

    def layouts(self, count: int | None = None) -> Layouts:
        """Layouts 0..count-1 under the seed; by default all of a file, or 64.

        Raises:
            InputError: count below 1, more than there are, or more than fit into memory.
        """
        count = count if count is not None else self.configuration["study"]["layouts"]
        count = count if count is not None else self.scenario.available or DEFAULT_LAYOUTS
        check_value(count, Count, "study.layouts")
        self._refuse_beyond_memory(self.scenario.draw(range(1), self.seed), count)
        drawn = self.vehicle.at_rest(self.scenario.draw(range(count), self.seed))
        if self.mission is not None and drawn.stages is not None:  # a planner plans over one number of stages
            return replace(drawn, stages=int(np.max(drawn.stages)))
        return drawn

    def _refuse_beyond_memory(self, first: Layouts, count: int) -> None:
        """Raise where one problem, or all layouts and controls, exceed the free memory: the system would kill us."""
        dynamics, free = self.vehicle.dynamics, free_memory()
        N = self.vehicle.stages if first.stages is None else int(np.max(first.stages))
        bodies = first.radii.shape[1] + (0 if first.box_centers is None else first.box_centers.shape[1])
        problem = least_bytes(N, dynamics.n, dynamics.m, N * (bodies + 2 * dynamics.m))
        if problem > free:
            field = "model.vehicle.stages" if first.stages is None else "scenario.stages"
            got = f"{N} stages with {bodies} obstacles, {_gigabytes(problem)} or more"
            raise InputError(field, f"a problem that fits into the free memory, {_gigabytes(free)}", got)
        arrays = replace(first, map=None).arrays()
        of_map = first.map.values.nbytes if first.map is not None and not self.scenario.shares_map else 0
        flights = count * (
            sum(array.nbytes for array in arrays.values()) + of_map + 8 * N * dynamics.m * (first.vehicles or 1)
        )
        if flights > free:
            got = f"{count}, {_gigabytes(flights)} or more"
            raise InputError("study.layouts", f"layouts that fit into the free memory, {_gigabytes(free)}", got)

    def fleet(self, layouts: Layouts | None = None) -> Fleet:
        """The fleets of some layouts (default: `layouts()`)."""
        return fleet_of(self.vehicle, layouts or self.layouts())

    def task(self, layouts: Layouts | None = None) -> Task:
        """The planning problems of some layouts (default: `layouts()`) on this process's device."""
        return self.vehicle.task(layouts or self.layouts(), self.device, self.dtype)


def compose(overrides: Sequence[str] = ()) -> Setup:
    """The objects that `torchgco` would use with these command-line overrides.

    Raises:
        InputError: unknown key or group, or a value that a part refuses; overrides that aren't a list of texts.
    """
    check_value(overrides, Sequence[str], "overrides")
    return build(compose_config(overrides))


def compose_config(overrides: Sequence[str], searchpath: Sequence[str] = ()) -> dict[str, Any]:
    """The configuration alone, as `plain` has it; `searchpath` names further folders of configs."""
    extra = [f"hydra.searchpath=[{','.join(searchpath)}]"] if searchpath else []
    words = hydra_words(overrides)
    running = GlobalHydra.instance().hydra  # a study composes its baselines while Hydra's own main runs
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(config_dir()), **ENTRY):
            return plain(hydra.compose("config", [*words, *extra]))
    except (HydraException, OmegaConfBaseException) as error:
        raise as_input_error(error) from None
    finally:
        GlobalHydra.instance().hydra = running


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as plain dicts, lists and numbers, resolved: no part of the library knows OmegaConf."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def recomposer(overrides: Sequence[str], sources: Iterable[Any]) -> Callable[[str | None], dict[str, Any]]:
    """A function that composes the configuration of some overrides with another solver, with None as it is.

    `sources` are Hydra's own `config_sources` of the command.
    """
    shared = [o for o in overrides if not o.lstrip("+~").startswith(("solver=", "solver."))]
    folders = [source.path for source in sources if source.schema == "file"]
    others = tuple(f"file://{path}" for path in folders if str(config_dir()) not in path)

    def recompose(solver: str | None) -> dict[str, Any]:
        try:
            return _composed(tuple(overrides) if solver is None else (*shared, f"solver={solver}"), others)
        except InputError as error:
            if solver is None or error.field != "solver":
                raise
            raise InputError("study.baselines", error.expected, solver) from None

    return recompose


@cache
def _composed(overrides: tuple[str, ...], searchpath: tuple[str, ...]) -> dict[str, Any]:
    return compose_config(overrides, searchpath)  # needed several times by the folder's name


def forget_composed() -> None:
    """Compose again what `recomposer` composes: the files of conf/ may have changed."""
    _composed.cache_clear()


def build(configuration: dict[str, Any]) -> Setup:
    """Instantiate model, scenario, solver and device of a configuration, as `plain` has it.

    Raises:
        InputError: a value that a part refuses, or parts that don't fit each other.
    """
    check(configuration)
    scenario, model = configuration["scenario"], configuration["model"]
    if scenario.get("path") == MISSING:
        of_map = str(scenario.get("_target_")).endswith("MapFile")
        wanted = "the map: add scenario.path=FILE" if of_map else "the layout file: add scenario.path=FILE.npz"
        raise InputError("scenario.path", wanted, "none")
    devices, dtype = _devices(configuration["device"])
    vehicle = _vehicle(configuration)
    setup = Setup(
        configuration=configuration,
        vehicle=vehicle,
        scenario=vehicle.flying(_instantiate(scenario, "scenario")),
        solver=solver_of(configuration),
        solver_name=configuration["solver"]["name"],
        seed=configuration["seed"],
        devices=devices,
        dtype=dtype,
        metrics=metrics_of(configuration),
    )
    setup = replace(setup, mission=_mission(setup))
    if model["dimension"] != setup.vehicle.dimension:
        raise InputError("model.dimension", f"{setup.vehicle.dimension}, as its dynamics say", model["dimension"])
    d, n = setup.scenario.dimension, setup.scenario.states
    another = n != setup.vehicle.dynamics.n and (d, n) in BUILT_IN.values()
    if d != setup.vehicle.dimension or another:
        form = f"{d}-D" if n is None else f"{d}-D with {n} states"
        wanted = f"{fitting(d, n)}, as {setup.scenario.name} is {form}"
        if d != setup.vehicle.dimension and (others := scenarios_for(setup.vehicle.name)):
            wanted += f", or scenario={' or '.join(others)}"
        raise InputError("model", wanted, f"model={setup.vehicle.name}")
    return setup


def _vehicle(configuration: Mapping[str, Any]) -> Vehicle:
    """The model; mistakes in its airframe have the names that a command has for it."""
    try:
        return _instantiate(configuration["model"]["vehicle"], "model.vehicle")
    except InputError as error:
        group, _, name = error.field.partition(".")
        if group != "airframe" or configuration.get("vehicle") is None:
            raise
        raise InputError(f"vehicle.{name}", error.expected, error.got) from None


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.3g} GB"


def _mission(setup: Setup) -> Mission | None:
    """The closed loop of a configuration; None where it has none.

    Raises:
        InputError: a value that a part refuses, a model other than the quadrotor, or a device other than the CPU.
    """
    node, plant = setup.configuration.get("mission"), setup.configuration.get("plant")
    if node is None:
        if plant is not None:
            raise InputError("plant", "a mission: experiment=mission or mission=default", "a plant alone")
        return None
    if plant is None:
        raise InputError("plant", "the vehicle that flies the mission: plant=rotors", "none")
    if setup.device.type != "cpu" or setup.dtype != torch.float64:
        raise InputError("device", "device=cpu in float64 for missions", f"{setup.device.type}, {setup.dtype}")
    made, scenario = _instantiate(node, "mission"), setup.scenario
    raced = isinstance(made, partial) and made.func is RaceMission
    if raced and isinstance(scenario, Family) and not isinstance(scenario, Race):
        raise InputError("scenario", RACED, scenario.name)
    if scenario.dimension != 3 or (isinstance(scenario, GateForest | Race) and not raced):
        raise InputError("scenario", FLOWN, scenario.name)
    mission = _closed_loop(made, _instantiate(plant, "plant"), setup.solver, setup.vehicle)
    mission.check(setup.vehicle.dynamics)
    return mission


def _closed_loop(made: Any, plant: Any, solver: Any, vehicle: Vehicle) -> Mission:
    if isinstance(plant, Plant) and isinstance(vehicle.dynamics, QuadrotorPlanning | QuadrotorThrusts):
        plant = flown(plant, vehicle.dynamics.airframe)  # said once, in the model
    if not isinstance(made, partial) or "planner" not in made.keywords:
        raise InputError(
            "mission", "keys that extend those of mission=default", "a node without its _target_ or planner"
        )
    field = "mission.planner"
    try:
        planner = made.keywords["planner"](solver=solver)
        field = "mission"
        return made(planner=planner, plant=plant)
    except TypeError as error:
        raise as_input_error(error, field) from None


def metrics_of(configuration: Mapping[str, Any]) -> dict[str, Callable[..., Any]]:
    """The functions of `study.metrics` by name: each the path of one, or a node with the path as `_target_`."""
    nodes = configuration["study"].get("metrics") or {}
    if not isinstance(nodes, Mapping):
        raise InputError("study.metrics", "functions by name, such as {jerk: own.jerk}", repr(nodes))
    made = {}
    for name, node in nodes.items():
        whole, field = node if isinstance(node, Mapping) else {"_target_": node}, f"study.metrics.{name}"
        check_value(whole.get("_target_"), str, field)
        made[str(name)] = _instantiate({**whole, "_partial_": True}, field)
    return made


def solver_of(configuration: Mapping[str, Any]) -> Any:
    """The solver alone."""
    return _instantiate(settings_of(configuration), "solver")


def solver_from(settings: Mapping[str, Any], trust: bool = False) -> Any:
    """A solver from its resolved settings in plain dicts, as study.json holds them; see `_stored`."""
    return _stored(settings, "solver", "solver", trust)


def mission_from(configuration: Mapping[str, Any], solver: Any, trust: bool = False) -> Mission:
    """The closed loop of a study of missions with a solver as its planner's, from its configuration; see `_stored`."""
    mission, plant = (_stored(configuration.get(key), key, key, trust) for key in ("mission", "plant"))
    return _closed_loop(mission, plant, solver, vehicle_of(configuration, trust))


def vehicle_of(configuration: Mapping[str, Any], trust: bool = False) -> Vehicle:
    """The planning model of a study, from its resolved configuration in plain dicts; see `_stored`."""
    return _stored(configuration["model"]["vehicle"], "model", "model.vehicle", trust)


def _stored(tree: Any, group: str, field: str, trust: bool) -> Any:
    """What a node of a study's file makes.

    Args:
        trust: whether it may name any class, function or module, which then runs.

    Raises:
        InputError: as `check_stored` without trust, or a value that a part refuses.
    """
    if not trust:
        check_stored(tree, group, field)
    return _instantiate(tree, field)


def _instantiate(node: Any, field: str) -> Any:
    if not isinstance(node, dict):
        raise InputError(field, "a group of keys", repr(node))
    try:
        return hydra.utils.instantiate(node, _convert_="all", **ANY_CLASS)
    except RecursionError:
        raise InputError(field, "less deeply nested keys", "more than Python can follow") from None
    except (InstantiationException, OmegaConfBaseException, TypeError) as error:  # Hydra 1.4 wraps no TypeError
        raise as_input_error(error, field) from None


@dataclass(frozen=True)
class _Device(Checked, named="device"):
    """The node `device`."""

    name: str
    dtype: Literal["float64", "float32"]
    kernels: Literal["native", "eager"]
    threads: Annotated[int, Within(1, MAX_PROCESSES)] | None


def _devices(node: Mapping[str, Any]) -> tuple[tuple[torch.device, ...], torch.dtype]:
    """The devices and dtype; also sets the threads and kernels of this process."""
    device = _Device(**{field.name: node[field.name] for field in fields(_Device)})
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device.name):
        raise InputError("device.name", "cpu, cuda, or one of several such as cuda:1", device.name)
    check_device(device.name)
    torch.set_num_threads(allotted_cores() if device.threads is None else device.threads)
    use_native(device.kernels == "native")
    every = range(torch.cuda.device_count()) if device.name == "cuda" else ()
    devices = tuple(torch.device("cuda", number) for number in every) or (torch.device(device.name),)
    return devices, getattr(torch, device.dtype)
