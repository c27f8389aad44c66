"""What Hydra is given before it composes: options of groups made from classes, functions in interpolations, versions.

Scenarios, solvers, missions and plants need no file in conf/: their options are the fields of their classes, with the
defaults as values. A solver's option that differs between the plane and space becomes an interpolation that chooses by
`model.dimension`. Files, of conf/ or of a user, add to them or extend them by name.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

import hydra
import omegaconf
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from omegaconf import OmegaConf

from torchgco.base.version import PACKAGE
from torchgco.constraints import Cone, ControlBounds, NormBounds, RateBounds, StateBounds
from torchgco.dynamics import Airframe
from torchgco.exploration import SensorMission
from torchgco.missions import Disturbance, Planner, RaceMission, RacePlanner, RotorPlant, Tracker
from torchgco.obstacles import Body
from torchgco.presets import PRESETS
from torchgco.scenarios import FAMILIES, Floors, LayoutFile, MapFile
from torchgco.scenarios.maps import DRAWN_PACES
from torchgco.scenarios.quadrotor import PLANNING_STATES
from torchgco.scenarios.vehicle import BUILT_IN
from torchgco.search import Passes

ANYWHERE = {2: "unicycle", 3: "quadrotor"}  # the model for layouts that give positions alone
BY_DIMENSION = "torchgco.by_dimension"
SHARED_FIELDS = ("airframe", "dt")  # fields that the parts of a mission share: a change would have to be made in each
HELP_WIDTH = 100  # of the help page
# Classes that a vehicle's `shape` and `constraints` may name in files of others: they call no function of theirs.
OF_MODELS = frozenset({Body, Cone, ControlBounds, NormBounds, RateBounds, StateBounds})
_targets: dict[str, set[str]] = {}  # paths of the classes that registered options make, by group


def _version(package: Any) -> tuple[int, ...]:
    return tuple(map(int, package.__version__.split(".")[:2]))


OLDER = _version(hydra) < (1, 4)
# Arguments of Hydra's entry points. Without them Hydra 1.3 would behave as 1.1 did; 1.4 warns of them.
ENTRY: dict[str, Any] = {"version_base": "1.3"} if OLDER else {}
# Arguments of `instantiate`. A configuration may name any class, such as a user's own solver; 1.4 wants that said.
ANY_CLASS: dict[str, Any] = (
    {} if OLDER else {"_execution_whitelist_": vars(hydra.utils)["UNSAFE_DISABLE_EXECUTION_CHECKS"]}
)


def register_resolver(name: str, resolver: Callable[..., Any]) -> None:
    """Let configurations call `resolver` as ${name:...}, also where that name has been registered before."""
    # OmegaConf 2.4 warns of the name that was the only one until then, and uses a name that was another function's.
    method = "register_resolver" if _version(omegaconf) >= (2, 4) else "register_new_resolver"
    getattr(OmegaConf, method)(name, resolver, replace=True)


def config_dir() -> Path:
    """Absolute path of conf/: next to the package in a checkout, inside it in a wheel."""
    package = PACKAGE
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError(f"no conf/config.yaml in or next to {package}")


def options_of(group: str) -> list[str]:
    """The names in a group, of files in conf/ and of what is registered; none for a word that is no group."""
    store = ConfigStore.instance()
    stored = store.list(group) if store.get_type(group) is ObjectType.GROUP else []
    return sorted({Path(name).stem for name in (*stored, *(config_dir() / group).glob("*.yaml"))})


def scenarios_for(model: str) -> list[str]:
    """The families of layouts that a built-in model flies; none for another model."""
    return sorted(family().name for family in FAMILIES if model == _model_of(family()))


def _model_of(made: Any) -> str:
    """The built-in model that flies a family's layouts unless a command names another."""
    if made.states is None:  # positions alone
        return made.model or ANYWHERE[made.dimension]
    return next(name for name, space in BUILT_IN.items() if space == (made.dimension, made.states))


def register() -> None:
    """Store the options of all groups; to be called before Hydra composes anything."""
    register_resolver(BY_DIMENSION, _by_dimension)
    register_resolver("torchgco.drawn", _drawn)
    register_resolver("torchgco.options", _help)
    register_resolver("torchgco.radius", _radius)
    register_resolver("torchgco.pace", _pace)
    register_resolver("torchgco.hover", lambda _root_: _root_.vehicle.mass * _root_.vehicle.gravity / 4.0)
    # Hydra copies the whole store for each composition, 40 % of its time, and copies again what it takes from it.
    setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010
    _store("scenario", "layouts", _fields_of(LayoutFile))
    _store("scenario", "map", _fields_of(MapFile) | {"pace": "${torchgco.pace:null}"})
    for family in FAMILIES:
        made = family()
        picked = {"defaults": [{"override /model@_global_.model": _model_of(made)}, "_self_"]}
        _store("scenario", made.name, picked | _fields_of(family) | _sizes(made))
    for name, make in PRESETS.items():
        trees = _tree(make(2)), _tree(make(3))
        _store("solver", name, {"name": name} | _joined(*trees), *trees)
    _store("vehicle", "paper", _fields_of(Airframe))
    _store("plant", "rotors", _fields_of(RotorPlant, *SHARED_FIELDS))
    planner = {"_partial_": True} | _fields_of(Planner, "solver", *SHARED_FIELDS)  # its solver is the one under study
    parts = {"planner": planner, "tracker": _fields_of(Tracker, *SHARED_FIELDS), "disturbance": _fields_of(Disturbance)}
    _store("mission", "default", {"_partial_": True} | _fields_of(SensorMission, "plant", *parts) | parts)
    parts |= {"planner": {"_partial_": True} | _fields_of(RacePlanner, "solver")}
    _store("mission", "race", {"_partial_": True} | _fields_of(RaceMission, "plant", "latency", *parts) | parts)


