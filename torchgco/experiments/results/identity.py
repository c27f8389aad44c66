"""The identity of studies, layouts and solvers: the content of study.json.

Results depend on the version, the seed, the layouts, the planning model, the settings of the solvers, the files of a
plant and the arithmetic of the device. How a study is cut into batches and processes changes no bit of them
(CONTRIBUTING, "The batch contract") and is no part of its identity.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np

from torchgco.experiments.results.files import checksum
from torchgco.maps.distance import DistanceField
from torchgco.scenarios import Layouts
from torchgco.scenarios.layouts import BINDS, BOXES, GATES, REQUIRED, SINES, SPHERES, TIME, map_arrays

ARITHMETIC = ("name", "dtype", "kernels")  # keys of `device` that decide results
# Keys of `model.vehicle` that layouts may override, and by which of their fields.
OVERRULED = {
    "start": "start", "goal": "goal", "radius": "vehicle_radius", "goal_radius": "goal_radius", "stages": "stages",
    "control_lower": "control_lower", "control_upper": "control_upper",
}  # fmt: skip
READ_FILES = "files"  # what a configuration's files hold, see `files_of`
CLOSED_LOOP = ("mission", "plant", READ_FILES)  # nodes of missions
GROUPS = ("scenario", "model", "device", *CLOSED_LOOP)
DIGITS = 16  # hexadecimal, of a digest: 64 bits
EXACT = 2**53  # above it neighbouring integers, such as seeds, become the same float
MESSAGE_LETTERS = 40  # letters of a value in a message


def settings_of(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a configuration's solver, without its name."""
    return {key: value for key, value in configuration["solver"].items() if key != "name"}


def decisive(configuration: Mapping[str, Any], solvers: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides results, with the settings of all solvers that fly.

    The rows of a solver's table work in their order, of which `digest` takes no notice: it stands as a list.
    """
    metrics = (configuration.get("study") or {}).get("metrics")
    passes = {name: settings.get("passes") for name, settings in solvers.items()}
    return {
        "scenario": configuration["scenario"],
        "model": {"vehicle": configuration["model"]["vehicle"]},
        "device": {name: configuration["device"].get(name) for name in ARITHMETIC} | {"name": kind_of(configuration)},
        "study": {"solvers": list(solvers), **({"metrics": metrics} if metrics else {})},
        "solvers": dict(solvers),
        "order": {name: list(rows) for name, rows in passes.items() if isinstance(rows, Mapping)},
        **closed_loop(configuration),
    }


def kind_of(configuration: Mapping[str, Any]) -> str:
    """The kind of a configuration's device, "cpu" or "cuda": which of several it is decides no result."""
    return str(configuration["device"].get("name")).partition(":")[0]


def closed_loop(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration that missions add; empty without them."""
    return {name: configuration[name] for name in CLOSED_LOOP if configuration.get(name) is not None}


def files_of(configuration: Mapping[str, Any], further: Iterable[Any] = ()) -> dict[str, dict[str, str]]:
    """Digests of the files that a plant is made of, by their paths, as a node `READ_FILES`; empty where there are none.

    A path alone doesn't say which vehicle flies: a file may be edited between two runs.

    Args:
        further: files that those files name in turn, see `MujocoPlant.files`.
    """
    named = [value for value in flat({"plant": configuration.get("plant") or {}}).values() if isinstance(value, str)]
    paths = {path: os.path.expanduser(path) for path in (*named, *map(str, further))}
    digests = {path: checksum(Path(there))[:DIGITS] for path, there in paths.items() if os.path.isfile(there)}
    return {READ_FILES: digests} if digests else {}


@dataclass(frozen=True)
class Manifest:
    """The flights of a study: the content of its study.json.

    Args:
        configuration: resolved, with `version`, as the study was first started.
        solvers: resolved settings by name, the solver under study first.
        layouts: digest of each layout by its id.
    """

    configuration: dict[str, Any]
    solvers: dict[str, Any]
    layouts: dict[int, str]

    @cached_property
    def settings(self) -> dict[str, str]:
        """Digest of each solver's settings, by its name."""
        return {name: digest(settings) for name, settings in self.solvers.items()}

    @property
    def constants(self) -> dict[str, Any]:
        """Values that all rows of the study share, by column."""
        device, config = self.configuration["device"], self.configuration
        return {
            "seed": config["seed"], "version": config["version"], "device": kind_of(config), "dtype": device["dtype"]
        }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Equal for two studies exactly if they compute the same; the clearest differences come first."""
        settings = decisive(self.configuration, self.solvers)
        study = {"layouts": len(self.layouts), **settings.pop("study")}
        leading = {"version": self.configuration["version"], "seed": self.configuration["seed"], "study": study}
        return _normal({**leading, **settings, "layouts": {str(i): code for i, code in self.layouts.items()}})

    def to_json(self) -> bytes:
        """The text of study.json; it includes the digests of the settings for readers only."""
        content = {"configuration": self.configuration, "solvers": self.solvers, "settings": self.settings}
        content["layouts"] = {str(number): code for number, code in self.layouts.items()}
        return json.dumps({**content, "checksum": digest(content)}, indent=1, default=str).encode()

    @classmethod
    def from_json(cls, text: bytes) -> Self:
        """The manifest that `to_json` wrote.

        Raises:
            ValueError, TypeError, KeyError, AttributeError: the text is none.
        """
        content = json.loads(text.decode())
        layouts = {int(number): str(code) for number, code in content["layouts"].items()}
        made = cls(content["configuration"], content["solvers"], layouts)
        if content.pop("checksum") != digest(content):
            raise ValueError("its checksum differs from its content")
        groups = [made.configuration, *made.solvers.values(), *map(made.configuration.get, GROUPS)]
        if not all(group is None or isinstance(group, dict) for group in groups):
            raise ValueError("a group of its configuration holds no keys")
        return made

    def check_whole(self) -> None:
        """Raise ValueError, TypeError or KeyError where a group is missing that a study's own code writes."""
        groups = [self.configuration["model"]["vehicle"], self.configuration["scenario"], *self.solvers.values()]
        if not self.solvers or not self.layouts or not all(isinstance(group, dict) for group in groups):
            raise ValueError("a group of its configuration is missing")
        if not isinstance(self.constants["seed"], int):
            raise ValueError("its seed is no number")


def digest(value: Any) -> str:
    """A digest of plain data: 1 and 1.0 are the same, the order of keys doesn't matter."""
    return _digest_of(_normal(value))


def _digest_of(normal: Any) -> str:
    return sha256(json.dumps(normal, sort_keys=True, default=str).encode()).hexdigest()[:DIGITS]


def _digest_of_array(value: np.ndarray) -> str:
    """Of a large array: its bytes, type and shape."""
    head = f"{value.dtype.str} {value.shape}".encode()
    return sha256(head + np.ascontiguousarray(value).tobytes()).hexdigest()[:DIGITS]


def layout_digests(
    layouts: Layouts, vehicle: Mapping[str, Any], loop: Mapping[str, Any] | None = None
) -> dict[int, str]:
    """Digest of each layout by its id: the obstacles, and all else that a flight depends on except the solver.

    Args:
        vehicle: `model.vehicle` of the resolved configuration; layouts override it where they hold values. The best
            known cost doesn't count.
        loop: of missions, see `closed_loop`.
    """
    shared = _normal(_shared(layouts, vehicle) | dict(loop or {}))  # once for all: a study may have thousands
    moves = layouts.velocities is not None and bool(np.nan_to_num(layouts.velocities).any())
    spheres, numbers = SPHERES if moves else REQUIRED, layouts.ids.tolist()
    return {number: _digest_of(shared | _normal(_of_layout(layouts, spheres, i))) for i, number in enumerate(numbers)}


def _shared(layouts: Layouts, vehicle: Mapping[str, Any]) -> dict[str, Any]:
    """What decides flights in all layouts alike; arrays with a row for each stand in `_of_layout` again."""
    model = {key: value for key, value in vehicle.items() if key not in (*OVERRULED, "name")}
    if layouts.dt is not None:
        model["dynamics"] = {key: value for key, value in dict(model["dynamics"]).items() if key != "dt"}
    values: dict[str, Any] = {"model": model, "dt": layouts.dt}
    for key, field in OVERRULED.items():
        values[key] = vehicle.get(key) if (value := getattr(layouts, field)) is None else value
    values |= {name: value for name in (TIME, BINDS, "apart") if (value := getattr(layouts, name)) is not None}
    if layouts.map is not None and layouts.map.batch is None:
        values["map"] = _map_digests(layouts.map)
    return values


def _of_layout(layouts: Layouts, spheres: Sequence[str], i: int) -> dict[str, Any]:
    """What decides flights in the layout at place i alone; sharp boxes are as without radii.

    Args:
        spheres: arrays of spheres that count: velocities of none that moves don't.
    """
    boxes = _present(layouts, (*BOXES, *SINES), i)
    if "box_radii" in boxes and not boxes["box_radii"].any():
        del boxes["box_radii"]
    values: dict[str, Any] = {**_present(layouts, spheres, i)}
    values |= {name: rows for name, rows in boxes.items() if len(rows)}
    values |= _present(layouts, GATES, i)
    values |= {name: states[i] for name in ("start", "goal") if (states := getattr(layouts, name)) is not None}
    if isinstance(layouts.stages, np.ndarray):
        values["stages"] = int(layouts.stages[i])
    if layouts.map is not None and layouts.map.batch is not None:
        values["map"] = _map_digests(layouts.map.single(i))
    return values


def _present(layouts: Layouts, names: Sequence[str], i: int) -> dict[str, np.ndarray]:
    """The rows of a layout's arrays, without those of NaN, by which spheres, boxes or gates are absent."""
    arrays = {name: value[i] for name in names if (value := getattr(layouts, name)) is not None}
    if not arrays:
        return {}
    places = arrays[names[0]]
    return {name: value[~np.isnan(places).all(axis=-1)] for name, value in arrays.items()}


def _map_digests(field: DistanceField) -> dict[str, str]:
    return {name: _digest_of_array(value) for name, value in map_arrays(field).items()}


def difference(stored: Any, new: Any, path: str = "") -> str:
    """The first key in which two identities differ, as 'key is this there, that here'."""
    old, now = _parts(stored), _parts(new)
    if old and now:
        for key in dict.fromkeys([*now, *old]):
            if old.get(key) != now.get(key):
                return difference(old.get(key), now.get(key), f"{path}.{key}" if path else key)
    return f"{path} is {_short(stored)} there, {_short(new)} here"


def flat(tree: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """The leaves of nested dicts, and of lists of dicts, by their dotted keys; other lists are leaves."""
    return {key: value for key, value in _branches(tree, path) if not _parts(value)}


def _branches(tree: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    branches = []
    for key, value in tree.items():
        name = f"{path}.{key}" if path else str(key)
        branches.append((name, value))
        branches += _branches(_parts(value), name)
    return branches


def _parts(value: Any) -> dict[str, Any]:
    """What a dict holds by its keys, or a list of dicts, such as the passes of a solver, by their numbers."""
    if isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
        return {str(number): item for number, item in enumerate(value)}
    return {str(key): item for key, item in value.items()} if isinstance(value, Mapping) else {}


def _normal(value: Any) -> Any:
    """Plain data in which equal numbers are equal in text: floats alone, no negative zero."""
    if isinstance(value, Mapping):
        # No call for text: a manifest has a digest per layout, thousands of them.
        return {str(key): item if type(item) is str else _normal(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return (value.astype(np.float64) + 0.0).tolist() if value.dtype.kind == "f" else _normal(value.tolist())
    if isinstance(value, list | tuple):
        return [_normal(item) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool) and not abs(value) > EXACT:
        return float(value) + 0.0
    return value


def _short(value: Any) -> str:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    text = str(value)
    return text if len(text) <= MESSAGE_LETTERS else f"{text[:MESSAGE_LETTERS]}..."