def classes_of(group: str) -> frozenset[type]:
    """The classes that the options of a group make, parts included: registered options and files of conf/."""
    trees = [OmegaConf.to_container(OmegaConf.load(path)) for path in (config_dir() / group).glob("*.yaml")]
    named = {*_targets.get(group, ()), *(target for tree in trees for target in _named(tree))}
    parts = classes_of("vehicle") | OF_MODELS if group == "model" else ()  # a model holds the airframe chosen there
    return frozenset(hydra.utils.get_class(target) for target in named) | frozenset(parts)


def _named(tree: Any) -> Iterator[str]:
    """The `_target_`s in nested containers."""
    if isinstance(tree, dict):
        yield from (value for key, value in tree.items() if key == "_target_")
    for value in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _named(value)


def _store(group: str, name: str, node: dict[str, Any], *trees: Any) -> None:
    """Store an option of a group; `trees` are its nodes without interpolations, where it has some."""
    ConfigStore.instance().store(group=group, name=name, node=node)
    _targets.setdefault(group, set()).update(_named(list(trees or (node,))))


def _by_dimension(dimension: int, plane: Any, space: Any) -> Any:
    """The value for this dimension of space, in a form that OmegaConf takes when it resolves a configuration."""
    chosen = space if dimension == 3 else plane
    return OmegaConf.create(chosen) if isinstance(chosen, list | dict) else chosen


def _drawn(count: int, _root_: Any) -> int | None:
    """A number of layouts where they are drawn; None, all of them, where they come from a file."""
    scenario = _root_.get("scenario")
    return None if OmegaConf.is_dict(scenario) and "path" in scenario else count


def _fields_of(kind: type, *left_out: str) -> dict[str, Any]:
    """The fields of a class with their defaults, as containers that Hydra instantiates; ??? where there is none."""
    named = [field for field in fields(kind) if field.init and field.name not in left_out]
    return {"_target_": _path(kind)} | {field.name: _default(field) for field in named}


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _default(field: Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return _tree(field.default_factory())
    return "???" if field.default is MISSING else _tree(field.default)


def _tree(value: Any) -> Any:
    """An object as nested containers that Hydra instantiates."""
    if is_dataclass(value) and not isinstance(value, type):
        tree = {field.name: _tree(getattr(value, field.name)) for field in fields(value) if field.init}
        return {"_target_": _path(type(value))} | tree
    if isinstance(value, Passes):
        return {name: _tree(row) for name, row in value.items()}
    return [_tree(item) for item in value] if isinstance(value, (list, tuple)) else value


def _joined(plane: Any, space: Any) -> Any:
    """One tree for both: equal values as they are, others as interpolations."""
    if isinstance(plane, dict) and isinstance(space, dict) and list(plane) == list(space):
        return {key: _joined(plane[key], space[key]) for key in plane}
    rows = isinstance(plane, list) and isinstance(space, list) and len(plane) == len(space)
    if rows and all(isinstance(item, dict) for item in plane):  # a table's rows: each option can be changed by itself
        return [_joined(a, b) for a, b in zip(plane, space, strict=True)]
    if plane == space:
        return plane
    return f"${{{BY_DIMENSION}:${{model.dimension}},{_literal(plane)},{_literal(space)}}}"


def _literal(value: Any) -> str:
    """A value in the grammar of interpolations."""
    if isinstance(value, dict):
        return f"{{{','.join(f'{key}:{_literal(item)}' for key, item in value.items())}}}"
    return f"[{','.join(map(_literal, value))}]" if isinstance(value, list) else json.dumps(value)


def _sizes(made: Any) -> dict[str, Any]:
    """Lengths and paces of a family that are the vehicle's, where a command has chosen one."""
    sizes = {"vehicle_radius": f"${{torchgco.radius:{made.vehicle_radius}}}"} if made.states == PLANNING_STATES else {}
    return sizes | ({"pace": f"${{torchgco.pace:{made.pace}}}"} if isinstance(made, Floors) else {})


def _radius(usual: float, _root_: Any) -> float:
    """The radius of the vehicle, m; a family's usual one for the paper's, and for models that have no such group."""
    vehicle = _root_.get("vehicle")
    radius = vehicle.get("radius") if OmegaConf.is_dict(vehicle) else None
    return usual if radius is None or radius == Airframe().radius else radius


def _pace(usual: float | None, _root_: Any) -> float | None:
    """The mean speed that horizons have room for, m/s, lower for vehicles that are slower than 1 m/s."""
    speed = OmegaConf.select(_root_, "model.vehicle.speed")
    if not isinstance(speed, int | float):  # none, or what the vehicle will refuse by its own name
        return usual
    return (usual or DRAWN_PACES[2]) * min(1.0, float(speed))


def _help(_root_: Any) -> str:
    """A line, or several, per group: its name and options, `*` behind the one that the command has chosen."""
    loader, chosen = GlobalHydra.instance().config_loader(), _root_.hydra.runtime.choices
    lines = []
    for group in [*sorted(name for name in loader.list_groups("") if name != "hydra"), "hydra/launcher"]:
        names = sorted(loader.get_group_options(group))
        shown = ", ".join(f"{name}*" if name == chosen.get(group) else name for name in names)
        lines += textwrap.wrap(f"{group:<16}{shown}", HELP_WIDTH, initial_indent="  ", subsequent_indent=" " * 18)
    return "\n".join(lines)
